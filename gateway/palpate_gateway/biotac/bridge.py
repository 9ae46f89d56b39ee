"""BioTacs behind a microcontroller bridge (format D, hardware reference 2.6): our own format.

The bridge sends the words of its fingers verbatim, with times of its own clock; its HELLO packet
brings serial numbers and slot rate. A reference firmware is in ``deploy/firmware/bridge``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np
from pydantic import Field

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.biotac.finger import FingerDevice, FingerOptions
from palpate_gateway.biotac.slot_link import FingerQueue, SlotSource
from palpate_gateway.biotac.slots import LineSlots
from palpate_gateway.ports.serial_port import SerialPort
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.bridge import (
    BridgeDecoder,
    BridgeHello,
    BridgeRecord,
    BridgeSlots,
    BridgeStatus,
)
from palpate_gateway.protocols.can_slots import FINGERS_MAX, SlotDecoder, payload_rows
from palpate_gateway.protocols.slot_clock import SlotClock
from palpate_gateway.readings import ClockObservation

_FIRST_S = 1.0
"""How long the first packet may take [s]: they come every 5 to 10 ms."""

_ABSENT = b"\x00\x00"
_WRAP = 1 << 32


class BridgeOptions(FingerOptions):
    """Options of the ``biotac_bridge`` driver.

    Attributes:
        line: Serial line, e.g. ``/dev/serial/by-id/usb-...``.
        baud: [bit/s]; nominal on USB-CDC.
        source: The bridge's id; None = any, but only one on the line.
        hello_s: How long to wait for a HELLO after the first packet [s]; longer than the time
            between two of them. One that comes later opens the bridge again. 0 = not at all: serial
            numbers stay unknown.
    """

    line: str = Field(min_length=1)
    baud: int = Field(default=460800, gt=0)
    source: int | None = Field(default=None, ge=0, le=0xFF)
    hello_s: float = Field(default=2.5, ge=0.0, le=60.0)


class BridgeSource(SlotSource):
    """The bridge as a source of slots. It is opened once; reopening needs a new object."""

    slot_period_s = 1.0 / ch.SLOT_RATE_HZ

    def __init__(self, options: BridgeOptions) -> None:
        self._port = SerialPort(options.line, options.baud)
        self._wanted, self._sequence = options.source, options.sequence
        self._hello_s = options.hello_s
        self._packets = BridgeDecoder()
        # A word for each port that a user may name: those that the bridge lacks are absent.
        self._slots = SlotDecoder(fingers=FINGERS_MAX)
        self._clock = self._new_clock()
        self._source: int | None = None
        self._epoch: int | None = None
        self._hello: BridgeHello | None = None
        self._without = False  # opened without a HELLO
        self._status: tuple[BridgeStatus, BridgeStatus] | None = None
        self._foreign = 0
        self._end: DeviceError | None = None
        self._arrival_ns = 0
        self.fingers = 0
        """Number of fingers that the bridge samples; 0 while unknown."""

    def _new_clock(self) -> SlotClock:
        return SlotClock(
            slot_rate_hz=1.0 / self.slot_period_s,
            sequence=None if self._sequence == "learn" else ch.SEQUENCES[self._sequence],
            exact=True,
        )

    def open(self) -> None:
        """See ``SlotSource``; waits for the bridge's HELLO."""
        self._port.open()
        try:
            self._wait_for_hello()
        except BaseException:
            self.close()
            raise

    def _wait_for_hello(self) -> None:
        due_s = time.monotonic() + _FIRST_S
        heard = False
        while self._hello is None:
            if not heard and self._source is not None:
                # From the first packet on: a bridge that stood still sends its HELLO later, too.
                heard, due_s = True, time.monotonic() + self._hello_s
            if time.monotonic() >= due_s:
                if heard:
                    self._without = True
                    return
                raise self._no_packet()
            try:
                self.read(_FIRST_S / 10)
            except DeviceTimeout:
                continue
        # Only now is the slot rate known, by which the clock works.
        self._clock = self._new_clock()

    def _no_packet(self) -> DeviceError:
        junk = self._packets.counters["junk_bytes"] + self._packets.pending
        which = "" if self._wanted is None else f" of source {self._wanted}"
        remedy = "check its power and cable"
        if self._foreign:
            remedy = "another bridge answers: correct source"
        elif junk:
            remedy = "bytes come, but no packet: check baud, and that a bridge of this format sends"
        return DeviceError(
            f"{self._port.name}: no packet{which} within {_FIRST_S:g} s "
            f"({junk} bytes were none, {self._foreign} packets another's)",
            remedy=remedy,
        )

    def close(self) -> None:
        """See ``SlotSource``."""
        self._port.close()

    def read(self, timeout_s: float) -> LineSlots | None:
        """See ``SlotSource``."""
        if self._end is not None:
            raise self._end
        placed: list[LineSlots] = []
        data = self._port.read(timeout_s)
        self._arrival_ns = time.monotonic_ns()
        for record in self._packets.feed(data):
            try:
                slots = self._take(record)
                placed += [slots] if slots is not None else []
            except DeviceError as error:
                # The slots before the error are delivered first.
                self._end = error
                break
        if self._end is not None and not placed:
            raise self._end
        return LineSlots.joined(placed) if placed else None

    def _take(self, record: BridgeRecord) -> LineSlots | None:
        if not self._is_ours(record):
            return None
        if isinstance(record.body, BridgeSlots):
            return self._place(record.body, record.time_us)
        if isinstance(record.body, BridgeHello):
            self._take_hello(record.body)
        else:
            self._status = (self._status[0] if self._status else record.body, record.body)
        return None

    def _is_ours(self, record: BridgeRecord) -> bool:
        source = record.header.source
        if self._wanted is not None and source != self._wanted:
            self._foreign += 1
            return False
        if self._source is None:
            self._source, self._epoch = source, record.epoch
        if source != self._source:
            raise DeviceError(
                f"{self._port.name}: two bridges send, {self._source} and {source}",
                remedy="name one of them by source",
            )
        if record.epoch != self._epoch:
            # Its clock starts again, so the map to host time must start again too.
            raise DeviceLost(
                f"{self._port.name}: the bridge has restarted",
                remedy="check its power; it is opened again by itself",
            )
        return True

    def _take_hello(self, hello: BridgeHello) -> None:
        if hello.slot_rate_hz == 0:
            raise DeviceError(
                f"{self._port.name}: the bridge reports a rate of 0 slots per second",
                remedy="correct its firmware",
            )
        known, self._hello = self._hello, hello
        if known is not None and known != hello:
            raise DeviceLost(
                f"{self._port.name}: fingers or rate of the bridge have changed",
                remedy="it is opened again by itself",
            )
        other_rate = not math.isclose(hello.slot_rate_hz * self.slot_period_s, 1.0)
        if self._without and (other_rate or self._hello_s > 0.0):
            raise DeviceLost(
                f"{self._port.name}: the bridge's HELLO came later than hello_s = "
                f"{self._hello_s:g} s",
                remedy="it is opened again by itself, with serial numbers and rate; if this "
                "repeats, raise hello_s",
            )
        self.fingers = len(hello.fingers)
        if known is None:
            self.slot_period_s = 1.0 / hello.slot_rate_hz

    def _place(self, group: BridgeSlots, time_us: int) -> LineSlots | None:
        if self._hello is None:
            self.fingers = group.fingers
        rest = _ABSENT * (FINGERS_MAX - group.fingers)
        words = self._slots.decode(*payload_rows([payload + rest for payload in group.payloads]))
        stamps_s = 1e-6 * time_us + words.index.astype(np.float64) * self.slot_period_s
        if len(stamps_s):
            # A packet leaves when its last slot has been sampled.
            self.observed = ClockObservation(float(stamps_s[-1]), self._arrival_ns)
        places = self._clock.place_all(words.channel, stamps_s)
        return LineSlots.placed(words, places, len(self._clock.sequence))

    def serial(self, finger: int) -> str:
        """See ``SlotSource``."""
        fingers = self._hello.fingers if self._hello is not None else ()
        return fingers[finger].serial if finger < len(fingers) else ""

    def counters(self, finger: int) -> Mapping[str, int]:
        """See ``SlotSource``; those that begin with ``bridge`` were counted by the bridge."""
        counted = {"bridge_parity_errors": 0, "bridge_error_words": 0, "bridge_overruns": 0}
        if self._status is not None:
            first, last = self._status
            if finger < min(len(first.parity_errors), len(last.parity_errors)):
                errors = last.parity_errors[finger] - first.parity_errors[finger]
                counted["bridge_parity_errors"] = errors % _WRAP
            counted["bridge_error_words"] = (last.error_words - first.error_words) % _WRAP
            counted["bridge_overruns"] = (last.overruns - first.overruns) % _WRAP
        return {
            **self._packets.counters,
            **self._slots.counters,
            **self._clock.counters,
            **self._slots.finger_counters[finger],
            "other_sources": self._foreign,
            **counted,
        }


class BiotacBridge(FingerDevice):
    """One BioTac of a bridge; several of one bridge share its line."""

    options_class = BridgeOptions
    needs = ("serial",)

    def __init__(self, options: BridgeOptions) -> None:
        super().__init__("biotac_bridge", f"BioTac behind bridge {options.line}", options)
        self._bridge = options

    def _line(self) -> tuple[object, object, SlotSource, int]:
        options = self._bridge
        settings = options.model_dump(exclude={"port", "serial"})
        return (options.line,), settings, BridgeSource(options), FINGERS_MAX

    def _check_there(self, finger: FingerQueue) -> None:
        assert isinstance(finger.source, BridgeSource)
        fingers = finger.source.fingers
        if finger.index >= fingers > 0:
            raise DeviceError(
                f"{self.info.model}: the bridge samples {fingers} fingers only",
                remedy="correct port, or the bridge's firmware",
            )
        super()._check_there(finger)
