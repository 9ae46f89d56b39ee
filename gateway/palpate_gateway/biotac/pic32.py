"""A BioTac polled by a PIC32 board (format B, hardware reference 2.2): a legacy route.

Its records have neither sync bytes nor a checksum, and the board strips the parity of the words. A
misaligned stream shows only by impossible values or times, often one record late: so a record is
delivered only when the next one has proved to be aligned. A misaligned stream is stopped, drained
and started again.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping

import numpy as np
from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import COUNTS_MAX, PAC_SAMPLES, Origin, SensorType
from palpate_gateway.biotac.finger import TypeOption
from palpate_gateway.clock.sample_times import SampleClock, SampleVerdict
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo, SerialOption
from palpate_gateway.ports.port import settle
from palpate_gateway.ports.serial_port import SerialPort
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols import pic32 as ask
from palpate_gateway.protocols.pic32 import Pic32Decoder, Pic32Layout, Pic32Record, Pic32Sample
from palpate_gateway.readings import ClockObservation, ElectrodeReading, Reading

VALIDITY = (1 << (ch.FIRST_PAC_BIT + 1)) - 1
"""Electrodes, PDC, TAC, TDC and the one PAC sample of a record."""

_TICKS_PER_US = round(1e-6 / ask.TICK_S)
_WRAP_US = (1 << 32) // _TICKS_PER_US
_QUIET_S = 0.05
_DRAIN_S = 1.0
_FIRST_S = 1.0
_SILENCE_S = 0.3
"""Silence after which the board is taken to have restarted, which ends its stream [s]."""


class Pic32Options(StrictConfig):
    """Options of the ``biotac_pic32`` driver.

    Attributes:
        port: Serial line, e.g. ``/dev/serial/by-id/usb-...``.
        baud: [bit/s].
        rts_cts: Hardware flow control, which the board uses.
        layout: Order of the values, which changed between versions of the firmware and does not
            show in the stream: older ones have ``electrodes_first``.
        serial: Serial number to publish, since the board sends none; empty = the port.
        sensor_type: Type of finger; never ``biotac_sp``, for the board polls 19 electrodes only.
    """

    port: str = Field(min_length=1)
    baud: int = Field(default=ask.BAUD, gt=0)
    rts_cts: bool = True
    layout: Pic32Layout = Pic32Layout.PAC_FIRST
    serial: SerialOption = ""
    sensor_type: TypeOption = "auto"


class BiotacPic32(Device):
    """One BioTac at 100 Hz.

    The board polls every channel once a frame: ``pac[0]`` is that one PAC sample, the other 21 are
    0 with their validity bits clear. The times of polling inside a frame are unknown; the slot
    period stated is a 44th of a frame's 10 ms.
    """

    options_class = Pic32Options
    needs = ("serial",)

    def __init__(self, options: Pic32Options) -> None:
        if options.sensor_type == "biotac_sp":
            raise ConfigError(
                f"BioTac on PIC32 {options.port}: its record holds 19 electrodes, a BioTac SP has "
                f"{ch.ELECTRODES_SP}",
                remedy="read an SP by biotac_can or biotac_bridge",
            )
        super().__init__(
            DeviceInfo(
                driver="biotac_pic32",
                sensor_type=SensorType.BIOTAC,
                model=f"BioTac on PIC32 {options.port}",
                rate_hz=ask.RATE_HZ,
                live=True,
                finite=False,
                origin=Origin.LIVE,
            )
        )
        self._options = options
        self._port = SerialPort(options.port, options.baud, rts_cts=options.rts_cts)
        self._begin()

    def _begin(self) -> None:
        """Forget the earlier connection."""
        self._decoder = Pic32Decoder(self._options.layout)
        self._clock = SampleClock(1e6 / ask.RATE_HZ, _WRAP_US)
        self._counts: Counter[str] = Counter(
            frames=0, realigned=0, doubted=0, absent=0, saturated_samples=0
        )
        self._absent = False
        self._held: tuple[Pic32Sample, int, float] | None = None
        self._last_tick: int | None = None
        self._arrived_s = time.monotonic()

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since it was opened last.

        ``doubted`` records were dropped as perhaps misaligned, ``absent`` ones without a finger.
        """
        return {**self._decoder.counters, **self._clock.counters, **self._counts}

    def _open(self) -> DeviceIdentity:
        self._begin()
        self._port.open()
        try:
            self._start()
            self._wait_for_record()
        except BaseException:
            self._close()
            raise
        name = self._options.serial or self._options.port
        return DeviceIdentity(name, 1.0 / ch.SLOT_RATE_HZ)

    def _start(self) -> None:
        """Stop the stream, drain the line, start the stream."""
        self._port.write(ask.STOP_REQUEST)
        began_s = time.monotonic()
        settle(self._port, _QUIET_S, _DRAIN_S)
        if time.monotonic() - began_s >= _DRAIN_S:
            raise DeviceError(
                f"{self.info.model}: it keeps sending after command 'q'",
                remedy="check the direction host to board, and RTS/CTS",
            )
        self._decoder.reset()
        self._held = None
        self._clock.pause()
        self._port.write(ask.START_REQUEST)
        self._arrived_s = time.monotonic()

    def _wait_for_record(self) -> None:
        until = time.monotonic() + _FIRST_S
        while self._held is None:
            left_s = until - time.monotonic()
            if left_s <= 0.0:
                if self._absent:
                    raise self._no_finger()
                raise DeviceError(
                    f"{self.info.model}: no record within {_FIRST_S:g} s of command 'r' "
                    f"({self._decoder.pending} bytes came)",
                    remedy="check power, cable, baud and RTS/CTS",
                )
            try:
                self._receive(min(left_s, _SILENCE_S))
            except DeviceTimeout:
                self._start()  # a board that is booting ignores commands

    def _no_finger(self) -> DeviceLost:
        return DeviceLost(
            f"{self.info.model}: no finger answers (every value is 0)",
            remedy="check its plug and cable; it is looked for again by itself",
        )

    def _close(self) -> None:
        with contextlib.suppress(DeviceError):  # it may be gone
            self._port.write(ask.STOP_REQUEST)
        self._port.close()

    def _read(self, timeout_s: float) -> list[Reading]:
        until = time.monotonic() + timeout_s
        while True:
            left_s = max(until - time.monotonic(), 0.0)
            patience_s = max(self._arrived_s + _SILENCE_S - time.monotonic(), 0.0)
            try:
                readings = self._receive(min(left_s, patience_s))
            except DeviceTimeout:
                if time.monotonic() - self._arrived_s < _SILENCE_S:
                    raise
                if self._absent:
                    raise self._no_finger() from None
                raise DeviceLost(
                    f"{self.info.model}: no record for {_SILENCE_S:g} s",
                    remedy="check its power and cable; it is started again by itself",
                ) from None
            if readings:
                return readings
            if time.monotonic() >= until:
                raise DeviceTimeout(
                    f"{self.info.model}: no record within {timeout_s:g} s",
                    remedy="bytes come, but no aligned record: check baud and cable",
                )

    def _receive(self, timeout_s: float) -> list[Reading]:
        """Read the port once; returns the readings that are certain now."""
        readings: list[Reading] = []
        records = self._decoder.feed(self._port.read(timeout_s))
        in_step = all(self._take(record, readings) for record in records)
        if self._decoder.ended and in_step:
            self._release(readings)  # the end record proves the alignment
        if not in_step or self._decoder.misaligned or self._decoder.ended:
            self._counts["doubted"] += self._held is not None
            self._counts["realigned"] += 1
            self._start()
        return readings

    def _take(self, record: Pic32Record, readings: list[Reading]) -> bool:
        """Hold a record and release the one before it; False if the stream is misaligned."""
        now_s = time.monotonic()
        verdict = self._clock.take(record.tick // _TICKS_PER_US % _WRAP_US, now_s)
        if verdict in (SampleVerdict.DOUBTFUL, SampleVerdict.RESTARTED):
            return False
        if verdict is SampleVerdict.NEW:
            # The reading waited for this record, whose arrival is the newest observation.
            self._release(readings, ClockObservation(self._clock.time_s, time.monotonic_ns()))
            values = _values(record.sample)
            # Words of an absent finger are 00 00, and the board ignores their parity.
            self._absent = not any(values)
            self._counts["absent"] += self._absent
            if not self._absent:
                saturated = sum(value in (0, COUNTS_MAX) for value in values)
                self._counts["saturated_samples"] += saturated
                self._held = (record.sample, self._clock.tick, self._clock.time_s)
        if not self._absent:
            self._arrived_s = now_s
        return True

    def _release(self, readings: list[Reading], observed: ClockObservation | None = None) -> None:
        if self._held is None:
            return
        (sample, tick, time_s), self._held = self._held, None
        missed = 0 if self._last_tick is None else tick - self._last_tick - 1
        self._last_tick = tick
        self._counts["frames"] += 1
        pac = np.zeros(PAC_SAMPLES, np.uint16)
        pac[0] = sample.pac
        readings.append(
            ElectrodeReading(
                tick=tick,
                time_s=time_s,
                missed_before=missed,
                electrodes=np.array(sample.electrodes, np.uint16),
                pdc=sample.pdc,
                pac=pac,
                tac=sample.tac,
                tdc=sample.tdc,
                validity=VALIDITY,
                observed=observed,
            )
        )


def _values(sample: Pic32Sample) -> tuple[int, ...]:
    return (sample.pac, sample.pdc, sample.tac, sample.tdc, *sample.electrodes)
