"""Which messages of one source belong together: order, holes, restarts, and whose they are.

A message that decodes may still be wrong: a bit that flipped in its sequence, a second gateway that
publishes under the same key. So each message is compared with the last one that was accepted. What
follows it is accepted. Any other is held back until the next message shows which of the two was
right: if that one follows the held message, both are delivered; if it follows the accepted one, the
held message is dropped. One wrong message therefore costs no more than itself, and a restarted
sender no more than a delay of one message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from palpate.messages import Origin, Stamp

R = TypeVar("R")

SILENT_NS = 1_000_000_000
"""A sender is gone after this time without a message [ns]."""

MOST_HZ = 10_000
"""No sender counts faster [Hz]; force/torque sensors reach 7 kHz."""

_FEW = 2
"""So many messages may be missing without regard to the time that has passed."""

_FAR_BACK = 1000
"""Messages overtake one another by less than this; who is farther back has started again."""

Sender = int | str
"""The run of a gateway, or where it is unknown the serial number of its sensor."""

Holders = Callable[[], frozenset[int] | None]
"""The runs of gateways that hold the sensor, by their claims; None = claims are not watched."""


@dataclass(slots=True)
class _Point(Generic[R]):
    """A message, its stamp, when it came, and what this process had dropped before it."""

    message: R
    stamp: Stamp
    sender: Sender
    arrived_ns: int
    lost_here: int
    # Whether it directly followed an accepted message: then it is right beyond doubt, and what is
    # behind it was overtaken or comes from a restarted sender.
    certain: bool = False


class Continuity(Generic[R]):
    """Follows one source; ``take`` says what to deliver. Belongs to one thread.

    It counts into ``counters``: ``lost_on_bus`` (holes in the sequence of a contiguous topic),
    ``reordered`` (duplicates and overtaken messages), ``restarts``, ``rejected_implausible``,
    ``delivered_implausible`` (seen to be wrong too late), and ``other_session`` (of a second sender
    while the followed one is alive).

    Args:
        counters: Shared by all sources of a subscriber.
        contiguous: Whether the sequence has no holes unless something was lost.
        trusting: Whether any order is accepted at once: nothing may be lost in a lossless replay.
        holders: Who holds the sensor.
    """

    def __init__(
        self,
        counters: Counter[str],
        *,
        contiguous: bool,
        trusting: bool = False,
        holders: Holders = lambda: None,
    ) -> None:
        self._counters = counters
        self._contiguous = contiguous
        self._trusting = trusting
        self._holders = holders
        self._last: _Point[R] | None = None
        self._held: _Point[R] | None = None
        self._established = False
        self._dropped_here = False

    def drops_unknown(self) -> None:
        """This process dropped messages and does not know whose: a hole is not the bus's fault."""
        self._dropped_here = True

    def take(
        self, message: R, stamp: Stamp, *, serial: str, arrived_ns: int, lost_here: int = 0
    ) -> Sequence[R]:
        """What to deliver now that ``message`` has come: nothing, it, or the held one and it.

        Args:
            message: The newcomer.
            stamp: Its stamp.
            serial: Serial number in it, which stands for a sender that does not name its run.
            arrived_ns: When it came, host monotonic clock [ns].
            lost_here: Messages of this source that this process had dropped before it, in all.
        """
        new = _Point(message, stamp, stamp.session_id or serial, arrived_ns, lost_here)
        last, held = self._last, self._held
        if last is None:
            return self._accept(new, certain=False)
        if (
            held is None
            and stamp.sequence == last.stamp.sequence + 1
            and new.sender == last.sender
            and lost_here == last.lost_here
        ):
            # Nearly every message: the rules below would say the same, and take longer.
            self._established, self._dropped_here = True, False
            return self._accept(new, certain=True)
        if new.sender != last.sender and not self._may_change(last, new):
            self._counters["other_session"] += 1
            return ()
        if self._follows(last, new):
            self._established = True
            if held is not None:
                self._refuse(held, last)
            return self._accept(new, certain=self._count_hole(last, new) <= 0)
        if self._trusting or (new.sender != last.sender and self._announced(new.sender)):
            if self._is_overtaken(last, new):
                self._counters["reordered"] += 1
                return ()
            self._count_jump(last, new)
            return self._accept(new, certain=False)
        if held is not None and self._follows(held, new):
            self._count_jump(last, held)
            self._count_hole(held, new)
            self._established = True
            self._accept(new, certain=True)
            return (held.message, message)
        if self._is_overtaken(last, new):
            self._counters["reordered"] += 1
            return ()
        if held is not None:
            if held.sender not in (last.sender, new.sender) and self._young(held, new):
                self._counters["other_session"] += 1  # of two newcomers the first has its chance
                return ()
            self._refuse(held, last)
        self._held = new
        return ()

    def _accept(self, point: _Point[R], *, certain: bool) -> Sequence[R]:
        point.certain = certain
        self._last, self._held = point, None
        return (point.message,)

    def _may_change(self, last: _Point[R], new: _Point[R]) -> bool:
        """Whether another sender than the followed one may be followed."""
        if self._trusting or not self._established:
            return True
        holders = self._holders()
        if holders is not None and last.sender in holders:
            return False  # its gateway lives, whether it has something to say or not
        return self._announced(new.sender) or not self._young(last, new)

    def _announced(self, sender: Sender) -> bool:
        holders = self._holders()
        return holders is not None and sender in holders

    def _follows(self, before: _Point[R], after: _Point[R]) -> bool:
        """Whether one message may come after another: a hole needs time to arise."""
        if before.sender != after.sender:
            return False
        step = after.stamp.sequence - before.stamp.sequence
        if step <= 0:
            return False
        hole = step - 1 - (after.lost_here - before.lost_here)
        passed_s = (after.arrived_ns - before.arrived_ns) * 1e-9
        return hole <= _FEW + passed_s * MOST_HZ

    def _is_overtaken(self, last: _Point[R], new: _Point[R]) -> bool:
        """Whether a message that does not follow the last one is an old one, or comes twice.

        A restarted sender counts from 1 again, by a later clock. A record that starts over has its
        old clock. A message that was only overtaken is a little older than the last by both.
        """
        step = new.stamp.sequence - last.stamp.sequence
        if step > 0 or new.sender != last.sender:
            return False
        later_ns = new.stamp.monotonic_ns - last.stamp.monotonic_ns
        if step == 0 and later_ns == 0:
            return True
        if later_ns > 0 or new.stamp.origin is Origin.REPLAYED or step < -_FAR_BACK:
            return False
        # The last message may be the wrong one, unless it is certain and others still follow it.
        return self._trusting or (last.certain and self._young(last, new))

    @staticmethod
    def _young(before: _Point[R], now: _Point[R]) -> bool:
        return now.arrived_ns - before.arrived_ns <= SILENT_NS

    def _count_hole(self, before: _Point[R], after: _Point[R]) -> int:
        """Count what is missing between two messages and was not dropped here."""
        hole = after.stamp.sequence - before.stamp.sequence - 1
        hole -= after.lost_here - before.lost_here
        if hole > 0 and self._contiguous:
            self._counters["dropped" if self._dropped_here else "lost_on_bus"] += hole
        self._dropped_here = False
        return hole

    def _count_jump(self, last: _Point[R], new: _Point[R]) -> None:
        """Count a jump that turned out to be true."""
        if new.sender != last.sender:
            self._counters["restarts"] += 1
        elif new.stamp.sequence > last.stamp.sequence:
            self._count_hole(last, new)
        elif last.certain or self._trusting:
            self._counters["restarts"] += 1
        else:
            self._counters["delivered_implausible"] += 1  # the last one was wrong, not this one

    def _refuse(self, held: _Point[R], last: _Point[R]) -> None:
        """Count a held message that nothing has followed."""
        if held.sender != last.sender:
            self._counters["other_session"] += 1
            return
        late = held.stamp.sequence < last.stamp.sequence
        older = held.stamp.monotonic_ns <= last.stamp.monotonic_ns
        self._counters["reordered" if late and older else "rejected_implausible"] += 1


class Holes:
    """Counts by key what is missing between the messages of contiguous topics that came.

    For those who take every message as it comes, e.g. to record it.
    """

    def __init__(self) -> None:
        self._sources: dict[str, tuple[Counter[str], Continuity[None]]] = {}

    def take(
        self, key: str, stamp: Stamp, *, arrived_ns: int, serial: str = "", lost_here: int = 0
    ) -> int:
        """How many messages a newcomer shows to be missing, e.g. 0.

        ``serial``, ``arrived_ns`` and ``lost_here`` as in ``Continuity.take``.
        """
        if key not in self._sources:
            new: Counter[str] = Counter()
            self._sources[key] = new, Continuity(new, contiguous=True)
        counters, continuity = self._sources[key]
        before = counters["lost_on_bus"]
        continuity.take(None, stamp, serial=serial, arrived_ns=arrived_ns, lost_here=lost_here)
        return counters["lost_on_bus"] - before

    @property
    def lost(self) -> dict[str, int]:
        """How many are missing, by key; 0 = none between those that came."""
        return {key: counters["lost_on_bus"] for key, (counters, _) in self._sources.items()}
