"""Simulated presses as a library: the film's gap at every place and force that was simulated.

A real touch has a measured force, but its place and its indenter are not known. Each simulated
press is one guess of both. Along it the measured size of the force picks a state, between two
steps, so a press gives one candidate for each touch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.population.responses import clear_steps
from palpate_fem.store.read import SimulationStore

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_N = 0.2
"""Lighter steps are left out [N]: the force is then the error of the solver."""


@dataclass(frozen=True)
class Candidates:
    """States that answer the forces of N touches, one for each of J presses; between two steps.

    Attributes:
        low: Step before, index into the library, shape (N, J); 0 where the press does not reach
            the force.
        high: Step after, likewise.
        share: Of the step after, 0 to 1, shape (N, J).
        angle_rad: Between the simulated and the measured force, shape (N, J); infinite where there
            is no candidate.
    """

    low: Indices
    high: Indices
    share: Floats
    angle_rad: Floats

    @property
    def states(self) -> Indices:
        """All states that are between, in order."""
        there = np.isfinite(self.angle_rad)
        return np.union1d(self.low[there], self.high[there])

    def at(self, values: Floats) -> Floats:
        """Values of states, (S, ...), at the candidates, (N, J, ...)."""
        share = self.share.reshape(*self.share.shape, *(1,) * (values.ndim - 1))
        return np.asarray((1 - share) * values[self.low] + share * values[self.high])


@dataclass(frozen=True)
class PressLibrary:
    """States of simulated presses.

    Attributes:
        rest: Gap of the untouched finger.
        gaps: Of the S states.
        force: Net force of the indenter on the skin [N], shape (S, 3).
        place: Centre of its pressure [m], shape (S, 3), sensor frame.
        press: Which press each belongs to, 0 to J - 1 in order, shape (S,).

    Raises:
        DatasetError: There is no state, or shapes do not fit together.
    """

    rest: Gap
    gaps: Sequence[Gap]
    force: Floats
    place: Floats
    press: Indices

    def __post_init__(self) -> None:
        count = len(self.gaps)
        shapes = self.force.shape, self.place.shape, self.press.shape
        if not count or shapes != ((count, 3), (count, 3), (count,)):
            raise DatasetError(
                f"{count} states, their forces, places and presses have shapes {shapes}",
                remedy="simulate presses that touch, and give one of each for each state",
            )

    @property
    def presses(self) -> int:
        """Number of presses J."""
        return int(self.press.max()) + 1

    def candidates(self, force: Floats) -> Candidates:
        """States that answer measured forces.

        Args:
            force: On the sensor [N], shape (N, 3).

        Raises:
            DatasetError: No press reaches one of them.
        """
        size = np.linalg.norm(self.force, axis=1)
        wanted = np.linalg.norm(force, axis=1)
        shape = (len(force), self.presses)
        low, high = np.full(shape, -1), np.full(shape, -1)
        share, angle = np.zeros(shape), np.full(shape, np.inf)
        for j in range(self.presses):
            steps = np.flatnonzero(self.press == j)
            # Where a press lets go again, its way in is what counts.
            steps = steps[: int(np.argmax(size[steps])) + 1]
            rising = np.maximum.accumulate(size[steps])
            for n, one in enumerate(wanted):
                if len(steps) < 2 or not rising[0] <= one <= rising[-1]:
                    continue
                k = max(int(np.searchsorted(rising, one)), 1)
                low[n, j], high[n, j] = steps[k - 1], steps[k]
                # The step before may be lighter than an earlier one, but not the step after.
                before, after = size[steps[k - 1]], size[steps[k]]
                share[n, j] = (one - before) / (after - before) if after != before else 0.0
        there = low >= 0
        if not there.any(axis=1).all():
            lost = wanted[~there.any(axis=1)]
            raise DatasetError(
                f"{len(lost)} touches, of {lost.min():.1f} to {lost.max():.1f} N, are beyond all"
                " simulated presses",
                remedy="simulate lighter and deeper ones, or leave these touches out",
            )
        found = Candidates(np.maximum(low, 0), np.maximum(high, 0), share, angle)
        towards = found.at(self.force)
        cosine = np.einsum("nji,ni->nj", towards, force)
        cosine /= np.maximum(np.linalg.norm(towards, axis=2) * wanted[:, None], 1e-12)
        angle[there] = np.arccos(np.clip(cosine, -1.0, 1.0))[there]
        return found


def read_library(
    store: SimulationStore,
    sensor: ElectrodeModel,
    *,
    on_press: Callable[[], None] | None = None,
) -> PressLibrary:
    """The library of a store: the steps of its trajectories that touch and are clear of the mount.

    Args:
        store: Simulated trajectories, of any indenter.
        sensor: Model on the store's fingertip, with the film.
        on_press: Called after each trajectory.

    Raises:
        DatasetError: The store is damaged, or holds no such step.
    """
    fingertip = store.fingertip()
    nodes = fingertip.pressurised_nodes
    gaps: list[Gap] = []
    force: list[Floats] = []
    place: list[Floats] = []
    press: list[int] = []
    number = 0
    for name in store.ids():
        trajectory = store.trajectory(name)
        steps = trajectory.steps[: clear_steps(trajectory, fingertip.mesh.fixed)]
        some = [step for step in steps if np.linalg.norm(step.force) >= LEAST_N]
        gaps += [sensor.finder.of_step(nodes, step).for_counts() for step in some]
        force += [step.force for step in some]
        place += [step.centre_of_pressure for step in some]
        press += [number] * len(some)
        number += bool(some)
        if on_press is not None:
            on_press()
    if not gaps:
        raise DatasetError(f"{store.path} holds no step that touches", remedy="simulate presses")
    return PressLibrary(
        sensor.finder.measure(nodes),
        gaps,
        np.array(force),
        np.array(place),
        np.array(press, np.int64),
    )
