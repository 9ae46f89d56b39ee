"""From the messages of a hand to the readings of one finger: which is new, and what it holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Literal

import numpy as np

from palpate.messages import SensorType
from palpate_gateway.protocols.ros_hands import RosFinger, RosHand, is_count
from palpate_gateway.readings import ClockObservation, ElectrodeReading

Channel = Literal["pac", "pdc", "tac", "tdc"]
"""A channel that a driver of ROS may not fill."""

_BEGAN_ANEW = 10
"""So many messages in a row with an earlier time show that the clock of ROS was set back."""

_JUMP_S = 3600.0
"""A longer step between two messages is of a clock that was set, e.g. from 1970 to now [s]."""


class FingerTrack:
    """The readings of one finger of a hand.

    A channel counts as filled by the driver once it has been other than 0; before, and where the
    value is no 12-bit count, its validity bit is clear. So what a message lacks is never invented.

    ``counters``: ``samples`` (readings), ``repeated_readings`` (a message without a new count of
    electrodes, PDC, TAC or TDC), ``repeated_messages`` (no later time), ``late_messages`` (an
    earlier one), ``absent`` (the finger is not in the message, or all its values are 0),
    ``bad_counts`` (values below 0 or above 4095), ``missing_readings``, ``time_jumps``
    (the clock was set forward; nothing counts as missing).

    Args:
        place: Place of the finger in the message, from 1.
        serial: Serial number by which to find it; empty = by its place.
        rate_hz: Readings each second, by which missing ones are counted.
        missing: Channels that this driver does not fill.
        repeats: What to do with messages that repeat the reading before them.
    """

    def __init__(
        self,
        place: int,
        *,
        serial: str = "",
        rate_hz: float,
        missing: Collection[Channel] = (),
        repeats: Literal["drop", "keep"] = "drop",
    ) -> None:
        self._place, self._serial = place, serial
        self._rate_hz, self._missing, self._repeats = rate_hz, frozenset(missing), repeats
        self.counters: Counter[str] = Counter()
        self.begin()

    def begin(self, origin_ns: int | None = None) -> None:
        """Accept any next message, and set the counters to 0.

        Args:
            origin_ns: ROS time from which times are counted; None = that of the next message.
        """
        self.counters.clear()
        self.counters.update(
            dict.fromkeys(
                ("samples", "repeated_readings", "repeated_messages", "late_messages", "absent",
                 "bad_counts", "missing_readings", "time_jumps"), 0,
            )
        )  # fmt: skip
        self.restarted = False
        """The clock of the messages was set back; ``begin`` again."""
        self._filled = 0
        self._origin_ns = origin_ns
        self._last_ns: int | None = None
        self._late = 0
        self._heard_s: float | None = None
        self._tick = self._gap = 0
        self._slow: tuple[int, ...] = ()

    def find(self, hand: RosHand) -> RosFinger | None:
        """The finger in a message; None = it is not there."""
        if self._serial:
            same = (one for one in hand.fingers if one is not None and one.serial == self._serial)
            return next(same, None)
        return hand.fingers[self._place - 1] if self._place <= len(hand.fingers) else None

    def take(
        self, hand: RosHand, *, lost: int | None = None, arrival_ns: int | None = None
    ) -> ElectrodeReading | None:
        """The finger's reading in the next message; None if there is none, or not a new one.

        Args:
            hand: The message; its ``time_ns`` must be set.
            lost: Messages known to be lost before it; None = unknown.
            arrival_ns: Host's monotonic clock when it came [ns]; None = of a recording.
        """
        if not self._is_later(hand.time_ns):
            return None
        # Not from 1970: a float would lose digits.
        if self._origin_ns is None:
            self._origin_ns = hand.time_ns
        time_s = (hand.time_ns - self._origin_ns) * 1e-9
        # Also of the messages before this one that had no new reading of the finger.
        self._gap += self._missed(time_s, lost)
        self._heard_s = time_s
        finger = self.find(hand)
        if finger is None:
            self.counters["absent"] += 1
            return None
        if not hand.whole_frames and self._repeats == "drop" and finger.slow == self._slow:
            self.counters["repeated_readings"] += 1
            return None
        self._slow = finger.slow
        missed, self._gap = self._gap, 0
        self._tick += 1 + missed
        self.counters["missing_readings"] += missed
        self.counters["samples"] += 1
        observed = None
        if arrival_ns is not None:
            # It came when its last slot was sampled, not when its first was.
            end_s = (hand.end_ns - self._origin_ns) * 1e-9
            observed = ClockObservation(end_s, arrival_ns)
        return self._reading(finger, time_s, missed, observed)

    def _is_later(self, time_ns: int) -> bool:
        if self._last_ns is not None and time_ns <= self._last_ns:
            same = time_ns == self._last_ns
            self.counters["repeated_messages" if same else "late_messages"] += 1
            self._late += not same
            self.restarted = self._late >= _BEGAN_ANEW
            return False
        self._late = 0
        self._last_ns = time_ns
        return True

    def _missed(self, time_s: float, lost: int | None) -> int:
        """Readings lost before this message: by time, and no more than messages are lost."""
        if self._heard_s is None:
            return 0
        step_s = time_s - self._heard_s
        if step_s > _JUMP_S:
            self.counters["time_jumps"] += 1
            return 0
        by_time = max(round(step_s * self._rate_hz) - 1, 0)
        return by_time if lost is None else min(by_time, lost)

    def _reading(
        self,
        finger: RosFinger,
        time_s: float,
        missed: int,
        observed: ClockObservation | None,
    ) -> ElectrodeReading:
        layout = finger.sensor_type.layout
        values = np.zeros(layout.slots, np.int64)
        values[: layout.first_pac_bit] = finger.slow
        pac = finger.pac[: layout.pac_samples]
        values[layout.first_pac_bit : layout.first_pac_bit + len(pac)] = pac
        validity = 0
        for bit in range(layout.first_pac_bit + len(pac)):
            if not is_count(int(values[bit])):
                self.counters["bad_counts"] += 1
                values[bit] = 0
                continue
            self._filled |= bool(values[bit]) << bit
            validity |= 1 << bit
        validity &= self._filled_bits(finger.sensor_type) & ~self._unfilled(finger.sensor_type)
        counts = values.astype(np.uint16)
        return ElectrodeReading(
            tick=self._tick,
            time_s=time_s,
            missed_before=missed,
            electrodes=counts[: layout.electrodes],
            pdc=int(counts[layout.pdc_bit]),
            pac=counts[layout.first_pac_bit :],
            tac=int(counts[layout.tac_bit]),
            tdc=int(counts[layout.tdc_bit]),
            validity=validity,
            observed=observed,
        )

    def _filled_bits(self, kind: SensorType) -> int:
        """Bits of the channels that have been other than 0; PAC is one channel."""
        first = kind.layout.first_pac_bit
        slow = (1 << first) - 1
        return self._filled & slow | (kind.layout.all_valid & ~slow if self._filled >> first else 0)

    def _unfilled(self, kind: SensorType) -> int:
        """Bits of the channels that the options call missing."""
        layout = kind.layout
        bits: Mapping[Channel, int] = {
            "pac": layout.all_valid >> layout.first_pac_bit << layout.first_pac_bit,
            "pdc": 1 << layout.pdc_bit,
            "tac": 1 << layout.tac_bit,
            "tdc": 1 << layout.tdc_bit,
        }
        return sum(bits[channel] for channel in self._missing)
