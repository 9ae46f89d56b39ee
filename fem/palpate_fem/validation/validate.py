"""Validation: simulated against measured forces, as in the paper's table and figures.

Paper, "Finite element model validation" (methods and results): RMS error of each trajectory by the
formula of the cost, averaged for each indenter, and relative to the greatest force. The alignment
at 0.5 N hides an offset in depth, so the offset is listed too.

Compared with simulations, this is a self-test of the program and no validation: it says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, median

import numpy as np

from palpate_fem.calibration.align import (
    INCREMENTS,
    THRESHOLD_N,
    Aligned,
    Unalignable,
    align,
    curve,
)
from palpate_fem.calibration.cost import axis_rms_n, peak_n, relative_rms, rms_n
from palpate_fem.calibration.measured import SIMULATED, Indentation
from palpate_fem.calibration.runs import Simulated
from palpate_fem.result import IndentationOutcome

PAPER_RANGE_N = (0.226, 0.486)
"""Mean RMS force error of the best and the worst indenter (paper, "Finite element model
validation")."""
PAPER_MEDIAN_N = 0.260
"""Median of the indenters' means (same place)."""
PAPER_INDENTER_N = {"texture": 0.226, "ring": 0.486}
"""The indenters whose mean the paper names."""
PAPER_RELATIVE = {"cylinder_small": "least", "sphere_small": "greatest"}
"""Relative errors of which the paper gives the order, not the value."""


@dataclass(frozen=True, slots=True)
class Compared:
    """One trajectory.

    Attributes:
        name: Of the trajectory, with its sensor if the file has several.
        indenter: Its indenter.
        sensor: Its sensor.
        rms_n: RMS force error, sum of the axes [N].
        axis_rms_n: The same for each axis [N].
        peak_n: Greatest measured force in the compared part [N].
        relative: RMS error over the greatest force.
        depth_offset_m: By how much the simulation reaches 0.5 N later [m].
        displacement_m: Compared displacement from there [m].
        coverage: Its part of the measured one.
        outcome: How the simulation ended.
        pair: The curves.
    """

    name: str
    indenter: str
    sensor: str
    rms_n: float
    axis_rms_n: tuple[float, ...]
    peak_n: float
    relative: float
    depth_offset_m: float
    displacement_m: float
    coverage: float
    outcome: IndentationOutcome
    pair: Aligned

    @property
    def path_name(self) -> str:
        """Name without the sensor: what sensors that were pressed alike have in common."""
        return self.name.removesuffix(f"/{self.sensor}")


@dataclass(frozen=True, slots=True)
class ByIndenter:
    """Means over the trajectories of one indenter."""

    indenter: str
    trajectories: int
    rms_n: float
    relative: float
    depth_offset_m: float
    depth_offset_sd_m: float
    coverage: float


@dataclass(frozen=True, slots=True)
class Validation:
    """What a comparison of all trajectories gave.

    Attributes:
        compared: One entry for each compared trajectory, in the order of the measurements.
        excluded: Name and reason of each that was not compared.
        outcomes: How many simulations ended how, those excluded too.
        self_test: Whether the "measurements" are simulations themselves.
        threshold_n: Force at which curves were aligned [N].
    """

    compared: tuple[Compared, ...]
    excluded: dict[str, str]
    outcomes: dict[str, int]
    self_test: bool
    threshold_n: float

    @property
    def by_indenter(self) -> tuple[ByIndenter, ...]:
        """Means of each indenter, sorted by name."""
        found = []
        for indenter in sorted({item.indenter for item in self.compared}):
            items = [item for item in self.compared if item.indenter == indenter]
            offsets = [item.depth_offset_m for item in items]
            found.append(
                ByIndenter(
                    indenter,
                    len(items),
                    mean(item.rms_n for item in items),
                    mean(item.relative for item in items),
                    mean(offsets),
                    float(np.std(offsets)),
                    mean(item.coverage for item in items),
                )
            )
        return tuple(found)

    @property
    def median_n(self) -> float:
        """Median of the indenters' mean RMS errors [N]; NaN without any."""
        means = [item.rms_n for item in self.by_indenter]
        return median(means) if means else float("nan")

    @property
    def title(self) -> str:
        """What this is, for every table and figure."""
        if self.self_test:
            return "SELF-TEST: simulation against simulations, no measurement is involved"
        return "simulation against measurement"


def validate(
    measured: Sequence[Indentation],
    simulated: Mapping[str, Simulated],
    *,
    threshold_n: float = THRESHOLD_N,
    increments: int = INCREMENTS,
) -> Validation:
    """Compare each measured trajectory with its simulation.

    Args:
        measured: What was measured; simulations in their place make it a self-test.
        simulated: By the name of the measured trajectory, along the same path.
        threshold_n: Force at which curves are aligned [N].
        increments: Samples of a curve.
    """
    compared, excluded = [], {}
    for item in measured:
        run = simulated.get(item.name)
        if run is None:
            excluded[item.name] = "not simulated"
            continue
        try:
            compared.append(_compare(item, run, threshold_n, increments))
        except Unalignable as error:
            why = f" ({run.outcome}: {run.reason})" if run.reason else ""
            excluded[item.name] = error.problem + (why if error.side == "simulation" else "")
    known = Counter(
        str(simulated[item.name].outcome) for item in measured if item.name in simulated
    )
    return Validation(
        tuple(compared),
        excluded,
        dict(sorted(known.items())),
        any(item.origin == SIMULATED for item in measured),
        threshold_n,
    )


def _compare(item: Indentation, run: Simulated, threshold_n: float, increments: int) -> Compared:
    pair = align(
        run.curve, curve(item.pose, item.force), threshold_n=threshold_n, increments=increments
    )
    return Compared(
        item.name,
        item.indenter,
        item.sensor,
        rms_n(pair),
        tuple(axis_rms_n([pair]).tolist()),
        peak_n(pair),
        relative_rms(pair),
        pair.depth_offset_m,
        float(pair.displacement_m[-1]),
        pair.coverage,
        run.outcome,
        pair,
    )
