"""A small version of a large mixed data set: fewer trials, rows and modes, so that it travels.

Trials of tens of thousands of presses are gigabytes. Networks learn more of many presses with few
rows and modes than of few presses with all, so this keeps a little of each.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.errors import ConfigError, DatasetError
from palpate_training.datasets.basis import (
    lost,
    mean_and_largest,
    rounded,
    subset,
    with_step,
)
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    FloatArray,
    MixedDataset,
    content_sha256,
    read_mixed,
    write_mixed,
)

_ROWS = 256
"""Rows whose fields are in memory at once."""


@dataclass(frozen=True, slots=True)
class SmallSize:
    """How much of a data set is kept; all where it has less.

    Attributes:
        trials: Trials, drawn evenly over the indenters.
        rows: Rows of each trial, 2 or more, evenly spaced; its first and last are among them.
        modes: Modes of the displacement: the first ones.
        force_modes: Modes of the contact forces: the first ones.
        seed: Of the draw.
    """

    trials: int = 10_000
    rows: int = 8
    modes: int = 96
    force_modes: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.trials, self.modes, self.force_modes) < 1 or self.rows < 2:
            raise ConfigError(
                f"{self} keeps nothing of something",
                remedy="keep one trial and one mode of each field or more, and two rows or more",
            )


SMALL = SmallSize()
"""Of 20,000 trials on the mesh of 6,870 nodes about 35 MB."""


def shrink_file(path: Path, out: Path, size: SmallSize, *, command: str) -> MixedDataset:
    """Write a small version of a mixed data set, whole or not at all; see ``shrink``.

    Raises:
        DatasetError: ``path`` is missing, damaged or no mixed data set, ``out`` exists, or the disk
            refuses.
    """
    if out.exists():
        raise DatasetError(f"{out} exists", remedy="remove it, or give another name")
    small = shrink(read_mixed(path), size, command=command)
    write_mixed(out, small)
    return small


def shrink(data: MixedDataset, size: SmallSize, *, command: str = "") -> MixedDataset:
    """A small version of a mixed data set.

    The losses of its bases are what it loses beside the given data set: mean and largest distance
    of a node from the compressed field that the given one holds at the same row, not from the
    simulation. What the given one had lost already comes on top; the provenance says how much.

    Args:
        data: Mixed data set.
        size: How much of it is kept.
        command: For provenance.
    """
    few = subset(data, draw_trials(data.experiment, size.trials, size.seed))
    rows = spaced_rows(few.experiment, size.rows)
    basis, coefficients = _fewer(few.basis, few.coefficients[rows], size.modes)
    notes = [
        f"{few.experiment.trials} of {data.experiment.trials} trials, {size.rows} rows of"
        f" each at most (seed {size.seed}); input_sha256 is the content of the data set that they"
        f" are of, whose own input_sha256 is {data.experiment.provenance.input_sha256 or 'empty'};"
        " losses of fields are relative to that data set, which itself loses"
        f" {data.basis.loss_mean:.3g} m of the displacement on average,"
        f" {data.basis.loss_max:.3g} m at most"
    ]
    contact = few.contact
    if contact is not None:
        forces, numbers = _fewer(contact.basis, contact.coefficients[rows], size.force_modes)
        notes.append(
            f"{contact.basis.loss_mean:.3g} N of the contact forces on average,"
            f" {contact.basis.loss_max:.3g} N at most"
        )
        contact = replace(
            contact,
            centre=contact.centre[rows],
            normal=contact.normal[rows],
            coefficients=numbers,
            basis=forces,
        )
    given = data.experiment.provenance
    experiment = few.experiment
    return replace(
        few,
        experiment=replace(
            experiment,
            **{
                name: getattr(experiment, name)[rows]
                for name in ("trial", "travel_m", "tared", "force", "location")
            },
            provenance=replace(
                given,
                command=command or given.command,
                input_sha256=content_sha256(data),
                palpate_version=__version__,
                notes="; ".join(text for text in (given.notes, ", ".join(notes)) if text),
            ),
        ),
        simulated_force=few.simulated_force[rows],
        coefficients=coefficients,
        basis=basis,
        contact=contact,
    )


def draw_trials(data: ExperimentDataset, count: int, seed: int) -> list[int]:
    """Some trials, ascending: as many of each indenter as of any other that has so many.

    Args:
        data: Whose trials.
        count: How many; all where there are not more.
        seed: Same seed, same trials.
    """
    random = np.random.default_rng(seed)
    kind = np.array(data.indenters)[data.trial_trajectory]
    # Shuffled, each trial gets its place among those of its indenter; the first places are taken.
    shuffled = random.permutation(data.trials)
    place = np.empty(data.trials, np.int64)
    for name in np.unique(kind):
        mine = shuffled[kind[shuffled] == name]
        place[mine] = np.arange(len(mine))
    turn = np.empty(data.trials, np.int64)
    turn[shuffled] = np.arange(data.trials)
    return sorted(np.lexsort((turn, place))[:count].tolist())


def spaced_rows(data: ExperimentDataset, count: int) -> npt.NDArray[np.int64]:
    """Indices of rows: of each trial ``count`` evenly spaced ones, first and last among them."""
    starts = np.searchsorted(data.trial, np.arange(data.trials + 1))
    return np.concatenate(
        [
            np.unique(np.linspace(first, end - 1, min(count, end - first)).round().astype(np.int64))
            for first, end in itertools.pairwise(starts)
        ]
    )


def _fewer(
    basis: FieldBasis, coefficients: FloatArray, modes: int
) -> tuple[FieldBasis, FloatArray]:
    """The first modes, and coefficients rounded to what these lose; losses beside all modes."""
    exact = coefficients[:, :modes]

    def measure(kept: FieldBasis) -> FieldBasis:
        mean, largest = _loss(basis, coefficients, rounded(exact, kept.step))
        return replace(kept, loss_mean=mean, loss_max=largest)

    first = replace(basis, modes=basis.modes[:modes], step=0.0)
    kept = with_step(measure(first), measure)
    return kept, rounded(exact, kept.step)


def _loss(basis: FieldBasis, coefficients: FloatArray, kept: FloatArray) -> tuple[float, float]:
    """Mean and largest distance between fields of all modes and of the first ones."""
    change = coefficients.copy()
    change[:, : kept.shape[1]] -= kept
    without_mean = replace(basis, mean=np.zeros_like(basis.mean))

    def blocks() -> Iterator[FloatArray]:
        for first in range(0, len(change), _ROWS):
            yield without_mean.decode(change[first : first + _ROWS])

    return mean_and_largest(lost(block) for block in blocks())
