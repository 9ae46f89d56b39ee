"""Public recordings of real BioTacs as the study sees them: forces and contact normals.

Forces: the LASA force calibration, two fingers that are always in contact, in blocks of 18 s.
Normals: one finger under a flat plate that is followed by cameras; only rows that are touched
count. The plate's authors published a network for it, which is a row of the tables, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.errors import DatasetError
from palpate_training.datasets.container import Provenance, read_archive, sha256_of
from palpate_training.datasets.ingest import ingest_lasa
from palpate_training.evaluation.cells import Task
from palpate_training.evaluation.features import FeatureTask, systems_of
from palpate_training.evaluation.pictures import Made, Picture, draw_task
from palpate_training.figures.plate import CONTACT_NORMAL, read_plate_logs, touched_rows
from palpate_training.learning.splits import (
    Fold,
    RowSplit,
    SplitName,
    contiguous_folds,
    last_part,
    unseen_sensor,
)
from palpate_training.systems.samples import (
    Estimate,
    FloatArray,
    IndexArray,
    Quantity,
    Samples,
    System,
)

FORCE_CALIBRATION = Path("lasa_force_calibration") / "force_calibration.npz"
AUTHORS_NETWORK = CONTACT_NORMAL.parent / "published_mlp_19_5x7_2.npz"

BLOCKS = 10
"""Of each recording of forces: 18 s each."""

FOLDS = 5
GUARD_ROWS = 100
"""1 s at 100 Hz."""

TASK_SPLITS: dict[str, tuple[SplitName, ...]] = {
    "force": ("block", "tail", "unit"),
    "normal": ("touch", "log"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Rows of recordings, in order of time within each.

    Attributes:
        samples: All rows.
        block: Part that is held out as a whole, of each row, shape (N,); unique over recordings.
        recording: Recording of each row, shape (N,).
        names: Of the recordings.
        provenance: Where they come from.
        sha256: Of their content.
        systems: That are tested on them.
    """

    samples: Samples
    block: IndexArray
    recording: IndexArray
    names: tuple[str, ...]
    provenance: Provenance
    sha256: str
    systems: tuple[System, ...]


@dataclass(frozen=True, slots=True)
class RecordingSource:
    """Recordings by task."""

    recorded: dict[str, Recorded]

    def task(self, name: str) -> Task | None:
        """A task by name; None if there is no recording for it."""
        rows = self.recorded.get(name)
        if rows is None:
            return None
        quantity: Quantity = "force" if name == "force" else "normal"
        return FeatureTask(
            quantity,
            rows.sha256,
            rows.samples,
            cluster=rows.block,
            kind=np.full(len(rows.samples), ""),
            systems=rows.systems,
        )

    def splits(self, task: str) -> tuple[SplitName, ...]:
        """Splits of a task; the first is trained with several seeds."""
        return TASK_SPLITS[task]

    def folds(self, task: str, split: SplitName, *, seed: int, whole: bool) -> list[Fold]:
        """Trainings of a split. Blocks are dealt in order of time, whatever the seed."""
        return list(_folds(self.recorded[task], split))

    @property
    def provenance(self) -> tuple[Provenance, ...]:
        """Where the data comes from."""
        return tuple(rows.provenance for rows in self.recorded.values())

    @property
    def row_counts(self) -> dict[str, int]:
        """Rows for each task."""
        return {f"rows for {name}": len(rows.samples) for name, rows in self.recorded.items()}

    @property
    def forces(self) -> dict[str, float]:
        """Empty: only an experiment is compared with the paper's forces."""
        return {}

    def draw(self, out: Path, made: Mapping[str, tuple[Task, Made]]) -> list[Picture]:
        """Draw the boxes of each task into ``out``."""
        return [
            picture
            for name, (task, results) in made.items()
            for picture in draw_task(out, task, None, results, split=TASK_SPLITS[name][0])
        ]


def read_recordings(folder: Path) -> RecordingSource | None:
    """The public recordings in a folder; None if it holds none of them.

    Raises:
        DatasetError: One is there but damaged.
    """
    recorded: dict[str, Recorded] = {}
    if (folder / FORCE_CALIBRATION).is_file():
        recorded["force"] = _forces(folder / FORCE_CALIBRATION)
    if (folder / CONTACT_NORMAL).is_file():
        recorded["normal"] = _normals(folder)
    return RecordingSource(recorded) if recorded else None


def _forces(path: Path) -> Recorded:
    data = ingest_lasa(path, blocks_per_recording=BLOCKS)
    unknown = np.full((len(data), 3), np.nan, np.float32)
    samples = Samples(
        tared=data.tared_counts,
        rest=data.baseline,
        trial=data.block,
        location=unknown,
        force=data.force,
        centre=unknown,
        normal=unknown,
    )
    return Recorded(
        samples,
        data.block,
        data.sensor,
        data.sensor_names,
        data.provenance,
        data.content_sha256(),
        systems_of("force"),
    )


def _normals(folder: Path) -> Recorded:
    """Touched rows of every log, tared by its own untouched rows."""
    parts: list[tuple[str, Samples, IndexArray]] = []
    touches = 0
    for log in read_plate_logs(folder):
        found = touched_rows(log)
        if found is None:
            continue
        count = len(found.rows)
        unknown = np.full((count, 3), np.nan, np.float32)
        touch = (found.touch + touches).astype(np.int32)
        touches = int(touch[-1]) + 1
        samples = Samples(
            tared=(log.electrodes[found.rows] - found.rest).astype(np.float32),
            rest=np.tile(found.rest.astype(np.float32), (count, 1)),
            trial=touch,
            location=unknown,
            force=unknown,
            centre=unknown,
            # The archive holds where the plate pushes to, which is into the skin.
            normal=-log.normal[found.rows].astype(np.float32),
        )
        parts.append((log.name, samples, touch))
    if not parts:
        raise DatasetError(
            f"{folder / CONTACT_NORMAL}: no log is touched", remedy="give the whole archive"
        )
    network = folder / AUTHORS_NETWORK
    archives = [folder / CONTACT_NORMAL, *([network] if network.is_file() else [])]
    systems = systems_of("normal")
    if network.is_file():
        systems = (*systems, authors_network(network))
    return Recorded(
        Samples.joined([samples for _, samples, _ in parts]),
        np.concatenate([touch for _, _, touch in parts]),
        np.repeat(np.arange(len(parts), dtype=np.int32), [len(touch) for _, _, touch in parts]),
        tuple(name for name, _, _ in parts),
        Provenance(
            source="LASA contact normals (Alexis-Georganopoulos/Robotic-Finger), one real BioTac",
            command="",
            input_sha256=sha256_of(archives[0]),
            licence="GPL-3.0: numbers only",
            palpate_version=__version__,
            notes="touched rows; each log tared by its own untouched rows",
        ),
        "".join(sha256_of(path) for path in archives),
        systems,
    )


def _folds(rows: Recorded, split: SplitName) -> Iterator[Fold]:
    if split == "unit":
        for test, name in enumerate(rows.names):
            seen = " + ".join(each for each in rows.names if each != name)
            sides = unseen_sensor(
                rows.recording, rows.block, test_sensor=test, guard_rows=GUARD_ROWS
            )
            yield Fold(split, f"{seen} to {name}", "", sides)
    elif split == "log":
        yield _longest_to_others(rows)
    elif split == "touch":
        longest = np.flatnonzero(rows.recording == _longest(rows))
        name = rows.names[_longest(rows)]
        yield from _in_turn(split, name, rows, longest, guard_rows=0)
    else:
        for number, name in enumerate(rows.names):
            mine = np.flatnonzero(rows.recording == number)
            if split == "block":
                yield from _in_turn(split, name, rows, mine, guard_rows=GUARD_ROWS)
            else:
                sides = last_part(rows.recording[mine], guard_rows=GUARD_ROWS)
                yield Fold(split, name, "", _of(mine, sides))


def _in_turn(
    split: SplitName, name: str, rows: Recorded, mine: npt.NDArray[np.int64], *, guard_rows: int
) -> Iterator[Fold]:
    folds = contiguous_folds(
        rows.block[mine], rows.recording[mine], folds=FOLDS, guard_rows=guard_rows
    )
    for number, sides in enumerate(folds):
        yield Fold(split, name, str(number + 1), _of(mine, sides))


def _of(mine: npt.NDArray[np.int64], sides: RowSplit) -> RowSplit:
    return RowSplit(mine[sides.train], mine[sides.validation], mine[sides.test], mine[sides.guard])


def _longest(rows: Recorded) -> int:
    return int(np.bincount(rows.recording).argmax())


def _longest_to_others(rows: Recorded) -> Fold:
    """Train on the longest log, whose every tenth touch validates; test on all others."""
    seen = rows.recording == _longest(rows)
    touches = np.unique(rows.block[seen])
    validation = seen & np.isin(rows.block, touches[4::10])
    sides = (seen & ~validation, validation, ~seen, np.zeros(len(seen), bool))
    name = rows.names[_longest(rows)]
    return Fold("log", f"{name} to all others", "", RowSplit(*map(np.flatnonzero, sides)))


LAYERS = 8


def authors_network(path: Path) -> System:
    """The network that the plate's authors published, as a system; it is not trained again.

    Raises:
        DatasetError: The file is damaged.
    """
    names = [f"{what}{layer}" for layer in range(LAYERS) for what in ("coeff", "bias")]
    arrays = read_archive(path, lambda _: names, remedy="give the file as it was published")
    weights = tuple(arrays[name].astype(np.float64) for name in names)
    return System(
        "the authors' network",
        "7 layers of 5, trained by its authors on a part of the longest log",
        partial(_fit_authors, weights),
        ("normal",),
    )


def _fit_authors(
    weights: Sequence[npt.NDArray[np.float64]],
    quantity: Quantity,
    train: Samples,
    validation: Samples,
    seed: int,
) -> Estimate:
    """It gives x and z of the push; the sign of y, which it leaves open, is that of the truth."""

    def estimate(samples: Samples) -> FloatArray:
        values = samples.tared.astype(np.float64)
        for layer in range(LAYERS):
            values = values @ weights[2 * layer] + weights[2 * layer + 1]
            if layer < LAYERS - 1:
                values = np.maximum(values, 0.0)
        x, z = -values.T
        y = np.sqrt(np.clip(1.0 - x**2 - z**2, 0.0, None)) * np.sign(samples.normal[:, 1])
        return np.column_stack([x, y, z]).astype(np.float32)

    return estimate
