"""What the tactile messages of ROS say of each finger (hardware reference 7).

A ``BioTacHand`` holds a whole 100 Hz frame of each finger: all channels, 22 PAC samples, the times
of sampling. A ``BiotacAll`` holds what the EtherCAT driver of a Shadow hand knows at this instant:
every channel once and two PAC samples, for five fingers, of which those not connected are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.errors import WireError
from palpate.messages import COUNTS_MAX, SensorType
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND, Dialect, decode, time_of
from palpate_gateway.protocols.channels import SLOT_RATE_HZ

_FRAME_S_MAX = 1.0
_SLOT_S = (1e-5, 1e-2)
"""Slot periods outside of these are no measurement [s]."""

_BY_ELECTRODES = {kind.layout.electrodes: kind for kind in SensorType}


@dataclass(frozen=True, slots=True)
class RosFinger:
    """One finger of a message.

    Attributes:
        serial: Serial number; empty = the message has none.
        slow: E1 to E19 (SP: E24), PDC, TAC, TDC as sent, also where no count [counts].
        pac: PAC samples in order of sampling, as sent: 22 of a whole frame, or 2.
    """

    serial: str
    slow: tuple[int, ...]
    pac: tuple[int, ...]

    @property
    def sensor_type(self) -> SensorType:
        """By the number of electrodes."""
        return _BY_ELECTRODES[len(self.slow) - 3]

    @property
    def answers(self) -> bool:
        """Whether a finger is connected: of one that is not, every value is 0."""
        return any(self.slow) or any(self.pac)


@dataclass(frozen=True, slots=True)
class RosHand:
    """One tactile message.

    Attributes:
        time_ns: ROS time of the first slot, or of the message [ns since the epoch]; 0 = not set.
        end_ns: ROS time of the last slot; as ``time_ns`` where the message has no other.
        sequence: The header's number; None = ROS 2, which has none.
        slot_period_s: Time between two slots of a frame [s].
        whole_frames: Each message is a frame of its own; False = it may repeat electrodes.
        fingers: The fingers, in the message's order; None = not connected.
    """

    time_ns: int
    end_ns: int
    sequence: int | None
    slot_period_s: float
    whole_frames: bool
    fingers: tuple[RosFinger | None, ...]


def decode_hand(payload: bytes, layout: str, dialect: Dialect = "cdr") -> RosHand:
    """The hand in the bytes of a ``BioTacHand`` or ``BiotacAll``.

    Raises:
        WireError: The bytes are no such message, or a finger has neither 19 nor 24 electrodes.
    """
    message = decode(payload, layout, dialect)
    stamp_ns = time_of(message.header.stamp)
    sequence = getattr(message.header, "seq", None)
    if layout == BIOTAC_ALL:
        fingers = [
            _finger("", (*one.electrodes.tolist(), one.pdc, one.tac, one.tdc), (one.pac0, one.pac1))
            for one in message.tactiles
        ]
        return RosHand(stamp_ns, stamp_ns, sequence, 1.0 / SLOT_RATE_HZ, False, tuple(fingers))
    if layout != BIOTAC_HAND:
        raise ValueError(f"{layout} is no tactile message")
    times = message.bt_time
    start_ns = time_of(times.frame_start_time) or stamp_ns
    end_ns = time_of(times.frame_end_time)
    if not 0 <= end_ns - start_ns < _FRAME_S_MAX * 1e9:
        end_ns = start_ns
    fingers = [
        _finger(
            _printable(one.bt_serial),
            (*one.electrode_data.tolist(), one.pdc_data, one.tac_data, one.tdc_data),
            one.pac_data.tolist(),
        )
        for one in message.bt_data
    ]
    period_s = _slot_period_s(times.pac_ns_offset)
    return RosHand(start_ns, end_ns, sequence, period_s, True, tuple(fingers))


def _finger(serial: str, slow: Sequence[int], pac: Sequence[int]) -> RosFinger | None:
    finger = RosFinger(serial, tuple(map(int, slow)), tuple(map(int, pac)))
    if not finger.answers:
        return None
    if len(slow) - 3 not in _BY_ELECTRODES:
        raise WireError(
            f"a finger has {len(slow) - 3} electrodes",
            remedy="a BioTac has 19, a BioTac SP 24: check the driver of the hand",
            reason="electrode_count",
        )
    return finger


def _printable(serial: str) -> str:
    """Without the stray bytes that follow some serial numbers (hardware reference 1.5)."""
    for at, char in enumerate(serial):
        if not (char.isascii() and char.isprintable()):
            return serial[:at]
    return serial


def _slot_period_s(pac_ns_offset: Any) -> float:
    """From the times of the PAC samples, which are two slots apart; the maker's if there are none.

    Some drivers leave the offsets at 0.
    """
    period_s = float(np.median(np.diff(pac_ns_offset.astype(np.int64)))) * 0.5e-9
    return period_s if _SLOT_S[0] < period_s < _SLOT_S[1] else 1.0 / SLOT_RATE_HZ


def is_count(value: int) -> bool:
    """Whether the 12-bit ADC can have sent this value."""
    return 0 <= value <= COUNTS_MAX
