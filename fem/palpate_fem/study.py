"""Convergence study of mesh and steps (``palpate fem study``).

Three indentations of 3 mm up into the pad, 4 mm from the middle of the finger: a sphere, the cube
tilted by 30 degrees so that its edge presses, and the ring.
"""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator

from palpate_fem.arrays import Floats
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationOutcome
from palpate_fem.trajectory import press_path

EDGES_M = (1.0e-3, 0.7e-3, 0.5e-3, 0.35e-3)
STEPS = (10, 20, 40, 80)
PRESSES = {
    "sphere_medium": (0.0, 0.0, 1.0),
    "cube": (0.5, 0.0, 0.75**0.5),
    "ring": (0.0, 0.0, 1.0),
}
TARGET_M = (-4e-3, 0.0, -7.5e-3)
DEPTH_M = 3e-3

SCALE_M = 1e-3
"""Unit of length of the interpolation, for a well-conditioned system [m]."""

FORCE_CHANGE = 0.02
"""Accepted relative change of the force by the last refinement."""

DISPLACEMENT_CHANGE_M = 0.02e-3
"""Accepted mean change of the skin's displacement by the last refinement [m]."""


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One indentation of a study.

    Attributes:
        indenter: Name of the indenter.
        edge_m: Edge of the mesh [m].
        steps: Steps of the path.
        unknowns: Number of unknowns.
        outcome: How the indentation ended.
        force_n: Force at the end [N].
        force_change: Relative change of the force to the row before; NaN in the first.
        displacement_change_m: Mean change over the outer nodes of the coarser mesh [m].
        largest_change_m: Largest change of a node [m].
        iterations: Newton iterations of all steps.
        seconds: Computing time of the indentation.
        factor_gflop: Operations of one whole factorisation.
        peak_mib: Peak memory of the process so far.
    """

    indenter: str
    edge_m: float
    steps: int
    unknowns: int
    outcome: str
    force_n: float
    force_change: float
    displacement_change_m: float
    largest_change_m: float
    iterations: int
    seconds: float
    factor_gflop: float
    peak_mib: float

    @property
    def accepted(self) -> bool:
        """Whether this refinement changed little enough."""
        return (
            abs(self.force_change) < FORCE_CHANGE
            and self.displacement_change_m < DISPLACEMENT_CHANGE_M
        )

    def plain(self) -> dict[str, object]:
        """As values for JSON; NaN becomes null."""
        values = asdict(self)
        return {k: None if v != v else v for k, v in values.items()} | {"accepted": self.accepted}


def mesh_study(
    *,
    edges_m: Sequence[float] = EDGES_M,
    steps: int = 20,
    on_row: Callable[[StudyRow], None] | None = None,
) -> list[StudyRow]:
    """The indentations on finer and finer meshes."""
    tips = ((Fingertip.pressurised(biotac(edge_m=edge)), edge, steps) for edge in edges_m)
    return _study(tips, on_row)


def step_study(
    *,
    edge_m: float = 0.5e-3,
    steps: Sequence[int] = STEPS,
    on_row: Callable[[StudyRow], None] | None = None,
) -> list[StudyRow]:
    """The indentations in smaller and smaller steps."""
    tip = Fingertip.pressurised(biotac(edge_m=edge_m))
    return _study(((tip, edge_m, count) for count in steps), on_row)


def _study(
    refinements: Iterable[tuple[Fingertip, float, int]], on_row: Callable[[StudyRow], None] | None
) -> list[StudyRow]:
    """Run all indentations for each fingertip, edge [m] and number of steps."""
    rows: list[StudyRow] = []
    last: dict[str, _SkinDisplacement] = {}
    for tip, edge, steps in refinements:
        for name in PRESSES:
            rows.append(_press(tip, name, edge, steps, last))
            if on_row is not None:
                on_row(rows[-1])
    return rows


@dataclass(frozen=True, slots=True)
class _SkinDisplacement:
    """Displacement of the outer skin at the last refinement."""

    nodes: Floats
    displacement: Floats
    force: float


def _press(
    tip: Fingertip, name: str, edge: float, steps: int, last: dict[str, _SkinDisplacement]
) -> StudyRow:
    indenter, mesh = make_indenter(name), tip.geometry.mesh
    surface = OuterSurface(tip.nodes, mesh.outer_faces)
    path = press_path(indenter, TARGET_M, PRESSES[name], surface, depth_m=DEPTH_M, steps=steps)
    trajectory = tip.indent(indenter, path)
    force = float(np.linalg.norm(trajectory.forces[-1])) if trajectory.steps else float("nan")
    change = mean = largest = float("nan")
    if trajectory.outcome is IndentationOutcome.COMPLETE:
        now = _SkinDisplacement(
            tip.nodes[mesh.outer_nodes], trajectory.steps[-1].displacement[mesh.outer_nodes], force
        )
        if name in last:
            change = (force - last[name].force) / force
            moved = (
                now.displacement if now.nodes is last[name].nodes else _at(now, last[name].nodes)
            )
            away = np.linalg.norm(moved - last[name].displacement, axis=1)
            mean, largest = float(away.mean()), float(away.max())
        last[name] = now
    return StudyRow(
        indenter=name,
        edge_m=edge,
        steps=steps,
        unknowns=len(tip.system.pattern.free),
        outcome=str(trajectory.outcome),
        force_n=force,
        force_change=change,
        displacement_change_m=mean,
        largest_change_m=largest,
        iterations=sum(step.convergence.iterations for step in trajectory.steps),
        seconds=trajectory.seconds,
        factor_gflop=_gflop(tip),
        peak_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )


def _at(field: _SkinDisplacement, points: Floats) -> Floats:
    """A field at other points of the skin [m]; at its own nodes it is itself."""
    between = RBFInterpolator(
        field.nodes / SCALE_M, field.displacement, neighbors=16, kernel="linear", degree=0
    )
    return np.asarray(between(points / SCALE_M))


def _gflop(tip: Fingertip) -> float:
    statistics = getattr(tip.newton.factor, "statistics", {})
    return float(statistics.get("factor_gflop", float("nan")))
