"""Studies of the solver (``palpate fem study``): mesh and steps, and random paths.

Mesh and steps: three indentations of 3 mm up into the pad, 4 mm from the middle of the finger: a
sphere, the cube tilted by 30 degrees so that its edge presses, and the ring; and the sphere 4 mm
deep, where it pinches the skin on the core.

Paths: an indenter presses at a random place, slides, twists, rolls, goes on or back, and leaves.
Whatever it did, friction may only have taken work, and the skin must be as it was before.
"""

from __future__ import annotations

import math
import resource
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from palpate_fem.arrays import Floats
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.path import PathSegment, parse_segments, show_segments
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.iteration import NewtonReport
from palpate_fem.mechanics.load_stepping import LoadStepping
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationOutcome
from palpate_fem.trajectory import Region, pad_point, press_path, sample_targets, segment_path

EDGES_M = (1.0e-3, 0.7e-3, 0.5e-3, 0.35e-3, 0.25e-3)
STEPS = (10, 20, 40, 80)
TARGET_M = (-4e-3, 0.0, -7.5e-3)


@dataclass(frozen=True, slots=True)
class StudyPress:
    """A press of the studies of mesh and steps: indenter, direction, and depth [m]."""

    indenter: str
    direction: tuple[float, float, float]
    depth_m: float


PRESSES = {
    "sphere_medium": StudyPress("sphere_medium", (0.0, 0.0, 1.0), 3e-3),
    "cube": StudyPress("cube", (0.5, 0.0, 0.75**0.5), 3e-3),
    "ring": StudyPress("ring", (0.0, 0.0, 1.0), 3e-3),
    # The ball again, until it has squeezed the skin on the core to a sixth of its thickness.
    "pinch": StudyPress("sphere_medium", (0.0, 0.0, 1.0), 4e-3),
}

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
        press: Name of the press, in `PRESSES`.
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

    press: str
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
    press, mesh = PRESSES[name], tip.geometry.mesh
    indenter = make_indenter(press.indenter)
    surface = OuterSurface(tip.nodes, mesh.outer_faces)
    path = press_path(
        indenter, TARGET_M, press.direction, surface, depth_m=press.depth_m, steps=steps
    )
    trajectory = tip.indent(indenter, path)
    force = float(np.linalg.norm(trajectory.forces[-1])) if trajectory.steps else float("nan")
    change = mean = largest = float("nan")
    if trajectory.outcome is IndentationOutcome.COMPLETE:
        now = _SkinDisplacement(
            tip.nodes[mesh.outer_nodes], trajectory.steps[-1].displacement[mesh.outer_nodes], force
        )
        if name in last:
            change = (force - last[name].force) / force
            same = np.array_equal(now.nodes, last[name].nodes)
            moved = now.displacement if same else _at(now, last[name].nodes)
            away = np.linalg.norm(moved - last[name].displacement, axis=1)
            mean, largest = float(away.mean()), float(away.max())
        last[name] = now
    return StudyRow(
        press=name,
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


AWAY_M, AWAY_STEPS = 1e-3, 3
"""Beyond its end a path goes on out of the skin [m], as means of gaps over coarse faces close
early: by half a millimetre on faces of 0.8 mm and an edge of R 0.2 mm. In steps, as one leaves
something of the mortar correction's error where the skin rests on the core."""

UNDONE_M = 1e-8
"""Accepted displacement of any node once the indenter has left [m]."""

WORK_SHARE = 1e-4
"""Share of a path's work of friction that one increment may give back by the solver's tolerance.

A traction is right to 1 % of the largest, so the energy of the springs that tie sticking points to
the indenter, which stretch by a micrometre, is not known better: 3e-11 J where 1e-6 J were taken.
"""

COMPLETE_SHARE = 0.97
"""Share of random paths that must go to the end."""

PATHS = 100
PATH_DEPTH_M = (0.5e-3, 2.5e-3)
PATH_SLIDE_M = (0.2e-3, 2.0e-3)
PATH_TWIST_DEG, PATH_ROLL_DEG, PATH_ANGLE_DEG = 40.0, 20.0, 30.0


@dataclass(frozen=True, slots=True)
class PathRow:
    """One random path of a study; ``palpate fem run`` with the same words runs it again.

    Attributes:
        indenter: Name of the indenter.
        at_mm: Target on the pad [mm].
        words: Its segments, see `parse_segments`.
        steps: Steps of the path.
        done: Steps that converged.
        outcome: How it ended.
        reason: Why, if it is not complete.
        force_n: Largest net force [N].
        work_j: Work of the indenter on the skin [J]. After a whole path all of it went into
            friction, but for what the increments leave out.
        friction_j: Work that friction took [J].
        friction_least_j: Least that it took in one increment [J].
        undone_m: Largest displacement of a node after a whole path [m], else NaN.
        increments: Increments of the load.
        iterations: Newton iterations.
        seconds: Computing time.
    """

    indenter: str
    at_mm: tuple[float, float]
    words: str
    steps: int
    done: int
    outcome: str
    reason: str
    force_n: float
    work_j: float
    friction_j: float
    friction_least_j: float
    undone_m: float
    increments: int
    iterations: int
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether it went to the end."""
        return self.outcome == str(IndentationOutcome.COMPLETE)

    @property
    def took(self) -> bool:
        """Whether friction took work, and gave none in any increment."""
        return self.friction_least_j >= -WORK_SHARE * max(self.friction_j, 1e-9)

    @property
    def accepted(self) -> bool:
        """Whether friction took work only, and a whole path left nothing behind."""
        return self.took and (not self.complete or self.undone_m <= UNDONE_M)

    def plain(self) -> dict[str, object]:
        """As values for JSON; NaN becomes null."""
        values = asdict(self)
        return {k: None if v != v else v for k, v in values.items()} | {"accepted": self.accepted}


def path_study(
    *,
    edge_m: float,
    count: int = PATHS,
    seed: int = 0,
    fluid_volume_m3: float | None = None,
    on_row: Callable[[PathRow], None] | None = None,
) -> list[PathRow]:
    """Random paths, each over the whole set of indenters in turn.

    Args:
        edge_m: Edge of the mesh [m].
        count: Number of paths; more of them begin alike.
        seed: Of the paths.
        fluid_volume_m3: Fill [m^3]; None = what 15.1 mm of thickness need.
        on_row: Called with each path that ended.
    """
    parameters = replace(FingertipParameters(), fluid_volume_m3=fluid_volume_m3)
    tip = Fingertip.pressurised(biotac(edge_m=edge_m), parameters)
    rows = []
    for indenter, at_mm, words in random_paths(tip, count, seed):
        rows.append(run_path(tip, indenter, at_mm, words))
        if on_row is not None:
            on_row(rows[-1])
    return rows


def random_paths(
    tip: Fingertip, count: int, seed: int
) -> Iterator[tuple[str, tuple[float, float], str]]:
    """Indenter, target [mm] and segments in words of each of some random paths."""
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    names = indenter_names()
    for number in range(count):
        random = np.random.default_rng([seed, number])
        # Targets and amounts are rounded, so that the words say exactly what was run.
        (target,), _ = sample_targets(surface, 1, seed=[seed, number], region=Region())
        at_mm = (round(1e3 * float(target[0]), 2), round(1e3 * float(target[1]), 2))
        words = show_segments([*_random_segments(random), PathSegment("unload")])
        yield names[number % len(names)], at_mm, words


def _random_segments(random: np.random.Generator) -> Iterator[PathSegment]:
    """A press, mostly askew, and one to four further segments that never press far too deep."""

    def azimuth() -> float:
        return math.radians(round(float(random.uniform(0.0, 360.0))))

    depth_m = round(float(random.uniform(*PATH_DEPTH_M)), 5)
    angle = math.radians(round(float(random.uniform(0.0, PATH_ANGLE_DEG))))
    yield PathSegment("press", depth_m, angle, azimuth() if angle else 0.0)
    for _ in range(random.integers(1, 5)):
        kind = str(random.choice(["slide", "twist", "roll", "press", "unload"]))
        if kind == "slide":
            slide_m = round(float(random.uniform(*PATH_SLIDE_M)), 5)
            yield PathSegment(kind, slide_m, azimuth_rad=azimuth())
        elif kind in ("twist", "roll"):
            most = PATH_TWIST_DEG if kind == "twist" else PATH_ROLL_DEG
            turn = math.radians(round(float(random.uniform(2.0, most)), 1))
            turn *= random.choice([-1.0, 1.0]) if kind == "twist" else 1.0
            yield PathSegment(kind, turn, azimuth_rad=azimuth() if kind == "roll" else 0.0)
        else:
            room_m = PATH_DEPTH_M[1] - depth_m if kind == "press" else depth_m
            way_m = round(float(random.uniform(0.2, 0.8)) * room_m, 5)
            if way_m > 0.0:
                depth_m += way_m if kind == "press" else -way_m
                yield PathSegment(kind, way_m)


def run_path(tip: Fingertip, name: str, at_mm: tuple[float, float], words: str) -> PathRow:
    """Follow one path and account for the work on the way."""
    indenter = make_indenter(name)
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    target, normal = pad_point(surface, 1e-3 * at_mm[0], 1e-3 * at_mm[1])
    path = segment_path(indenter, target, normal, parse_segments(words), surface)
    away = np.repeat(path[-1:], AWAY_STEPS, axis=0)
    away[:, :3] += np.linspace(0.5, 1.0, AWAY_STEPS)[:, None] * AWAY_M * normal
    path = np.concatenate([path, away])
    run = tip.load_stepping(indenter, path)
    ledger = _WorkLedger(run)
    result = run.run()
    complete = result.outcome is IndentationOutcome.COMPLETE
    left = result.steps[-1].displacement if complete else np.full((1, 3), np.nan)
    return PathRow(
        indenter=name,
        at_mm=at_mm,
        words=words,
        steps=len(path) - 1,
        done=len(result.steps),
        outcome=str(result.outcome),
        reason=result.reason,
        force_n=float(np.linalg.norm(result.forces, axis=1).max(initial=0.0)),
        work_j=sum(ledger.work),
        friction_j=sum(ledger.friction),
        friction_least_j=min(ledger.friction, default=0.0),
        undone_m=float(np.linalg.norm(left, axis=1).max()),
        increments=sum(step.convergence.increments for step in result.steps),
        iterations=sum(step.convergence.iterations for step in result.steps),
        seconds=result.seconds,
    )


_End = tuple[PosedIndenter, SolutionState, Floats]
"""An indenter, what is under it, and the nodal forces of the one on the other [N], (V, 3)."""


def _indenter_work(before: _End, after: _End) -> float:
    """Work of the indenter in one increment [J]: mean wrench at its tip times its motion."""
    forces, torques = [], []
    for indenter, state, load in (before, after):
        forces.append(load.sum(axis=0))
        torques.append(np.cross(state.position - indenter.tip, load).sum(axis=0))
    first, second = before[0], after[0]
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    along = (forces[0] + forces[1]) @ (second.tip - first.tip)
    return 0.5 * float(along + (torques[0] + torques[1]) @ turn)


class _WorkLedger:
    """The work of indenter and friction in each increment of an indentation [J].

    An increment that its load stepping takes back is taken back here, too.
    """

    def __init__(self, run: LoadStepping) -> None:
        self.work: list[float] = []
        self.friction: list[float] = []
        self._run, self._solve = run, run.increment
        self._after: list[SolutionState] = [run.at.state]
        run.increment = self._increment  # type: ignore[method-assign]

    def _increment(self, pose: Floats, length: float) -> tuple[NewtonReport, ForceBalance]:
        while self._after[-1] is not self._run.at.state:
            for entries in (self._after, self.work, self.friction):
                entries.pop()
        before = self._run.at
        report, balance = self._solve(pose, length)
        after = self._run.at
        if report.converged:
            self._after = [self._after[-1], after.state]
            ends = (
                (before.indenter, before.state, before.load),
                (after.indenter, after.state, after.load),
            )
            self.work.append(_indenter_work(*ends))
            self.friction.append(self._friction_work(before.state, after.state, after.indenter))
        return report, balance

    def _friction_work(
        self, before: SolutionState, after: SolutionState, indenter: PosedIndenter
    ) -> float:
        """Traction times slip times area: slip is how far the anchors of the points have moved."""
        surface = self._run.newton.system.outer
        touching = after.indenter_pressure > 0.0
        slip = (after.anchor - before.anchor) @ indenter.rotation.T
        power = np.einsum("fqi,fqi->fq", after.traction, slip) * surface.area_values
        return float(power[touching].sum())
