"""What a simulated population says of a force: a line, for a finger of which little is known.

A network of the population knows the twin too well to be right on real fingers. A ridge regression
through the same presses, on electrodes without their common mode, ranks the forces of real fingers
better than it, and only its scale and its axes are off, alike for all fingers (training/LOG.md). So
it serves as what is believed before a finger's own rows are seen.

``palpate train line`` fits it; the one that ships is of 20,000 presses on twenty fingertips
(docs/results/population.md).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate_training.datasets.features import ELECTRODES, FeatureDataset
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.population_net import inputs_of

Floats = npt.NDArray[np.float64]

RIDGE = 0.01
"""Penalty, over the number of rows; inputs are standardised."""

LEAST_N = 0.5
"""Rows that it is fitted to have at least this force [N]."""

_FORMAT = "palpate.twin-line/1"


@dataclass(frozen=True, slots=True)
class TwinLine:
    """A line from electrodes to force.

    Attributes:
        weight: [N] for each change of the logarithm of an impedance, shape (19, 3).
        offset: Force where nothing has changed [N], shape (3,).
        data_sha256: Content of the rows that it was fitted to, hex.
    """

    weight: Floats
    offset: Floats
    data_sha256: str

    def force(self, electrodes: npt.NDArray[Any], rest: npt.NDArray[Any]) -> Floats:
        """Forces [N] of raw and untouched counts (N, 19), shape (N, 3)."""
        return np.asarray(_inputs(electrodes, rest) @ self.weight + self.offset)

    def mapped(self, guess: Floats, force: Floats, *, penalty_n2: float = 0.0) -> TwinLine:
        """The line of a real finger, which differs in scale and in how the finger sits.

        Args:
            guess: What this line says of some rows [N], shape (N, 3).
            force: What was measured there.
            penalty_n2: Of a linear map that is more than one factor [N^2].
        """
        rows, wanted = (np.vstack([one, one * MIRROR_AXES]) for one in (guess, force))
        factor = np.sum(rows * wanted) / np.sum(rows * rows)
        gram = rows.T @ rows + penalty_n2 * len(rows) * np.eye(3)
        to_real = factor * np.eye(3) + np.linalg.solve(gram, rows.T @ (wanted - factor * rows))
        return replace(self, weight=self.weight @ to_real, offset=self.offset @ to_real)


def fit_line(data: FeatureDataset) -> TwinLine:
    """Fit to all rows of at least ``LEAST_N`` and their mirror images.

    Raises:
        DatasetError: There are fewer such rows than the line has numbers.
    """
    touched = np.linalg.norm(data.force, axis=1) >= LEAST_N
    if touched.sum() < 3 * (ELECTRODES + 1):
        raise DatasetError(
            f"{data.name}: {touched.sum()} rows have {LEAST_N:g} N or more",
            remedy="use a data set of a population: `palpate data generate --random`",
        )
    rows = _inputs(data.electrodes[touched], data.baseline[touched])
    force = data.force[touched].astype(np.float64)
    rows = np.vstack([rows, rows[:, ELECTRODE_MIRROR]])
    force = np.vstack([force, force * MIRROR_AXES])
    centre, mean, spread = rows.mean(axis=0), force.mean(axis=0), rows.std(axis=0)
    scaled = (rows - centre) / spread
    gram = scaled.T @ scaled + RIDGE * len(rows) * np.eye(ELECTRODES)
    weight = np.linalg.solve(gram, scaled.T @ (force - mean)) / spread[:, None]
    return TwinLine(weight, mean - centre @ weight, data.content_sha256())


def check_place(path: Path) -> None:
    """Refuse to write a line where something else is.

    Raises:
        DatasetError: The name does not end with .json, or there is a file that is no line.
    """
    if path.suffix != ".json":
        raise DatasetError(f"{path}: a line is written as JSON", remedy="give a name with .json")
    if path.exists():
        try:
            read_line(path)
        except DatasetError as error:
            raise DatasetError(
                f"{path} exists and is no line through a population", remedy="give another name"
            ) from error


def write_line(path: Path, line: TwinLine) -> None:
    """Write it as JSON, whole or not at all; an earlier line is replaced.

    Raises:
        DatasetError: As ``check_place``, or the disk refused.
    """
    check_place(path)
    content = {
        "format": _FORMAT,
        "data_sha256": line.data_sha256,
        "weight": [[float(f"{value:.6g}") for value in row] for row in line.weight],
        "offset": [float(f"{value:.6g}") for value in line.offset],
    }
    with written_whole(path) as part:
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_line(path: Path | None = None) -> TwinLine:
    """Read a line; None = the one that ships.

    Raises:
        DatasetError: There is no such file, or it holds something else.
    """
    place = files("palpate_training.samples").joinpath("twin-line.json") if path is None else path
    try:
        content = json.loads(place.read_text(encoding="utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r}")
        weight = np.array(content["weight"], np.float64)
        offset = np.array(content["offset"], np.float64)
        if weight.shape != (ELECTRODES, 3) or offset.shape != (3,):
            raise ValueError(f"shapes {weight.shape} and {offset.shape}")
        if not (np.isfinite(weight).all() and np.isfinite(offset).all()):
            raise ValueError("a number is not finite")
        return TwinLine(weight, offset, str(content["data_sha256"]))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{place} holds no line through a population: {error}",
            remedy="make it: palpate train line",
        ) from error


def _inputs(electrodes: npt.NDArray[Any], rest: npt.NDArray[Any]) -> Floats:
    """Changes of the logarithm of each impedance since rest, without what all have in common."""
    change = inputs_of(electrodes, rest).astype(np.float64)
    return np.asarray(change - change.mean(axis=1, keepdims=True))
