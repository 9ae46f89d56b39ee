"""BioTacs on a CAN bus, a frame for each sampled channel (format A, hardware reference 2.1).

Whether SynTouch's interface sends exactly this is a well-founded inference, never confirmed by a
public capture of a BioTac: the public driver of the format is for the NumaTac.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import Field

from palpate.gateway.biotac.device import FingerDevice, FingerOptions
from palpate.gateway.biotac.slot_link import PlacedSlot, SlotSource
from palpate.gateway.ports.can_bus import CanBus
from palpate.gateway.protocols import channels as ch
from palpate.gateway.protocols.can_slots import CAN_FINGERS_MAX, SEQUENCES, CanSlotDecoder
from palpate.gateway.protocols.slot_clock import SlotClock


class CanOptions(FingerOptions):
    """Options of the ``biotac_can`` driver.

    Attributes:
        interface: python-can's kind of bus.
        channel: Which bus.
        bitrate: [bit/s]; 0 = as the bus is set up.
        bus_options: More of python-can's options.
        can_id: Identifier of the BioTacs' frames; None = any frame that holds a sampled channel.
        fingers: Words in each frame.
        slot_rate_hz: Slots each second.
        sequence: Order of sampling; ``learn`` = from the stream, which takes 30 ms at the start.
    """

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = Field(default=0, ge=0)
    bus_options: dict[str, Any] = Field(default_factory=dict)
    can_id: int | None = Field(default=None, ge=0, le=0x7FF)
    fingers: int = Field(default=CAN_FINGERS_MAX, ge=1, le=CAN_FINGERS_MAX)
    slot_rate_hz: float = Field(default=ch.SLOT_RATE_HZ, gt=0.0, le=10_000.0)
    sequence: Literal["learn", "biotac_e1_first", "biotac_pac_first"] = "learn"


class CanSource(SlotSource):
    """The bus as a line of slots."""

    def __init__(self, options: CanOptions) -> None:
        self.slot_period_s = 1.0 / options.slot_rate_hz
        self._bus = CanBus(
            options.interface,
            options.channel,
            bitrate=options.bitrate,
            options=options.bus_options,
        )
        self._decoder = CanSlotDecoder(fingers=options.fingers, can_id=options.can_id)
        self._clock = SlotClock(
            slot_rate_hz=options.slot_rate_hz,
            sequence=None if options.sequence == "learn" else SEQUENCES[options.sequence],
        )

    def open(self) -> None:
        """See ``SlotSource``."""
        self._bus.open()

    def close(self) -> None:
        """See ``SlotSource``."""
        self._bus.close()

    def read(self, timeout_s: float) -> Sequence[PlacedSlot]:
        """See ``SlotSource``."""
        out = []
        for message in self._bus.read(timeout_s):
            words = self._decoder.feed(message.can_id, message.data)
            if words is None:
                continue
            place = self._clock.place(words.channel, message.arrival_ns * 1e-9)
            if place is not None:
                ends = place.position == len(self._clock.sequence) - 1
                out.append(PlacedSlot(words, place, ends))
        return out

    def serial(self, finger: int) -> str:
        """The format does not tell serial numbers."""
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

    def __init__(self, options: CanOptions) -> None:
        super().__init__("biotac_can", f"BioTac on CAN {options.channel}", options)
        self._can = options

    def _line(self) -> tuple[object, object, SlotSource, int]:
        options = self._can
        key = (options.interface, options.channel, options.can_id)
        settings = options.model_dump(exclude={"port", "serial"})
        return key, settings, CanSource(options), options.fingers
