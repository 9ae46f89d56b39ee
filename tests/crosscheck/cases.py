"""The elastic problems at the sizes that are compared, and how each is measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.crosscheck import cook, plate, punch, sphere
from tests.crosscheck.problem import Problem, Solution


@dataclass(frozen=True)
class Case:
    """A problem at one size.

    Attributes:
        make: Builds the problem.
        measure: Its figures from a solution.
        taylor_hood: Whether the same nodes also carry quadratic elements.
        seconds: About how long Q1P0 takes in felupe on one busy core.
    """

    make: Callable[[], Problem]
    measure: Callable[[Problem, Solution], dict[str, float]]
    taylor_hood: bool = False
    seconds: float = 1.0


def _cases() -> dict[str, Case]:
    cases: dict[str, Case] = {}
    for around, through, seconds in ((4, 2, 1), (8, 4, 2), (12, 4, 4), (16, 4, 9)):
        cases[f"sphere {around}x{around}x{through}"] = Case(
            lambda a=around, t=through: sphere.inflation(a, t),  # type: ignore[misc]
            sphere.measure,
            taylor_hood=around <= 12,
            seconds=seconds,
        )
    for count, seconds in ((4, 1), (8, 1), (16, 1), (32, 2)):
        cases[f"cook {count}"] = Case(
            lambda n=count: cook.membrane(n),  # type: ignore[misc]
            cook.measure,
            seconds=seconds,
        )
    for per_mm, seconds in ((1, 1), (2, 2), (3, 15)):
        cases[f"punch {per_mm}/mm"] = Case(
            lambda n=per_mm: punch.pressed(n),  # type: ignore[misc]
            punch.measure,
            seconds=seconds,
        )
    sizes = ((8, 2, 1), (8, 4, 1), (16, 2, 2), (16, 4, 4), (24, 6, 9), (32, 8, 31))
    for across, through, seconds in sizes:
        name = f"{across}x{across}x{through}"
        cases[f"inflated plate {name}"] = Case(
            lambda a=across, t=through: plate.inflated(a, t),  # type: ignore[misc]
            plate.measure_inflated,
            taylor_hood=True,
            seconds=seconds,
        )
    for across, through, seconds in ((8, 2, 1), (16, 2, 2), (16, 4, 4), (24, 4, 8), (32, 6, 30)):
        name = f"{across}x{across}x{through}"
        cases[f"squeezed plate {name}"] = Case(
            lambda a=across, t=through: plate.squeezed(a, t),  # type: ignore[misc]
            plate.measure_squeezed,
            taylor_hood=True,
            seconds=seconds,
        )
    return cases


CASES = _cases()
QUICK = [
    "sphere 4x4x2", "cook 8", "punch 1/mm", "inflated plate 8x8x2", "squeezed plate 8x8x2",
]  # fmt: skip
