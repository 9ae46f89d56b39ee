"""BioTacs on a CAN bus, a frame for each sampled channel (format A, hardware reference 2.1).

Whether SynTouch's interface sends exactly this is a well-founded inference, never confirmed by a
public capture of a BioTac: the public driver of the format is for the NumaTac.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from palpate.gateway.biotac.device import FingerDevice, FingerOptions
from palpate.gateway.biotac.line_slots import LineSlots
from palpate.gateway.biotac.slot_link import SlotSource
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
        gather_s: How long frames may wait for one another [s]: who wakes for each of 4400 does
            little else. 0 = not at all.
    """

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = Field(default=0, ge=0)
    bus_options: dict[str, Any] = Field(default_factory=dict)
    can_id: int | None = Field(default=None, ge=0, le=0x7FF)
    fingers: int = Field(default=CAN_FINGERS_MAX, ge=1, le=CAN_FINGERS_MAX)
    slot_rate_hz: float = Field(default=ch.SLOT_RATE_HZ, gt=0.0, le=10_000.0)
    sequence: Literal["learn", "biotac_e1_first", "biotac_pac_first"] = "learn"
    gather_s: float = Field(default=2e-3, ge=0.0, le=0.02)


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
        self._gather_s = options.gather_s
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

    def read(self, timeout_s: float) -> LineSlots | None:
        """See ``SlotSource``."""
        messages = self._bus.read(timeout_s, gather_s=self._gather_s)
        ours = [message for message in messages if self._decoder.is_ours(message.can_id)]
        words = self._decoder.decode([message.data for message in ours])
        stamps_s = np.array([message.arrival_ns * 1e-9 for message in ours], np.float64)
        places = self._clock.place_all(words.channel, stamps_s[words.index])
        return LineSlots.placed(words, places, len(self._clock.sequence))

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
