"""Fingertips that solve nothing: quick, slow, stubborn, dying. Imported by worker processes.

The friction coefficient of a job says how its run behaves.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.batched.fingertip import UnsolvedPress
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.fingertips import OnFraction
from palpate_fem.store.content import StoredFingertip

if TYPE_CHECKING:
    from palpate.messages import SimulationRequest

sample_fingertip: Callable[[], StoredFingertip] = importlib.import_module(
    "stored_sample"
).sample_fingertip

QUICK, SLOW, STUBBORN, DIES, SEGFAULTS, DIVERGES, REFUSES, DEFECTIVE, PINCHES, NAN = (
    round(0.01 * k, 2) for k in range(10, 20)
)
UNSOLVED, APART = 0.2, 0.21
"""A device does not solve paths with an odd number of steps, and gives up after two; APART: its
forces are other than those of the CPU, too."""
HELD = 0.22
"""Makes two steps, and goes on when it is told to stop."""
SLOW_STEP_S = 0.12
MOST_SLOTS = 100
HALF = 0.007  # the finger is a cube of 14 mm


def cube(nodes: int) -> SolidMesh:
    """One element; more nodes than its eight lie at its corner, to make fields large."""
    corners = np.array(
        [[x, y, z] for z in (-HALF, HALF) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    corners[:, :2] *= HALF
    faces = np.array(
        [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    ).astype(np.int32)
    none = np.empty((0, 4), np.int32)
    return SolidMesh(
        np.concatenate([corners, np.repeat(corners[:1], nodes - 8, axis=0)]),
        np.arange(8, dtype=np.int32)[None],
        faces,
        np.zeros(6, np.int32),
        none,
        none[:, 0],
        none[:, 0],
        none[:, 0],
        name="cube",
    )


class FakeTip:
    """A fingertip whose answer is a formula."""

    def __init__(self, parameters: FingertipParameters, nodes: int) -> None:
        self.parameters = parameters
        self.mesh = cube(nodes)
        self.fingertip = StoredFingertip(
            self.mesh,
            self.parameters,
            {"fake": True},
            self.mesh.nodes,
            29e3,
            1.8e-6,
            2 * HALF,
            np.empty((0, 3)),
            np.empty((0, 3), np.int32),
        )

    def describe(self) -> StoredFingertip:
        return self.fingertip

    def indent(
        self,
        indenter: str,
        path: Floats,
        *,
        friction_coefficient: float,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
    ) -> IndentationResult:
        run = self.run(indenter, path, friction_coefficient, should_stop)
        while True:
            if friction_coefficient == SLOW:
                time.sleep(SLOW_STEP_S)
            try:
                step = next(run)
            except StopIteration as end:
                return cast("IndentationResult", end.value)
            if on_step is not None:
                on_step(step)

    def run(
        self,
        indenter: str,
        path: Floats,
        kind: float,
        should_stop: Callable[[], IndentationOutcome | None] | None,
    ) -> Generator[IndentationStep, None, IndentationResult]:
        """Yield each step and return the result."""
        began = time.monotonic()
        steps: list[IndentationStep] = []
        outcome, reason = IndentationOutcome.COMPLETE, ""
        for k in range(1, len(path)):
            while k == 3 and kind == HELD and should_stop is not None and should_stop() is None:
                time.sleep(0.01)
            stopped = None if should_stop is None else should_stop()
            if stopped is not None:
                outcome, reason = stopped, f"stopped at step {k}"
                break
            if k == 3:
                misbehave(kind)
            if k == 3 and kind in (DIVERGES, PINCHES):
                outcome = (
                    IndentationOutcome.DIVERGED
                    if kind == DIVERGES
                    else IndentationOutcome.FORCE_LIMIT
                )
                reason = "by design, 2.5 mm along the path"
                break
            steps.append(self.step(path[k], kind))
            yield steps[-1]
        return IndentationResult(
            indenter,
            path,
            tuple(steps),
            outcome,
            reason,
            travel_m=float(np.linalg.norm(np.diff(path[: len(steps) + 1, :3], axis=0))),
            seconds=time.monotonic() - began,
        )

    def on_device(
        self, indenters: Sequence[str], *, slots: int, device: str, friction_coefficient: float
    ) -> FakeSolver:
        if slots > MOST_SLOTS:
            raise RuntimeError("Failed to allocate 30064771072 bytes")
        return FakeSolver(self, tuple(indenters), slots, friction_coefficient)

    def step(self, pose: Floats, kind: float) -> IndentationStep:
        """Numbers that no float32 holds, so that rounding would show."""
        nodes = self.mesh.nodes
        field = nodes * (1.0 / 3.0) + pose[:3] / 7.0
        depth = pose[2] / 3.0
        force = np.array([depth, -depth / 7.0, depth * np.pi])
        return IndentationStep(
            pose=pose,
            displacement=field if kind != NAN else field * np.nan,
            fluid_pressure_pa=29e3 + depth / 11.0,
            force=force,
            torque=force / 13.0,
            indenter_force=field * 17.0,
            core_force=field * 0.0,
            contact_area_m2=abs(depth) / 19.0,
            centre_of_pressure=pose[:3] / 23.0 if depth > 0 else np.full(3, np.nan),
            stress=np.zeros((1, 6)),
            convergence=Convergence(1, 4, 4, 1e-9 / 3.0, 1e-12, 1e-6 / 3.0, 0.01),
        )


def misbehave(kind: float) -> None:
    """What a solver must not do."""
    if kind == STUBBORN:
        time.sleep(3600)
    elif kind == DIES:
        os._exit(7)
    elif kind == SEGFAULTS:
        os.kill(os.getpid(), signal.SIGSEGV)
    elif kind == REFUSES:
        raise SimulationError("the mesh is folded", remedy="make the skin thicker")
    elif kind == DEFECTIVE:
        raise ZeroDivisionError("a defect")


class FakeSolver:
    """Makes a step of all trajectories in its slots in every sweep."""

    def __init__(self, tip: FakeTip, indenters: tuple[str, ...], slots: int, kind: float) -> None:
        self.tip, self.indenters, self.slots, self.kind = tip, indenters, slots, kind

    def solve(
        self,
        presses: Iterator[Any],
        *,
        on_sweep: Callable[[int], None] | None = None,
        on_step: Callable[[int, IndentationStep], None] | None = None,
        should_stop: Callable[[int], IndentationOutcome | None] | None = None,
    ) -> Iterator[tuple[int, Any]]:
        waiting = iter(enumerate(presses))
        live: dict[int, tuple[Any, Any, list[IndentationStep]]] = {}
        while True:
            while len(live) < self.slots:
                number, press = next(waiting, (-1, None))
                if press is None:
                    break
                stop = None if should_stop is None else partial(should_stop, number)
                run = self.tip.run(self.indenters[press.indenter], press.path, self.kind, stop)
                live[number] = press, run, []
            if not live:
                return
            if on_sweep is not None:
                on_sweep(len(live))
            if self.kind == SLOW:
                time.sleep(SLOW_STEP_S)
            for number, (press, run, steps) in reversed(list(live.items())):
                odd = self.kind in (UNSOLVED, APART) and len(press.path) % 2 == 0
                if odd and len(steps) == 2:
                    del live[number]
                    name = self.indenters[press.indenter]
                    end = IndentationOutcome.DIVERGED, "no equilibrium", 1e-3, 0.1
                    result = IndentationResult(name, press.path, tuple(steps), *end)
                    yield number, UnsolvedPress(press, result)
                    continue
                try:
                    step = next(run)
                except StopIteration as end:
                    del live[number]
                    yield number, end.value
                    continue
                if self.kind == APART:
                    step = replace(step, force=1.1 * step.force)
                steps.append(step)
                if on_step is not None:
                    on_step(number, step)


class RoundTip(FakeTip):
    """A finger with a pad, whose forces depend on its parameters as one would think."""

    def __init__(self, parameters: FingertipParameters) -> None:
        self.parameters = parameters
        thinner = 1.57e-3 / parameters.skin_thickness_m
        self.fingertip = replace(
            sample_fingertip(), parameters=parameters, fluid_volume_m3=4.7e-7 * thinner
        )
        self.mesh = self.fingertip.mesh

    def step(self, pose: Floats, kind: float) -> IndentationStep:
        step = super().step(pose, kind)
        return replace(step, force=self.force(pose, kind), centre_of_pressure=pose[:3])

    def force(self, pose: Floats, friction: float) -> Floats:
        """Hertz on a pad at z = -7.8 mm over a hard core, and friction where it comes askew."""
        p = self.parameters
        w, x, y, z = pose[3:]
        askew = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 0.0])
        depth = max(0.0, pose[2] + 7.8e-3)
        normal = 2.0 * p.shear_modulus_pa * 3.5e-3**0.5 * depth**1.5
        normal *= 1.0 + (depth / p.skin_thickness_m) ** 2
        length = np.linalg.norm(askew)
        aside = friction * normal * askew / length if length > 1e-9 else askew
        force: Floats = np.array([0.0, 0.0, normal]) + aside
        return force


def round_finger(**options: object) -> Callable[[FingertipParameters, OnFraction], FakeTip]:
    """The factory of the commands' tests; takes the options of the real one."""
    return lambda parameters, on_fraction: RoundTip(parameters)


def make(
    *, nodes: int = 40, fill_s: float = 0.0, broken: str = "", broken_in: str = ""
) -> Callable[[FingertipParameters, OnFraction], FakeTip]:
    """The factory of these tests; says on stdout what libraries say there.

    ``broken_in`` names the module of the processes that are broken; none = all are.
    """
    if broken_in and Path(sys.argv[0]).stem != broken_in:
        broken = ""
    sys.stdout.write("a library prints what must not reach stdout\n")

    def build(parameters: FingertipParameters, on_fraction: OnFraction) -> FakeTip:
        if broken == "dies":
            os._exit(9)
        if broken == "hangs":
            time.sleep(3600)
        if broken:
            raise SimulationError(broken, remedy="mend it")
        for k in range(20):
            time.sleep(fill_s / 20)
            on_fraction(k / 20)
        return FakeTip(parameters, nodes)

    return build


def request(name: str, kind: float = QUICK, *, steps: int = 5, **more: Any) -> SimulationRequest:
    """A straight press whose run behaves as ``kind`` says."""
    from palpate.client.simulations import straight_path  # which would load Zenoh in workers
    from palpate.messages import SimulationParameters, SimulationRequest

    path = straight_path((0.0, 0.0, -0.009), (0.0, 0.0, -0.005), steps)
    parameters = SimulationParameters(friction_coefficient=kind)
    return SimulationRequest(name, "sphere_medium", path, parameters, **more)


class BareTip:
    """A fingertip that no device takes."""

    def __init__(self, tip: FakeTip) -> None:
        self.describe, self.indent = tip.describe, tip.indent


def without_device() -> Callable[[FingertipParameters, OnFraction], BareTip]:
    """A factory of such."""
    return lambda parameters, on_fraction: BareTip(FakeTip(parameters, 40))
