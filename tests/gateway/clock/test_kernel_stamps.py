from __future__ import annotations

import numpy as np

from palpate_gateway.clock.wall_clock import ClockPair, KernelStamps, WallClock

S = 1_000_000_000
NOW_NS, WALL_NS = 1_000 * S, 1_790_000_000 * S


def stamps() -> KernelStamps:
    """With a wall clock that nobody sets."""
    return KernelStamps(WallClock(lambda: ClockPair(NOW_NS, WALL_NS, 0)))


def test_a_stamp_tells_when_it_was_received() -> None:
    kernel = stamps()
    assert kernel.monotonic_of_ns(WALL_NS - S // 5, NOW_NS) == NOW_NS - S // 5


def test_none_came_later_than_what_came_after_it() -> None:
    ms = S // 1000
    told = np.array([-1, -2 * ms, -40 * ms, 5 * S, -30 * ms, -20 * ms, 5 * S], np.int64)
    got = stamps().monotonic_of_all(WALL_NS + told, NOW_NS)
    assert ((got - NOW_NS) // ms).tolist() == [-40, -40, -40, -30, -30, -20, 0]


def test_one_of_the_past_or_the_future_is_of_another_clock() -> None:
    kernel = stamps()
    kernel.monotonic_of_ns(WALL_NS, NOW_NS)
    for stamp_ns in (WALL_NS - 3 * S, WALL_NS + S):
        assert kernel.monotonic_of_ns(stamp_ns, NOW_NS) == NOW_NS


def test_what_waited_while_the_process_stood_still_is_as_old_as_it_says() -> None:
    kernel = stamps()
    kernel.monotonic_of_ns(WALL_NS - 10 * S, NOW_NS - 10 * S)
    for k in range(90):
        old_ns = (90 - k) * S // 10
        got_ns = kernel.monotonic_of_ns(WALL_NS - old_ns, NOW_NS + k * 1000)
        assert got_ns == NOW_NS - old_ns
    many = np.array([WALL_NS - 9 * S, WALL_NS - S], np.int64)
    got = kernel.monotonic_of_all(many, NOW_NS + S // 2)
    assert got.tolist() == [NOW_NS - 9 * S, NOW_NS - S]
    # All that had waited has been read: now such a stamp is another clock's again.
    for k in range(11, 40):
        kernel.monotonic_of_ns(WALL_NS + k * S // 20, NOW_NS + k * S // 20)
    assert kernel.monotonic_of_ns(WALL_NS - 9 * S, NOW_NS + 2 * S) == NOW_NS + 2 * S
