"""The chaos run's own arithmetic: what its report says follows from what the robot got."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from tests.chaos.faults import catalogue, schedule
from tests.chaos.report import holes, share_without

MS = 1_000_000


def _rows(*times_ms: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Rows with these stamps and arrivals."""
    return np.array(
        [[number, number, stamp * MS, arrival * MS, 1] for number, (stamp, arrival)
         in enumerate(times_ms, 1)], np.int64
    )  # fmt: skip


@pytest.mark.parametrize(
    ("times_ms", "expected_ms"),
    [
        ([(0, 5), (10, 15), (20, 25)], [(0, 5), (50, 100)]),
        ([(0, 5), (60, 65)], [(0, 5), (30, 65), (90, 100)]),
        ([(0, 5), (10, 50)], [(0, 5), (30, 100)]),  # it is too old when it comes
        ([(20, 25), (10, 26)], [(0, 25), (50, 100)]),  # an old one takes nothing away
    ],
)
def test_holes_are_where_no_fresh_estimate_is(
    times_ms: list[tuple[int, int]], expected_ms: list[tuple[int, int]]
) -> None:
    found = holes(_rows(*times_ms), 0, 100 * MS)
    assert [(begin // MS, end // MS) for begin, end in found] == expected_ms
    share = share_without(found, 0, 100 * MS)
    assert share == pytest.approx(sum(end - begin for begin, end in expected_ms) / 100)


@pytest.mark.parametrize("seed", range(20))
def test_every_fault_comes_and_systemd_never_gives_up(seed: int) -> None:
    drawn = list(itertools.islice(schedule(seed), len(catalogue()) + 3))
    assert {first.name for first, _, _ in drawn} == {fault.name for fault in catalogue()}
    units = [number for number, (first, _, _) in enumerate(drawn) if first.target == "unit"]
    close = sum(b - a < 2 for a, b in itertools.pairwise(units))
    assert close <= 2, "five starts within a minute, and the unit stays down"
    again = itertools.islice(schedule(seed), len(drawn))
    assert [(a.name, b and b.name, c) for a, b, c in drawn] == [
        (a.name, b and b.name, c) for a, b, c in again
    ]
    for first, second, _ in drawn:
        assert second is None or second.target != first.target
