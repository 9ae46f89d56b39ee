"""BioTacs on a CAN bus, a frame for each sampled channel (format A, hardware reference 2.1)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.biotac.finger import FingerDevice, FingerOptions
from palpate_gateway.biotac.slot_link import SlotSource
from palpate_gateway.biotac.slot_rate import RATE_S, SlotRate
from palpate_gateway.biotac.slots import LineSlots
from palpate_gateway.ports.can_bus import CanBus, check_bitrate
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.can_slots import CAN_FINGERS_MAX, CanSlotDecoder
from palpate_gateway.protocols.silences import Floats
from palpate_gateway.protocols.slot_clock import SlotClock
from palpate_gateway.readings import ClockObservation

_LATE_S = 2e-4
"""Added to the expected end of a round, so that its last slot has arrived at the wake-up [s]."""

_SCATTER_S = 3e-3
"""Longest wait for late slots of a round, however much earlier ones were late [s]."""

_RATE_PATIENCE_S = 5.0
"""Longest time in which the rate of slots is measured before the first is delivered [s]."""

_UNKNOWN_S = 2e-3
"""How long slots wait for more while their place in the round is unknown [s]."""


class CanOptions(FingerOptions):
    """Options of the ``biotac_can`` driver.

    Attributes:
        interface: python-can's kind of bus.
        channel: Which bus.
        bitrate: [bit/s]; 0 = as the bus is set up, as ``socketcan`` requires.
        bus_options: Further options of python-can; for ``udp_multicast`` also ``listen``, the
            address of the network that is joined: without it only this host is heard.
        can_id: Identifier of the BioTacs' frames; None = the only one whose frames repeat a round
            of sampling, which takes 30 ms at the start even where ``sequence`` is given.
        fingers: Words in each frame.
        slot_rate_hz: Slots each second by the sender's clock; a bus that brings others is refused.
        gather_s: How long slots may wait for the end of their sampling round [s]: waking up for
            each of 4400 slots a second would take most of the processor time. 0 = not at all.
    """

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = Field(default=0, ge=0)
    bus_options: dict[str, Any] = Field(default_factory=dict)
    can_id: int | None = Field(default=None, ge=0, le=0x7FF)
    fingers: int = Field(default=CAN_FINGERS_MAX, ge=1, le=CAN_FINGERS_MAX)
    slot_rate_hz: float = Field(default=ch.SLOT_RATE_HZ, gt=0.0, le=10_000.0)
    gather_s: float = Field(default=0.02, ge=0.0, le=0.1)

    @model_validator(mode="after")
    def _fits(self) -> CanOptions:
        check_bitrate(self.interface, self.bitrate)
        return self


class CanSource(SlotSource):
    """The CAN bus as a source of slots. It is opened once; reopening needs a new object."""

    def __init__(self, options: CanOptions) -> None:
        self.slot_period_s = 1.0 / options.slot_rate_hz
        self._bus = CanBus(
            options.interface,
            options.channel,
            bitrate=options.bitrate,
            options=options.bus_options,
        )
        self._gather_s = options.gather_s
        self._ends_s = 0.0
        self._decoder = CanSlotDecoder(fingers=options.fingers, can_id=options.can_id)
        self._sequence = None if options.sequence == "learn" else ch.SEQUENCES[options.sequence]
        self._rate_hz = options.slot_rate_hz
        self._rate = SlotRate(self._rate_hz)
        self._clock = self._new_clock()

    def _new_clock(self) -> SlotClock:
        return SlotClock(slot_rate_hz=self._rate_hz, sequence=self._sequence)

    def open(self) -> None:
        """See ``SlotSource``; measures the rate of slots first."""
        self._bus.open()
        try:
            self._wait_for_rate()
        except BaseException:
            self.close()
            raise

    def _wait_for_rate(self) -> None:
        # With a wrong rate every time would be wrong: no finger may see a slot until it is known.
        until = time.monotonic() + _RATE_PATIENCE_S
        with contextlib.suppress(DeviceTimeout):
            while not self._rate.right and time.monotonic() < until:
                self.read(RATE_S)
        self._clock = self._new_clock()
        self._rate.begin()

    def close(self) -> None:
        """See ``SlotSource``."""
        self._bus.close()

    def read(self, timeout_s: float) -> LineSlots | None:
        """See ``SlotSource``."""
        batch = self._bus.read(timeout_s, gather_s=self._until_the_end_s())
        data, size, arrival_ns = batch.frames.data, batch.frames.size, batch.arrival_ns
        ours = self._decoder.ours(batch.frames.can_id, data, size)
        if len(self._decoder.senders) > 1:
            one, other = sorted(self._decoder.senders)[:2]
            raise DeviceError(
                f"{self._bus.name}: identifiers {one:#x} and {other:#x} both send slots",
                remedy="name one of them by can_id",
            )
        if ours is not None:
            data, size, arrival_ns = data[ours], size[ours], arrival_ns[ours]
        known = bool(self._decoder.senders)
        if not known and self._sequence is not None:
            self._clock.counters["unplaced"] += len(size)
            return None
        words = self._decoder.decode(data, size)
        stamps_s = arrival_ns[words.index].astype(np.float64) * 1e-9
        places = self._clock.place_all(words.channel, stamps_s)
        if not known:  # the order is learnt meanwhile, from the same slots
            return None
        slots = LineSlots.placed(words, places, len(self._clock.sequence))
        if slots is not None:
            self._note_times(slots, stamps_s[places.kept])
            self._check_rate(float(stamps_s[places.kept[-1]]))
        return slots

    def _check_rate(self, stamp_s: float) -> None:
        counters = self._clock.counters
        wrong_hz = self._rate.follow(counters["placed"], counters["lost_slots"], stamp_s)
        if wrong_hz is not None:
            raise DeviceLost(
                f"{self._bus.name}: {wrong_hz:.0f} slots come each second, not {self._rate_hz:g}",
                remedy="set slot_rate_hz to what comes, or correct the sender",
            )

    def _note_times(self, slots: LineSlots, stamps_s: Floats) -> None:
        late_s = stamps_s - slots.time_s
        soonest = int(np.argmin(late_s))
        self.observed = ClockObservation(
            float(slots.time_s[soonest]), round(1e9 * float(stamps_s[soonest]))
        )
        left = slots.size - 1 - int(slots.position[-1]) or slots.size
        scatter_s = min(float(late_s.max() - late_s[soonest]), _SCATTER_S)
        ends_s = float(slots.time_s[-1]) + left * self.slot_period_s
        self._ends_s = ends_s + float(late_s[soonest]) + scatter_s + _LATE_S

    def _until_the_end_s(self) -> float:
        """Time until the sampling round that has begun ends [s]."""
        left_s = self._ends_s - time.monotonic()
        return min(left_s if left_s > 0.0 else _UNKNOWN_S, self._gather_s)

    def serial(self, finger: int) -> str:
        """Empty: the format has no serial numbers."""
        return ""

    def counters(self, finger: int) -> Mapping[str, int]:
        """See ``SlotSource``."""
        return {
            **self._bus.counters,
            **self._decoder.counters,
            **self._clock.counters,
            **self._decoder.finger_counters[finger],
        }


class BiotacCan(FingerDevice):
    """One BioTac of a CAN bus; several of one bus share it."""

    options_class = CanOptions
    needs = ("can",)

    def __init__(self, options: CanOptions) -> None:
        super().__init__("biotac_can", f"BioTac on CAN {options.channel}", options)
        self._can = options

    def _line(self) -> tuple[object, object, SlotSource, int]:
        options = self._can
        # Two buses may differ in an option only, e.g. in the port of their UDP group.
        more = (f"{key}={value}" for key, value in sorted(options.bus_options.items()))
        key = (options.interface, options.channel, options.can_id, *more)
        settings = options.model_dump(exclude={"port", "serial"})
        return key, settings, CanSource(options), options.fingers
