"""Sources of a validation: measured trajectories from files, simulations from a store."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.config import looking_at
from palpate.errors import DatasetError
from palpate.files.simulation_store import SIMULATIONS
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.measured import (
    MEASURED,
    SIMULATED,
    MeasuredIndentation,
    is_file_of,
    read_indentations,
)
from palpate_fem.calibration.runs import SimulatedRun, from_rest
from palpate_fem.store.content import TrajectorySummary
from palpate_fem.store.read import SimulationStore

_SIDEWAYS_M = 20e-6
"""Largest distance between paths of one trajectory: the robot's repeatability (paper, "testbed
design")."""
_TURNED = np.cos(np.radians(1.0))


def measured_from(path: Path) -> tuple[tuple[MeasuredIndentation, ...], dict[str, str]]:
    """Trajectories to compare with, from a file of indentations or from a store.

    Args:
        path: File of schema ``palpate.indentations``, or a store (folder or exported file); a
            store's trajectories count as measured only if they name a sensor.

    Returns:
        The trajectories, and the reason by name for those that cannot be used.

    Raises:
        ConfigError: It is closed, or lies in a folder that is.
        DatasetError: It is neither of them, or damaged.
    """
    with looking_at(path):
        is_file = path.is_file()
    if is_file and not is_file_of(path, SIMULATIONS.name):
        return read_indentations(path), {}
    store, found, left_out = SimulationStore.open(path), [], {}
    for name in store.ids():
        item = store.summary(name)
        pose, force = item.pose, item.force
        if not item.sensor and len(pose):
            # a solver's steps begin at the second pose, as the first does not touch
            pose, force = np.concatenate([item.path[:1], pose]), from_rest(force)
        try:
            found.append(
                MeasuredIndentation(
                    name,
                    item.indenter,
                    item.sensor or "simulated",
                    pose,
                    force,
                    MEASURED if item.sensor else SIMULATED,
                    "" if item.sensor else str(item.outcome),
                )
            )
        except DatasetError as error:
            left_out[name] = error.problem
    return tuple(found), left_out


def simulated_from(
    store: SimulationStore, measured: Sequence[MeasuredIndentation]
) -> tuple[dict[str, SimulatedRun], dict[str, str]]:
    """The stored simulation of each measured trajectory.

    One simulation serves every sensor: ``sphere_medium/03/normal`` belongs to
    ``sphere_medium/03/normal/biotac1``. Its path may begin elsewhere on the same line.

    Args:
        store: Store with simulations.
        measured: Trajectories that they are compared with.

    Returns:
        Simulations by name of the measured trajectory, and the reason by name for those that
        cannot be used.

    Raises:
        DatasetError: The store is damaged.
    """
    tip, there = store.fingertip(), set(store.ids())
    found: dict[str, SimulatedRun] = {}
    refused: dict[str, str] = {}
    for item in measured:
        names = (item.name, item.name.removesuffix(f"/{item.sensor}"))
        name = next((name for name in names if name in there), None)
        if name is None:
            continue
        summary = store.summary(name)
        problem = _mismatch(summary, item)
        if problem:
            refused[item.name] = problem
            continue
        force = from_rest(summary.force)
        ahead = _direction(item.pose) @ (summary.path[0, :3] - item.pose[0, :3])
        found[item.name] = SimulatedRun(
            force,
            path_lengths(summary.path)[: len(force)] + ahead,
            tip.total_thickness_m,
            tip.fluid_volume_m3,
            summary.outcome,
            summary.reason,
        )
    return found, refused


def _mismatch(simulated: TrajectorySummary, item: MeasuredIndentation) -> str:
    """Why a simulation does not belong to this trajectory; empty if it does."""
    if simulated.indenter != item.indenter:
        return f"simulated with {simulated.indenter}, measured with {item.indenter}"
    along = _direction(item.pose)
    if _direction(simulated.path) @ along < _TURNED:
        return "simulated along another direction"
    apart = simulated.path[0, :3] - item.pose[0, :3]
    sideways = float(np.linalg.norm(apart - (apart @ along) * along))
    if sideways > _SIDEWAYS_M:
        return f"simulated {sideways * 1e3:.3f} mm beside the measured path"
    return ""


def _direction(path: Floats) -> Floats:
    """From the first position to the farthest one, as a path may come back; unit length, (3,)."""
    ways = path[:, :3] - path[0, :3]
    far = np.linalg.norm(ways, axis=1)
    last = int(far.argmax())
    return np.asarray(ways[last] / max(far[last], np.finfo(float).tiny))
