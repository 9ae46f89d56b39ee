"""The wall clock beside the monotonic one: steps are followed and told, noise is not."""

from __future__ import annotations

import gc
import sys
import time

import numpy as np
import pytest

from palpate.clock import since_boot_ns
from palpate_gateway.clock.wall_clock import (
    LOOK_NS,
    OLDEST_NS,
    ClockPair,
    KernelStamps,
    WallClock,
    WallDiscipline,
    read_pair,
    wall_discipline,
)

EPOCH_NS = 1_700_000_000_000_000_000
S = 1_000_000_000


class Clocks:
    """A host whose clocks stand where a test puts them."""

    def __init__(self) -> None:
        self.now_ns = 5 * S
        self.offset_ns = EPOCH_NS
        self.apart_ns = 1000
        self.asleep_ns = 0
        self.looks = 0

    def read(self) -> ClockPair:
        self.looks += 1
        wall_ns = self.now_ns + self.offset_ns
        return ClockPair(self.now_ns, wall_ns, self.apart_ns, self.asleep_ns)

    def sleep(self, slept_ns: int) -> None:
        """The monotonic clock stands still, the others go on."""
        self.offset_ns += slept_ns
        self.asleep_ns += slept_ns


@pytest.fixture
def clocks() -> Clocks:
    return Clocks()


@pytest.fixture
def wall(clocks: Clocks) -> WallClock:
    return WallClock(clocks.read)


@pytest.fixture
def stamps(wall: WallClock) -> KernelStamps:
    return KernelStamps(wall)


def test_the_two_clocks_are_read_together() -> None:
    before_ns = time.monotonic_ns()
    pair = read_pair()
    assert before_ns <= pair.monotonic_ns <= time.monotonic_ns()
    assert abs(pair.wall_ns - time.time_ns()) < 10 * S
    assert abs(pair.monotonic_ns + pair.asleep_ns - since_boot_ns()) < 10 * S
    assert pair.apart_ns >= 0


def test_a_step_is_followed_and_told_and_monotonic_times_know_nothing(
    wall: WallClock, clocks: Clocks
) -> None:
    assert wall.at(4 * S, now_ns=clocks.now_ns) == EPOCH_NS + 4 * S
    clocks.offset_ns -= S // 4
    clocks.now_ns += LOOK_NS + 1
    assert wall.at(5 * S, now_ns=clocks.now_ns) == EPOCH_NS - S // 4 + 5 * S
    assert wall.steps == 1
    clocks.now_ns += LOOK_NS + 1
    wall.at(5 * S, now_ns=clocks.now_ns)
    assert wall.steps == 1


def test_it_is_not_looked_at_for_every_reading(wall: WallClock, clocks: Clocks) -> None:
    for k in range(1000):
        wall.at(k, now_ns=clocks.now_ns + k)
    assert clocks.looks == 1


def test_a_reading_that_was_interrupted_is_no_step(wall: WallClock, clocks: Clocks) -> None:
    clocks.offset_ns += 5_000_000
    clocks.apart_ns = 10_000_000
    wall.look()
    assert wall.steps == 0
    assert wall.offset_ns == EPOCH_NS


def test_a_monotonic_clock_that_is_not_steered_drifts_without_steps(
    wall: WallClock, clocks: Clocks
) -> None:
    for _ in range(100):
        clocks.now_ns += S
        clocks.offset_ns += 50_000  # 50 ppm
        wall.look()
    assert wall.steps == 0
    assert abs(wall.offset_ns - clocks.offset_ns) <= 2 * clocks.apart_ns


def test_that_the_host_was_asleep_is_no_step(
    wall: WallClock, clocks: Clocks, caplog: pytest.LogCaptureFixture
) -> None:
    slept_ns = 3600 * S
    clocks.sleep(slept_ns)
    clocks.now_ns += LOOK_NS + 1
    woke_ns = clocks.now_ns
    assert wall.at(4 * S, now_ns=woke_ns) == EPOCH_NS + 4 * S, "it was then"
    assert wall.at(woke_ns + 1, now_ns=woke_ns) == EPOCH_NS + slept_ns + woke_ns + 1
    assert wall.steps == 0
    assert "asleep for 3600.000 s" in caplog.text
    # That the clock is set just afterwards is a step all the same.
    clocks.offset_ns -= S // 4
    clocks.now_ns += LOOK_NS + 1
    assert wall.at(clocks.now_ns, now_ns=clocks.now_ns) == clocks.now_ns + clocks.offset_ns
    assert wall.steps == 1


def test_what_came_before_the_host_slept_is_no_fresher_than_that(
    stamps: KernelStamps, wall: WallClock, clocks: Clocks
) -> None:
    stamps.monotonic_of_ns(EPOCH_NS + clocks.now_ns, clocks.now_ns)
    came_ns = clocks.now_ns + 1_000_000
    clocks.now_ns += 10_000_000
    clocks.sleep(3600 * S)
    clocks.now_ns += 5_000_000
    read_ns = clocks.now_ns
    fresh_ns = read_ns - 40_000
    told_ns = EPOCH_NS + came_ns, clocks.offset_ns + fresh_ns
    assert [stamps.monotonic_of_ns(one, read_ns) for one in told_ns] == [came_ns, fresh_ns]
    assert stamps.monotonic_of_all(np.array(told_ns), read_ns).tolist() == [came_ns, fresh_ns]
    assert wall.at(came_ns, now_ns=read_ns) == EPOCH_NS + came_ns


def test_kernel_stamps_become_monotonic(stamps: KernelStamps, clocks: Clocks) -> None:
    arrival_ns = clocks.now_ns
    stamp_ns = EPOCH_NS + arrival_ns - 300_000
    assert stamps.monotonic_of_ns(stamp_ns, arrival_ns) == arrival_ns - 300_000
    # As a float it is known to a quarter of a microsecond.
    assert abs(stamps.monotonic_ns(stamp_ns * 1e-9, arrival_ns) - arrival_ns + 300_000) < 500


def test_a_stamp_is_never_after_the_arrival(stamps: KernelStamps, clocks: Clocks) -> None:
    arrival_ns = clocks.now_ns
    assert stamps.monotonic_of_ns(EPOCH_NS + arrival_ns + 50_000, arrival_ns) == arrival_ns


@pytest.mark.parametrize(
    "stamp_s",
    [0.0, 12.5, float("nan"), float("inf"), -1.0, 1e-9 * EPOCH_NS + 6.0, 1e-9 * EPOCH_NS + 3.9],
)
def test_a_stamp_that_cannot_be_is_refused(
    stamps: KernelStamps, clocks: Clocks, stamp_s: float
) -> None:
    assert stamps.monotonic_ns(stamp_s, clocks.now_ns) == clocks.now_ns


def test_around_a_step_arrivals_stand_for_stamps(stamps: KernelStamps, clocks: Clocks) -> None:
    stamp_ns = EPOCH_NS + clocks.now_ns
    assert stamps.monotonic_of_ns(stamp_ns, clocks.now_ns) == clocks.now_ns
    # Received before the clock was set back by 0.3 s, read after it.
    clocks.now_ns += 2_000_000
    clocks.offset_ns -= 300_000_000
    assert stamps.monotonic_of_ns(stamp_ns + 1_000_000, clocks.now_ns) == clocks.now_ns
    # Forward, the same stamp would seem to be 0.7 s old.
    clocks.now_ns += 2_000_000
    clocks.offset_ns += S
    old_ns = clocks.offset_ns - S + clocks.now_ns - 1_000_000
    assert stamps.monotonic_of_ns(old_ns, clocks.now_ns) == clocks.now_ns
    clocks.now_ns += OLDEST_NS + 1
    new_ns = clocks.offset_ns + clocks.now_ns - 40_000
    assert stamps.monotonic_of_ns(new_ns, clocks.now_ns) == clocks.now_ns - 40_000


def test_a_batch_needs_one_look(stamps: KernelStamps, clocks: Clocks) -> None:
    arrivals = [clocks.now_ns + 1000 * k for k in range(200)]
    clocks.now_ns += S
    looks = clocks.looks
    for arrival_ns in arrivals:
        stamps.monotonic_of_ns(EPOCH_NS + arrival_ns - 100, arrival_ns)
    assert clocks.looks == looks + 1


def test_the_kernel_tells_how_the_wall_clock_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = wall_discipline()
    if kept is not None:  # a sandbox may forbid to ask
        assert isinstance(kept, WallDiscipline)
        assert 0.0 <= kept.error_s < 1e4
    monkeypatch.setattr(sys, "platform", "darwin")
    assert wall_discipline() is None


def test_to_ask_for_the_discipline_leaves_no_garbage() -> None:
    """It is asked for each second, and a service makes no full garbage collection."""
    wall_discipline()
    gc.collect()
    gc.disable()
    try:
        for _ in range(100):
            wall_discipline()
        assert gc.collect() < 100
    finally:
        gc.enable()
