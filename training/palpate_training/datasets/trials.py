"""One trial from robot to data set: raw streams, then rows, then rows with a simulated field.

Everything is in the sensor frame (x distal, y lateral, z dorsal), SI; force is the force on the
BioTac. A *trajectory* is planned once and has an id; a *trial* is its execution on one unit.

Raw trials on disk: schema ``palpate.trials``, version 1, one trial in memory at a time.

A group ``trials/00000``, ``trials/00001``... for each trial, in order of writing, with what the
trial is as attributes and its streams as datasets. Every trial has a digest of its own, and the
file one over these, so a reader can stream and still trust what it has read so far.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.hdf5 import Hdf5Schema, hdf5_written_whole, opened, read_array, text
from palpate.messages import COUNTS_MAX
from palpate_training.datasets.container import (
    Provenance,
    StoredColumn,
    StoredTables,
    read_provenance,
    write_array,
    write_header,
)
from palpate_training.datasets.features import ELECTRODES

if TYPE_CHECKING:
    import h5py

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.uint16]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TrialHeader:
    """What a trial is.

    Attributes:
        unit: Name of the BioTac, e.g. ``biotac-1``.
        trajectory: Id of the planned trajectory, ``<indenter>/<point>/<normal|angled-k>``; the same
            on every unit.
        indenter: Name of the indenter.
        arm: ``left`` or ``right``: which arm of the robot executed it.
    """

    unit: str
    trajectory: str
    indenter: str
    arm: str


PRESS_KINDS = ("normal", "angled", "path", "random")
"""How a finger is pressed at a point: the third part of a trajectory's id, without its number."""


def press_kind(trajectory: str) -> str:
    """Kind of a trajectory by its id, one of ``PRESS_KINDS``; empty where the id does not tell it.

    Those of the paper's files do not: they are ``<indenter>/<number>``.
    """
    kind = trajectory.rpartition("/")[2].partition("-")[0]
    return kind if kind in PRESS_KINDS else ""


def trial_name(header: TrialHeader) -> str:
    """Unit and trajectory, as messages name a trial."""
    return f"{header.unit} {header.trajectory}"


def reason_of(trial: str, error: DatasetError) -> str:
    """Why a trial is left out, to be told after its name, which the error begins with, too."""
    return str(error).removeprefix(f"{trial}: ")


@dataclass(frozen=True, slots=True)
class RawTrial:
    """Streams of one trial on one clock, at 100 Hz or more, from 3 mm before contact on.

    Attributes:
        header: What it is.
        time_s: Of each sample [s], shape (T,), increasing.
        electrodes: Raw counts [counts], shape (T, 19).
        force: Of the force/torque sensor, not tared [N], shape (T, 3).
        tip: Indenter's tip by the robot's kinematics and the registration [m], shape (T, 3).
        travel_m: Commanded travel along the path [m], shape (T,); 0 where it starts.
        increment_end: Index of the last sample of each increment, shape (I,), increasing; the first
            is before any contact.
    """

    header: TrialHeader
    time_s: Floats
    electrodes: Counts
    force: Floats
    tip: Floats
    travel_m: Floats
    increment_end: Indices


@dataclass(frozen=True, slots=True)
class SimulatedTrial:
    """A trajectory in finite elements, step by step, from first contact on.

    Attributes:
        trajectory: Its id.
        travel_m: Indenter's travel along the path at each step [m], shape (S,), increasing, on any
            origin.
        force: Net force on the BioTac [N], shape (S, 3).
        displacement: Of every node from the pressurised state [m], shape (S, V, 3), float32.
        converged: How many of the steps count: those before a divergence.
        contact_force: Force of the indenter on each node of the skin's outer surface [N], shape
            (S, O, 3), float32, in the order of ``SkinMesh.outer_nodes``; None if it is not known.
    """

    trajectory: str
    travel_m: Floats
    force: Floats
    displacement: npt.NDArray[np.float32]
    converged: int
    contact_force: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True)
class TrialRows:
    """Rows of one trial after the paper's processing, in order of travel.

    Attributes:
        header: What it is.
        rest: Untouched counts that were subtracted [counts], shape (19,).
        travel_m: Indenter's travel since the row at exactly 0.5 N [m], shape (R,); starts at 0.
        tared: Electrodes minus rest, over full scale [1], shape (R, 19).
        force: Tared, filtered force on the BioTac [N], shape (R, 3).
        location: Contact location: the indenter's tip as measured [m], shape (R, 3).
    """

    header: TrialHeader
    rest: Floats
    travel_m: Floats
    tared: Floats
    force: Floats
    location: Floats


@dataclass(frozen=True, slots=True)
class MixedRows:
    """Experiment and simulation of one trial at the same displacements, 20 of them.

    Attributes:
        rows: The experiment, interpolated; its ``travel_m`` is evenly spaced from 0.
        simulated_force: Net force of the simulation there [N], shape (R, 3).
        displacement: Nodal displacement there [m], shape (R, V, 3), float32.
        contact_force: Force of the indenter on each outer node there [N], shape (R, O, 3), float32;
            None if it is not known.
        shares: What each step of the simulation up to its divergence contributes to each row, shape
            (R, S), rows of sum 1; None = not known.
    """

    rows: TrialRows
    simulated_force: Floats
    displacement: npt.NDArray[np.float32]
    contact_force: npt.NDArray[np.float32] | None = None
    shares: Floats | None = None


_log = logging.getLogger(__name__)

TRIALS_SCHEMA = Hdf5Schema("palpate.trials", 1, "`palpate data inspect` shows what the file is")
GROUP = "trials"

COLUMNS: dict[str, StoredColumn] = {
    "time_s": StoredColumn("s", np.float64),
    "electrodes": StoredColumn("counts", np.uint16),
    "force": StoredColumn("N", np.float64),
    "tip": StoredColumn("m", np.float64),
    "travel_m": StoredColumn("m", np.float64),
    "increment_end": StoredColumn("1", np.int64),
}
"""Streams of a trial; what they mean: ``RawTrial``."""

_WIDTH = {"electrodes": (ELECTRODES,), "force": (3,), "tip": (3,)}
_WORDS = tuple(field.name for field in fields(TrialHeader))
_NO_PROVENANCE = Provenance("", "", "", "", "")  # of a file, so no part of a trial's digest


@dataclass(frozen=True, slots=True)
class TrialsContents:
    """What a file of trials holds, without its streams.

    Attributes:
        headers: Of each trial, in order.
        samples: Number of samples of each.
        content_sha256: Digest over all trials, hex.
        provenance: Where they come from.
    """

    headers: tuple[TrialHeader, ...]
    samples: tuple[int, ...]
    content_sha256: str
    provenance: Provenance


def write_trials(path: Path, trials: Iterable[RawTrial], provenance: Provenance) -> str:
    """Write trials, one by one as they come; returns the content's SHA-256, hex.

    The file appears whole or not at all.

    Raises:
        DatasetError: No trial, one twice, streams of a wrong shape or type, or the disk refused.
    """
    seen: set[tuple[str, str]] = set()
    digests: list[str] = []
    with hdf5_written_whole(path, extra="training") as file:
        for trial in trials:
            _check_new(str(path), trial.header, seen)
            _check_streams(f"{path}: {trial_name(trial.header)}", trial)
            name = _name(len(digests))
            for column in COLUMNS:
                write_array(file, f"{name}/{column}", COLUMNS[column], getattr(trial, column))
            digests.append(_digest(trial))
            file[name].attrs.update({**asdict(trial.header), "content_sha256": digests[-1]})
        if not digests:
            raise DatasetError(f"{path}: no trials to write", remedy="execute or ingest some")
        digest = _digest_of_all(digests)
        write_header(file, TRIALS_SCHEMA, digest, provenance, {"trial_count": len(digests)})
    _log.info("wrote %s: %d trials, content %s", path, len(digests), digest[:12])
    return digest


def read_contents(path: Path) -> TrialsContents:
    """What a file holds; its streams are neither read nor checked.

    Raises:
        DatasetError: The file is missing, damaged or truncated, of another schema or version, lacks
            a trial, or holds one twice; names file and group.
    """
    with opened(path, extra="training") as file:
        return _contents(path, file)


def read_trials(path: Path) -> Iterator[RawTrial]:
    """Read trials one by one, in order of writing, and check each before it is given.

    All headers are checked before the first trial comes.

    Raises:
        DatasetError: As ``read_contents``, or a stream is missing, in another unit, of another type
            or shape, or was changed after writing; names file, trial and dataset.
    """
    with opened(path, extra="training") as file:
        for number, header in enumerate(_contents(path, file).headers):
            name = _name(number)
            streams: dict[str, Any] = {
                key: read_array(path, file, f"{name}/{key}", column.unit, column.dtype)
                for key, column in COLUMNS.items()
            }
            trial = RawTrial(header=header, **streams)
            _check_streams(f"{path}: {trial_name(header)}", trial)
            if _digest(trial) != text(file[name].attrs["content_sha256"]):
                raise DatasetError(
                    f"{path}: {name} ({trial_name(header)}) does not match its content_sha256",
                    remedy="it was changed after writing; ingest the record again",
                )
            yield trial


def _contents(path: Path, file: h5py.File) -> TrialsContents:
    TRIALS_SCHEMA.check(path, file)
    for name in ("trial_count", "content_sha256"):
        if name not in file.attrs:
            raise DatasetError(f"{path}: attribute {name} is missing", remedy=_AGAIN)
    count = int(file.attrs["trial_count"])
    held = set(file[GROUP]) if GROUP in file else set()
    expected = [_name(number).removeprefix(f"{GROUP}/") for number in range(count)]
    if held != set(expected):
        absent = sorted(set(expected) - held)
        what = f"group {GROUP}/{absent[0]} is missing" if absent else f"has {len(held)} groups"
        raise DatasetError(f"{path}: {what}; the file says {count} trials", remedy=_AGAIN)
    seen: set[tuple[str, str]] = set()
    headers, samples, digests = [], [], []
    for number in range(count):
        name = _name(number)
        attributes = file[name].attrs
        for word in (*_WORDS, "content_sha256"):
            if word not in attributes:
                raise DatasetError(f"{path}: {name} has no attribute {word}", remedy=_AGAIN)
        header = TrialHeader(**{word: text(attributes[word]) for word in _WORDS})
        _check_new(str(path), header, seen)
        headers.append(header)
        samples.append(len(file[name]["time_s"]) if "time_s" in file[name] else 0)
        digests.append(text(attributes["content_sha256"]))
    digest = text(file.attrs["content_sha256"])
    if digest != _digest_of_all(digests):
        raise DatasetError(
            f"{path}: its trials do not match its content_sha256",
            remedy="trials were added, removed or changed after writing; ingest the record again",
        )
    return TrialsContents(tuple(headers), tuple(samples), digest, read_provenance(file.attrs))


_AGAIN = "copy the file again, or ingest the record again"


def _name(number: int) -> str:
    return f"{GROUP}/{number:05d}"


def _digest(trial: RawTrial) -> str:
    """Over header and streams of a trial, hex."""
    arrays = {name: getattr(trial, name) for name in COLUMNS}
    return StoredTables(arrays, asdict(trial.header), _NO_PROVENANCE).content_sha256()


def _digest_of_all(digests: list[str]) -> str:
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _check_new(where: str, header: TrialHeader, seen: set[tuple[str, str]]) -> None:
    key = (header.unit, header.trajectory)
    if key in seen:
        raise DatasetError(
            f"{where}: {trial_name(header)} is there twice",
            remedy="a unit executes a trajectory once; leave one of the two out",
        )
    seen.add(key)


def _check_streams(where: str, trial: RawTrial) -> None:
    count = len(trial.time_s)
    for name, column in COLUMNS.items():
        array: npt.NDArray[Any] = getattr(trial, name)
        length = len(array) if name == "increment_end" else count
        shape = (length, *_WIDTH.get(name, ()))
        if array.shape != shape or array.dtype != column.dtype or length == 0:
            raise DatasetError(
                f"{where}: {name} is {array.dtype} {array.shape}, expected"
                f" {np.dtype(column.dtype)} {shape} with at least one sample",
                remedy="give a sample of every stream for each time",
            )
    above = np.flatnonzero((trial.electrodes > COUNTS_MAX).any(axis=1))
    if above.size:
        raise DatasetError(
            f"{where}: electrodes is above {COUNTS_MAX} counts in sample {above[0]}",
            remedy="raw counts have 12 bits; write them as read, nothing subtracted or scaled",
        )
