"""Trajectories in published rows, which name none: where each begins, and which are the same.

A published file holds the rows of one BioTac, trajectory after trajectory, each beginning with a
row at exactly 0.5 N (paper, section "Experimental data processing").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.extras import require
from palpate_training.twin.threshold import THRESHOLD_N

Floats = npt.NDArray[np.float64]
Texts = npt.NDArray[np.object_]

FALLEN_N = THRESHOLD_N + 1e-3
"""A force that falls to this or below is back at 0.5 N; the rest is rounding."""

JUMP_M = 0.5e-3
"""Rows of one trajectory are 0.1 mm apart; the tip does not jump five increments."""

SAME_PLACE_M = 1.5e-3
"""How far apart one trajectory may begin on two BioTacs: registration error plus 0.5 N's depth."""

SAME_DIRECTION = np.cos(np.radians(12.0))
"""Cosine of the angle that two BioTacs' paths of one trajectory may differ by; planned ones of one
point differ by 30 degrees or more."""

MIN_PATH_M = 0.3e-3
"""A shorter path has no direction worth comparing."""


@dataclass(frozen=True, slots=True)
class Run:
    """Rows of one trajectory on one BioTac.

    Attributes:
        rows: Where.
        indenter: By name.
        start: Tip at 0.5 N [m], shape (3,).
        direction: Of the path, a unit vector; zero where the path is too short to tell.
        travel_m: Of each row along the path, from 0 [m], shape (R,).
    """

    rows: slice
    indenter: str
    start: Floats
    direction: Floats
    travel_m: Floats


def find_runs(name: str, force: Floats, location: Floats, indenter: Texts) -> list[Run]:
    """Cut the rows of a file into trajectories.

    A trajectory begins where the indenter changes, where the force falls back to 0.5 N, or where
    the tip jumps.

    Args:
        name: Of the file, for messages.
        force: [N], shape (N, 3).
        location: [m], shape (N, 3).
        indenter: Names, shape (N,).

    Raises:
        DatasetError: Most rows stand alone, so they are in no order of trajectories.
    """
    magnitude = np.linalg.norm(force, axis=1)
    begins = np.ones(len(force), np.bool_)
    begins[1:] = (
        (indenter[1:] != indenter[:-1])
        | ((magnitude[1:] <= FALLEN_N) & (magnitude[1:] < magnitude[:-1]))
        | (np.linalg.norm(np.diff(location, axis=0), axis=1) > JUMP_M)
    )
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(force))
    alone = int(np.sum(ends - starts == 1))
    if alone > len(starts) / 2 and len(starts) > 1:
        raise DatasetError(
            f"{name}: {alone} of {len(starts)} trajectories have a single row, so the rows are in"
            " no order of trajectories",
            remedy="use the file as published; a shuffled copy has lost its trajectories",
        )
    return [
        _run(slice(int(a), int(b)), str(indenter[a]), location[a:b])
        for a, b in zip(starts, ends, strict=True)
    ]


def _run(rows: slice, indenter: str, tip: Floats) -> Run:
    way = tip[-1] - tip[0]
    length = float(np.linalg.norm(way))
    along = way / length if length > 0.0 else np.zeros(3)
    # Noise of the tip must not make travel run backward.
    travel_m = np.maximum.accumulate((tip - tip[0]) @ along)
    direction = along if length >= MIN_PATH_M else np.zeros(3)
    return Run(rows, indenter, tip[0], direction, travel_m)


def name_trajectories(units: list[list[Run]]) -> list[list[str]]:
    """Give the same id to runs of different BioTacs that are the same trajectory.

    Such have the same indenter, begin in nearly the same place and go in nearly the same direction;
    each BioTac has a trajectory once, so they are assigned one to one. What is on one side only, or
    too short to compare, gets an id of its own.

    Args:
        units: Runs of each BioTac.

    Returns:
        Ids ``<indenter>/<number>``, in the same order.
    """
    assign = require("scipy.optimize", extra="training").linear_sum_assignment
    known: dict[str, list[Run]] = {}
    names: list[list[str]] = []
    for runs in units:
        ids = [""] * len(runs)
        for indenter in dict.fromkeys(run.indenter for run in runs):
            places = [i for i, run in enumerate(runs) if run.indenter == indenter]
            seen = known.setdefault(indenter, [])
            distance = np.array([[_distance(runs[i], old) for old in seen] for i in places])
            if seen:
                # Too far apart costs more than any chain of good pairs could save.
                bounded = np.where(np.isfinite(distance), distance, 1e3)
                for row, column in zip(*assign(bounded), strict=True):
                    if np.isfinite(distance[row, column]):
                        ids[places[row]] = f"{indenter}/{column:03d}"
            for i in places:
                if not ids[i]:
                    ids[i] = f"{indenter}/{len(seen):03d}"
                    seen.append(runs[i])
        names.append(ids)
    return names


def _distance(one: Run, other: Run) -> float:
    """How unlike two runs are, in metres; infinite where they cannot be the same trajectory."""
    apart_m = float(np.linalg.norm(one.start - other.start))
    cosine = float(one.direction @ other.direction)
    if apart_m > SAME_PLACE_M or cosine < SAME_DIRECTION:
        return np.inf
    return apart_m + SAME_PLACE_M * (1.0 - cosine)
