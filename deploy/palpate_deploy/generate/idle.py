"""Untouched units over three minutes: their noise and drift, to be held against real sensors'."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.files.atomic import written_whole
from palpate_fem.electrodes.signals import (
    ElectrodeSignals,
    core_temperature_c,
    log_sigma,
    skewed,
)
from palpate_fem.population.answers import Population
from palpate_fem.population.member import Member
from palpate_fem.store.content import StoredFingertip

FILE = "idle.npz"
RATE_HZ = 100.0
LENGTH_S = 180.0
SINCE_ON_S = 300.0
"""Age of a sensor when it is looked at [s]: the idle real ones were still warming up."""

AMBIENT_C = 25.0


def write_idle(
    folder: Path, fingertip: StoredFingertip, members: Sequence[Member], *, seed: int
) -> Path:
    """Write the counts of untouched units as ``idle.npz``, once.

    Args:
        folder: Of the experiment.
        fingertip: Pressurised.
        members: The units.
        seed: Of the noise.

    Returns:
        The file: ``rate_hz`` and, for each unit, counts of shape (T, 19).
    """
    path = folder / FILE
    if path.exists():
        return path
    population = Population(fingertip, [member.unit for member in members])
    time_s = np.arange(0.0, LENGTH_S, 1.0 / RATE_HZ)
    elapsed = np.full(len(time_s), 1.0 / RATE_HZ)
    arrays: dict[str, NDArray[np.generic]] = {"rate_hz": np.array(RATE_HZ)}
    for number, member in enumerate(members):
        unit = member.unit
        rest = population.rest_counts[unit.name]
        core = [core_temperature_c(SINCE_ON_S + t, AMBIENT_C, unit) for t in time_s]
        warmed = np.array([log_sigma(c, unit) for c in core])
        ideal = np.repeat(rest[None], len(time_s), axis=0)
        signals = ElectrodeSignals(unit, rest, seed + number)
        arrays[unit.name] = signals.stream(
            skewed(ideal, time_s), elapsed, log_sigma=warmed - warmed[0]
        )
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return path
