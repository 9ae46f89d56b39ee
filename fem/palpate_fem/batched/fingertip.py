"""Many indentations of one fingertip at once, on a GPU: the batched solver.

A slot holds one trajectory at a time, and takes the next when its own has ended; no trajectory
waits for another. A sweep serves the requests of all slots (``trajectory``), kind by kind: starts
of increments and mortar corrections, factorisations, Newton steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from palpate.errors import ConfigError, SimulationError
from palpate.rigid import rotation_matrices
from palpate_fem.arrays import Floats
from palpate_fem.batched.equations import BatchedEquations
from palpate_fem.batched.launches import Listed, Sequences
from palpate_fem.batched.linear import CHANGE, BatchedLinearSystem
from palpate_fem.batched.state import BatchedState, SlotNumbers
from palpate_fem.batched.steps import BatchedSteps
from palpate_fem.batched.trajectory import (
    Accept,
    BatchedTrajectory,
    Begin,
    MovesIn,
    Reach,
    Request,
    Requests,
)
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.path import check_path
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.iteration import Correct, Factorise, Step
from palpate_fem.mechanics.load_stepping import moves_in
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep

HALVINGS = 8
"""How often a Newton step is halved where an element would turn inside out."""


@dataclass(frozen=True, slots=True)
class BatchedPress:
    """A trajectory to compute on a device.

    Attributes:
        indenter: Number of the indenter, among those of the `BatchedFingertip`.
        path: Poses (K, 7), see `Fingertip.indent`; the first is clear of the skin.
    """

    indenter: int
    path: Floats


@dataclass(frozen=True, slots=True)
class UnsolvedPress:
    """A trajectory that finds no equilibrium on the device, where it may have one on the CPU.

    Attributes:
        press: The trajectory.
        result: As far as it went.
    """

    press: BatchedPress
    result: IndentationResult


@dataclass(slots=True)
class _Live:
    """The trajectory in a slot, and what it asks for."""

    number: int
    press: BatchedPress
    trajectory: BatchedTrajectory
    requests: Requests
    accepted: Floats
    started: float = field(default_factory=time.perf_counter)
    reached: float = field(default_factory=time.perf_counter)
    wanted: Request | None = None
    pose: Floats = field(default_factory=lambda: np.zeros(7))
    numbers: SlotNumbers | None = None
    steps: list[IndentationStep] = field(default_factory=list)


class BatchedFingertip:
    """A pressurised fingertip, ``slots`` times on a device."""

    def __init__(
        self, tip: Fingertip, indenters: Sequence[Indenter], *, slots: int, device: str
    ) -> None:
        """Make room on the device.

        Args:
            tip: The fingertip; its state and its settings are used, and it answers rare questions.
            indenters: All that the presses name.
            slots: Trajectories at once.
            device: A Warp device, for example ``cuda:0``.

        Raises:
            ConfigError: There are no slots or no indenters.
        """
        if slots < 1 or not indenters:
            raise ConfigError(
                f"{slots} slots and {len(indenters)} indenters", remedy="give one or more of each"
            )
        self.tip, self.indenters, self.slots = tip, tuple(indenters), slots
        system, friction = tip.system, tip.parameters.friction_coefficient
        self.equations = BatchedEquations(
            system, self.indenters, slots=slots, device=device, friction=friction
        )
        self.linear = BatchedLinearSystem(self.equations)
        self._now, self._before, self._trial, self._start = (
            BatchedState(tip.geometry.mesh, slots, device) for _ in range(4)
        )
        self._steps = BatchedSteps(self.equations, tip.nodes)
        self._on_step: Callable[[int, IndentationStep], None] | None = None
        self._viscosity = np.zeros(slots)
        self._ratios, self._viscosities, self._fractions = (
            wp.zeros(slots, dtype=wp.float64, device=device) for _ in range(3)
        )
        self._sequences = Sequences(device)
        self._skin = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)

    def indent(
        self,
        presses: Iterable[BatchedPress],
        *,
        on_sweep: Callable[[int], None] | None = None,
        on_step: Callable[[int, IndentationStep], None] | None = None,
        should_stop: Callable[[int], IndentationOutcome | None] | None = None,
    ) -> Iterator[tuple[int, IndentationResult]]:
        """Compute trajectories, in whatever order they end.

        One that finds no equilibrium, pseudo-transient continuation included, is computed again on
        the CPU when all others have ended: its factor copes with indefinite tangents.

        Args:
            presses: Any number, taken and checked one by one.
            on_sweep: Called with the number of trajectories at work on the device.
            on_step: See `solve`.
            should_stop: See `solve`.

        Yields:
            Number of the trajectory, and its result, as `Fingertip.indent` returns it.

        Raises:
            ConfigError: A press names no indenter, or its path is not valid, see `check_path`.
            SimulationError: A press starts inside the skin.
        """
        unsolved: list[tuple[int, BatchedPress]] = []
        found = self.solve(presses, on_sweep=on_sweep, on_step=on_step, should_stop=should_stop)
        for number, result in found:
            if isinstance(result, UnsolvedPress):
                unsolved.append((number, result.press))
            else:
                yield number, result
        for number, press in unsolved:
            stepping = self.tip.load_stepping(self.indenters[press.indenter], press.path)
            yield number, stepping.run()

    def solve(
        self,
        presses: Iterable[BatchedPress],
        *,
        on_sweep: Callable[[int], None] | None = None,
        on_step: Callable[[int, IndentationStep], None] | None = None,
        should_stop: Callable[[int], IndentationOutcome | None] | None = None,
    ) -> Iterator[tuple[int, IndentationResult | UnsolvedPress]]:
        """Compute on the device what can be computed there.

        Args:
            presses: Any number, taken and checked one by one. While others are at work, an iterator
                that has ended is asked again in each sweep: there may be more by then.
            on_sweep: Called with the number of trajectories at work on the device.
            on_step: Called with the number of a trajectory and each of its steps. One that then
                finds no equilibrium begins anew on the CPU, with steps of its own.
            should_stop: Called with the number of each trajectory at work in each sweep; an outcome
                ends it.

        Yields:
            Number of the trajectory, in the order in which they were taken, and its result.

        Raises:
            ConfigError: A press names no indenter, or its path is not valid, see `check_path`.
            SimulationError: A press starts inside the skin.
        """
        waiting = iter(enumerate(presses))
        live: dict[int, _Live] = {}
        self._on_step = on_step
        while True:
            self._fill(live, waiting)
            if not live:
                return
            if on_sweep is not None:
                on_sweep(len(live))
            if should_stop is not None:
                for one in live.values():
                    if (outcome := should_stop(one.number)) is not None:
                        one.trajectory.outcome, one.wanted = outcome, None
            self._evaluate(live)
            self._factorise(live)
            self._step(live)
            for slot in [slot for slot, one in live.items() if one.wanted is None]:
                one = live.pop(slot)
                result = self._result(one)
                solved = not one.trajectory.unsolved
                yield one.number, result if solved else UnsolvedPress(one.press, result)

    def _fill(self, live: dict[int, _Live], waiting: Iterator[tuple[int, BatchedPress]]) -> None:
        """Give free slots their next trajectories."""
        tip, fresh = self.tip, []
        for slot in range(self.slots):
            if slot in live:
                continue
            number, press = next(waiting, (-1, None))
            if press is None:
                break
            press = self._checked(number, press)
            trajectory = BatchedTrajectory(press.path, tip.settings, tip.cavity_m3)
            one = _Live(number, press, trajectory, trajectory.requests(), press.path[0])
            live[slot] = one
            fresh.append(slot)
            self._now.put(slot, tip.state)
            self._before.put(slot, tip.state)
            one.pose = press.path[0]
            self._go_on(one, None)
        if fresh:
            self._pose(live, fresh)
            self.equations.update_anchors(self._now, self.equations.listed(np.array(fresh)))

    def _checked(self, number: int, press: BatchedPress) -> BatchedPress:
        """A press whose path is valid and begins clear of the skin."""
        if not 0 <= press.indenter < len(self.indenters):
            raise ConfigError(
                f"press {number} has indenter {press.indenter}",
                remedy=f"give one of 0 to {len(self.indenters) - 1}",
            )
        path = check_path(press.path, source=f"the path of press {number}")
        check_clear(self.indenters[press.indenter], path[0], self._skin)
        return BatchedPress(press.indenter, path)

    def _pose(self, live: dict[int, _Live], slots: list[int]) -> None:
        """Put the indenters of slots where they are wanted."""
        poses = np.array([live[k].pose for k in slots])
        self.equations.pose(
            np.array(slots),
            np.array([live[k].press.indenter for k in slots]),
            poses[:, :3],
            rotation_matrices(poses[:, 3:]),
        )

    def _indenter(self, one: _Live) -> Indenter:
        return self.indenters[one.press.indenter]

    @staticmethod
    def _go_on(one: _Live, answer: object) -> None:
        """Resume a trajectory with an answer; ``wanted`` is None when it has ended."""
        try:
            if isinstance(answer, SimulationError):
                one.wanted = one.requests.throw(answer)
            else:
                one.wanted = one.requests.send(answer)
        except StopIteration:
            one.wanted = None

    @staticmethod
    def _asking(live: dict[int, _Live], *kinds: type) -> list[int]:
        return [slot for slot, one in live.items() if isinstance(one.wanted, kinds)]

    def _evaluate(self, live: dict[int, _Live]) -> None:
        """Serve starts of increments and mortar corrections, until none is asked for."""
        while slots := self._asking(live, Begin, Correct):
            begin = [slot for slot in slots if isinstance(live[slot].wanted, Begin)]
            if begin:
                ratio = np.zeros(self.slots)
                for slot in begin:
                    wanted = live[slot].wanted
                    assert isinstance(wanted, Begin)
                    live[slot].pose, ratio[slot] = wanted.pose, wanted.ratio
                self._pose(live, begin)
                listed = self.equations.listed(np.array(begin))
                self._ratios.assign(ratio)
                self._sequences(self._extrapolate, listed)
            listed, moved = (self.equations.listed(np.array(some, int)) for some in (slots, begin))
            self._sequences(self._balance, listed, listed, moved)
            numbers = self.equations.numbers(self._trial, listed)
            for slot, found in zip(slots, numbers, strict=True):
                live[slot].numbers = found
                begins = isinstance(live[slot].wanted, Begin)
                self._go_on(live[slot], found if begins else (found, found.sets_changed))
            self._end_increments(live)

    def _extrapolate(self, listed: Listed) -> None:
        self._trial.extrapolate(self._now, self._before, self._ratios, listed.slots)

    def _balance(self, listed: Listed, renewing: Listed | None, moved: Listed) -> None:
        """Evaluate the forces of trial states, and the gaps' offsets of some before."""
        if renewing is not None:
            self.equations.correct_contact(self._trial, renewing)
        self.equations.balance(self._trial, listed, moved=moved)

    def _factorise(self, live: dict[int, _Live]) -> None:
        """Serve factorisations, again where a viscosity has to rise."""
        while slots := self._asking(live, Factorise):
            elastic = []
            for slot in slots:
                wanted = live[slot].wanted
                assert isinstance(wanted, Factorise)
                self._viscosity[slot] = wanted.viscosity or 0.0
                if wanted.elastic:
                    elastic.append(slot)
            listed = self.equations.listed(np.array(slots))
            anew = self.equations.listed(np.array(elastic)) if elastic else None
            self._viscosities.assign(self._viscosity)
            definite = self.linear.factorise(self._trial, listed, anew, self._viscosities)
            for slot, fine in zip(slots, definite, strict=True):
                wanted = live[slot].wanted
                assert isinstance(wanted, Factorise)
                # A factor that met a pivot that is not positive is of no use.
                lost = not fine and not wanted.can_rise
                self._go_on(live[slot], _failed("a direction is unstable") if lost else bool(fine))

    def _step(self, live: dict[int, _Live]) -> None:
        """Serve Newton steps; see `NewtonSolver._step`."""
        slots = self._asking(live, Step)
        if not slots:
            return
        equations, linear, fraction = self.equations, self.linear, np.zeros(self.slots)
        listed = equations.listed(np.array(slots))
        renewing = [slot for slot in slots if _renews(live[slot])]
        following = equations.listed(np.array(renewing)) if renewing else None
        missing = [self.tip.cavity_m3 - _known(live[slot]).volume for slot in slots]
        linear.solve(self._trial, listed, np.array(missing), following=following)
        longest = equations.longest_move(listed, linear.change, CHANGE)
        most = self.tip.settings.newton.largest_move_m
        for slot, far in zip(slots, longest, strict=True):
            wanted = live[slot].wanted
            assert isinstance(wanted, Step)
            fraction[slot] = min(wanted.damping, most / max(float(far), 1e-300))
        self._sequences(self._aim, listed, following)
        left = [slot for slot, far in zip(slots, longest, strict=True) if np.isfinite(far)]
        answers: dict[int, SlotNumbers] = {}
        for _ in range(HALVINGS):
            if not left:
                break
            some = listed if len(left) == len(slots) else equations.listed(np.array(left))
            self._fractions.assign(fraction)
            again = [slot for slot in left if slot in renewing]
            others = equations.listed(np.array(again)) if again else None
            self._sequences(self._move, some, others)
            for slot, found in zip(left, equations.numbers(self._trial, some), strict=True):
                if found.smallest_jacobian > 0.0:
                    answers[slot] = found
            left = [slot for slot in left if slot not in answers]
            fraction[left] *= 0.5
        for slot in slots:
            if (answer := answers.get(slot)) is None:
                self._go_on(live[slot], _failed("an element turns inside out"))
            else:
                live[slot].numbers = answer
                self._go_on(live[slot], (answer, answer.sets_changed))
        self._end_increments(live)

    def _aim(self, listed: Listed, following: Listed | None) -> None:
        """Find where an iteration goes; it starts at the trial states."""
        self.equations.targets(listed, self.linear.change, CHANGE, following=following)
        self._start.copy_slots(self._trial, listed.slots)

    def _move(self, listed: Listed, renewing: Listed | None) -> None:
        """Go a share of the way, and evaluate the forces there."""
        change, pressure_change = self.linear.change, self.linear.pressure_change
        self.equations.move(
            self._trial, self._start, listed, change, CHANGE, self._fractions, pressure_change
        )
        self._balance(listed, renewing, listed)

    def _end_increments(self, live: dict[int, _Live]) -> None:
        """Serve what ends an increment: snaps, the new solution, and the steps that are kept."""
        for slot in self._asking(live, MovesIn):
            self._go_on(live[slot], self._moves_in(slot, live[slot]))
        if slots := self._asking(live, Accept):
            listed = self.equations.listed(np.array(slots))
            self._sequences(self._accept, listed)
            for slot in slots:
                live[slot].accepted = live[slot].pose
                self._go_on(live[slot], None)
        if slots := self._asking(live, Reach):
            self._keep_steps(slots, live)
            for slot in slots:
                self._go_on(live[slot], None)

    def _accept(self, listed: Listed) -> None:
        """Take trial states for solutions."""
        self._before.copy_slots(self._now, listed.slots)
        self._now.copy_slots(self._trial, listed.slots)
        self.equations.update_anchors(self._now, listed)

    def _moves_in(self, slot: int, one: _Live) -> bool:
        """Whether the indenter moves in from the last solution; rare, so on the CPU."""
        wanted, system, state = one.wanted, self.tip.system, self._now.get(slot)
        assert isinstance(wanted, MovesIn)
        friction = self.tip.parameters.friction_coefficient
        at = PosedIndenter(self._indenter(one), one.accepted, friction)
        system.correct_contact(state, at)
        load = -system.balance(state, at).indenter
        return moves_in(state.position, load, at, at.at(wanted.pose))

    def _keep_steps(self, slots: list[int], live: dict[int, _Live]) -> None:
        """Keep the steps that slots have reached."""
        reached, convergences, now = [], [], time.perf_counter()
        for slot in slots:
            reach = live[slot].wanted
            assert isinstance(reach, Reach)
            reached.append(reach)
            error = abs(reach.numbers.volume - self.tip.cavity_m3) / self.tip.cavity_m3
            convergences.append(
                Convergence(
                    increments=reach.increments,
                    iterations=reach.iterations,
                    factorisations=reach.factorisations,
                    residual=reach.numbers.residual,
                    volume_error=error,
                    penetration_m=np.nan,
                    seconds=now - live[slot].reached,
                )
            )
            live[slot].reached = now
        steps = self._steps.make(
            self._now,
            self.equations.listed(np.array(slots)),
            [reach.pose for reach in reached],
            [reach.numbers.fluid_pressure for reach in reached],
            convergences,
        )
        for slot, step in zip(slots, steps, strict=True):
            live[slot].steps.append(step)
            if self._on_step is not None:
                self._on_step(live[slot].number, step)

    def _result(self, one: _Live) -> IndentationResult:
        trajectory = one.trajectory
        return IndentationResult(
            indenter=self._indenter(one).name,
            path=one.press.path,
            steps=tuple(one.steps),
            outcome=trajectory.outcome or IndentationOutcome.DIVERGED,
            reason=trajectory.reason,
            travel_m=trajectory.travel_m,
            seconds=time.perf_counter() - one.started,
        )


def _failed(problem: str) -> SimulationError:
    return SimulationError(problem, remedy="use smaller increments")


def _renews(one: _Live) -> bool:
    assert isinstance(one.wanted, Step)
    return one.wanted.renews


def _known(one: _Live) -> SlotNumbers:
    assert one.numbers is not None
    return one.numbers
