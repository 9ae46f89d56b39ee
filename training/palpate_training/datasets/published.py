"""The published layout, ``biotac1.hdf5`` and so on, as an experiment's data set.

Known of the paper's own files, ``biotac1.hdf5`` to ``biotac3.hdf5``: groups ``electrode_vals``,
``contact_loc``, ``force_vec`` and ``indenter_type``, each with an array ``data``, and rows in order
of trajectories (as the ACROSS framework reads them).
Their frame and their side of the force are not written down, so both can be given, and are checked:
the pad looks to -z, and what presses it pushes towards +z.

A file that palpate exported names the trajectory of each row, in the group ``trajectory``: numbers
in ``data``, which are places in ``names``. The paper's name none, so trajectories are found: where
each begins, and which are the same. A published file holds the rows of one BioTac, trajectory after
trajectory, each beginning with a row at exactly 0.5 N (paper, section "Experimental data
processing").
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.errors import DatasetError
from palpate.files.hdf5 import name_a_file, opened, text
from palpate.process import require
from palpate_training.datasets.assembly import assemble_experiment
from palpate_training.datasets.container import Provenance, read_provenance
from palpate_training.datasets.experiment import ExperimentDataset
from palpate_training.datasets.features import ELECTRODES, LOCATION_MOST_M
from palpate_training.datasets.processing import THRESHOLD_N
from palpate_training.datasets.trials import TrialHeader, TrialRows

if TYPE_CHECKING:
    import h5py

Floats = npt.NDArray[np.float64]

UNITS = (1, 2, 3)
"""BioTacs of the paper."""

GROUPS: dict[str, tuple[str, ...]] = {
    "electrodes": ("electrode_vals",),
    "location": ("contact_loc",),
    "indenter": ("indenter_type",),
    "force": ("force_vec", "force", "forces", "force_vals", "contact_force"),
}
"""Names a group may have, the likeliest first."""

LARGEST_FORCE_N = 100.0
"""The paper's largest is 32.1 N."""

LARGEST_M = (0.004, LOCATION_MOST_M)
"""Between these lies the largest coordinate of a contact on a fingertip 28 mm long [m]."""


def published_file(folder: Path, unit: int) -> Path:
    """Where the rows of a BioTac are."""
    return folder / f"biotac{unit}.hdf5"


def published_unit(path: Path) -> int | None:
    """Number of the BioTac whose rows a file has by its name; None for any other name."""
    found = re.fullmatch(r"biotac(0|[1-9][0-9]*)\.hdf5", path.name)
    return int(found[1]) if found else None


def published_units(folder: Path) -> list[int]:
    """Numbers of the BioTacs whose rows are in a folder, ascending."""
    numbers = map(published_unit, folder.glob("biotac*.hdf5"))
    return sorted(number for number in numbers if number is not None)


def read_published(
    folder: Path,
    *,
    units: Sequence[int] | None = None,
    axes: Sequence[str] = ("x", "y", "z"),
    force_on_indenter: bool = False,
    command: str = "",
) -> ExperimentDataset:
    """Read the published layout and find its trajectories.

    Args:
        folder: With ``biotac1.hdf5`` and so on.
        units: Numbers of the BioTacs to read; None = all that are there.
        axes: Where the sensor frame's x, y and z are in the file: ``("x", "-z", "y")`` if its y is
            dorsal.
        force_on_indenter: Whether the file holds the force on the indenter, of opposite sign.
        command: The command line, for the provenance.

    Returns:
        Rows in SI, sensor frame; ``trial_rest`` is NaN, as the files do not hold it.

    Raises:
        DatasetError: A file or group is missing or damaged, values are not plausible in their unit
            or frame, or rows are there twice; names the file.
    """
    wanted = _present(folder, units)
    files = [
        _PublishedFile(published_file(folder, unit), axes, force_on_indenter) for unit in wanted
    ]
    _check_frame(folder, files)
    digests: dict[str, Path] = {}
    for file in files:
        if file.sha256 in digests:
            raise DatasetError(
                f"{file.path} holds the same rows as {digests[file.sha256].name}",
                remedy="copy each BioTac's own file",
            )
        digests[file.sha256] = file.path
    runs = [find_runs(str(f.path), f.force, f.location, f.indenter, f.trajectory) for f in files]
    # Ids of two exports are numbers that each gave by itself.
    exports = {(f.provenance.source, f.provenance.input_sha256) for f in files}
    named = len(exports) == 1 and all(file.trajectory is not None for file in files)
    names = name_trajectories(runs, stated=named)
    trials = [
        _trial(f"biotac-{unit}", file, run, name)
        for unit, file, of_file, ids in zip(wanted, files, runs, names, strict=True)
        for run, name in zip(of_file, ids, strict=True)
    ]
    # An export of palpate's own says where it comes from; the publisher's files do not.
    sources = dict.fromkeys(f.provenance.source for f in files if f.provenance.source)
    licences = dict.fromkeys(f.provenance.licence for f in files if f.provenance.licence)
    found = (
        "as the files name them"
        if named
        else "found by indenter, fall of the force to 0.5 N and jumps of the tip, and matched over"
        " units by place and direction"
    )
    published = "published experiment of Narang et al.: " + ", ".join(f.path.name for f in files)
    provenance = Provenance(
        source="; ".join(sources) or published,
        command=command,
        input_sha256=hashlib.sha256("".join(f.sha256 for f in files).encode()).hexdigest(),
        licence="; ".join(licences) or "the publisher's; see where it was downloaded",
        palpate_version=__version__,
        notes=f"axes {','.join(axes)}; location was in {files[0].location_unit};"
        f" trajectories {found}; input_sha256 is of the arrays",
    )
    return assemble_experiment(trials, provenance)


def _present(folder: Path, units: Sequence[int] | None) -> list[int]:
    there = published_units(folder)
    if units is None and not there:
        raise DatasetError(
            f"{folder} holds none of the published files"
            f" {', '.join(published_file(folder, unit).name for unit in UNITS)}",
            remedy=f"download them; or, of another data set, {name_a_file(folder)}",
        )
    wanted = there if units is None else list(units)
    missing = [published_file(folder, unit).name for unit in wanted if unit not in there]
    if missing or not wanted:
        raise DatasetError(
            f"{folder}: {', '.join(missing) or 'no unit'} is missing",
            remedy=f"download it, or choose among the units that are there: {there or 'none'}",
        )
    return wanted


class _PublishedFile:
    """Rows of one published file, checked and converted."""

    def __init__(self, path: Path, axes: Sequence[str], force_on_indenter: bool) -> None:
        self.path = path
        with opened(path, extra="training") as file:
            arrays: dict[str, npt.NDArray[Any]] = {
                name: file[_group(path, file, name)]["data"][()] for name in GROUPS
            }
            names = file[_group(path, file, "indenter")]["data"].attrs.get("names")
            self.trajectory = _stated_trajectories(path, file, len(arrays["indenter"]))
            self.provenance = read_provenance(file.attrs)
        rows = len(arrays["electrodes"])
        for name, columns in (("electrodes", ELECTRODES), ("location", 3), ("force", 3)):
            _check_table(path, name, arrays[name], (rows, columns))
        if rows == 0 or arrays["indenter"].size != rows:
            raise DatasetError(
                f"{path}: indenter_type has {arrays['indenter'].size} values for {rows} rows",
                remedy="download the file again",
            )
        self.tared = _tared(path, arrays["electrodes"])
        self.location, self.location_unit = _metres(path, arrays["location"])
        self.force = _newtons(path, arrays["force"]) * (-1.0 if force_on_indenter else 1.0)
        self.location, self.force = _turned(self.location, axes), _turned(self.force, axes)
        self.indenter = _indenters(path, arrays["indenter"].reshape(-1), names)
        _check_unique(path, np.hstack([self.tared, self.location, self.force]))
        digest = hashlib.sha256()
        for values in (self.tared, self.location, self.force):
            digest.update(np.ascontiguousarray(values, "<f8").tobytes())
        self.sha256 = digest.hexdigest()


def _group(path: Path, file: h5py.File, name: str) -> str:
    for candidate in GROUPS[name]:
        if f"{candidate}/data" in file:
            return candidate
    raise DatasetError(
        f"{path}: no group {' or '.join(GROUPS[name])} with an array 'data'; found"
        f" {', '.join(file) or 'nothing'}",
        remedy="download the file again; if its group has another name, rename it",
    )


def _check_table(path: Path, name: str, values: npt.NDArray[Any], shape: tuple[int, int]) -> None:
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise DatasetError(
            f"{path}: {name} is {values.dtype} {values.shape}, expected numbers {shape}",
            remedy="download the file again; a BioTac has 19 electrodes",
        )
    bad = np.flatnonzero(~np.isfinite(values.astype(np.float64)).all(axis=1))
    if bad.size:
        raise DatasetError(
            f"{path}: {name} is not finite in row {bad[0]} ({bad.size} rows in all)",
            remedy="download the file again",
        )


def _tared(path: Path, values: npt.NDArray[Any]) -> Floats:
    largest = float(np.abs(values.astype(np.float64)).max())
    if not 0.0 < largest <= 1.0:
        raise DatasetError(
            f"{path}: electrodes reach {largest:.4g}; tared over full scale they lie in [-1, 1]",
            remedy="subtract the first row of each trajectory and divide by 4095",
        )
    return np.asarray(values, np.float64)


def _metres(path: Path, values: npt.NDArray[Any]) -> tuple[Floats, str]:
    largest = float(np.abs(values).max())
    for unit, metres in (("m", 1.0), ("mm", 1e-3)):
        if LARGEST_M[0] <= largest * metres <= LARGEST_M[1]:
            return np.asarray(values, np.float64) * metres, unit
    raise DatasetError(
        f"{path}: the largest coordinate of contact_loc is {largest:.4g}, on a fingertip neither in"
        " m nor in mm",
        remedy="convert contact_loc to m in the frame of the sensor",
    )


def _newtons(path: Path, values: npt.NDArray[Any]) -> Floats:
    force = np.asarray(values, np.float64)
    magnitude = np.linalg.norm(force, axis=1)
    # A row interpolated linearly in the magnitude may be below 0.5 N, but not by half.
    if magnitude.max() > LARGEST_FORCE_N or magnitude.min() < 0.5 * THRESHOLD_N:
        raise DatasetError(
            f"{path}: forces of {magnitude.min():.4g} to {magnitude.max():.4g} are not in N; the"
            f" paper keeps {THRESHOLD_N} N and more, and stays below {LARGEST_FORCE_N:g} N",
            remedy="convert the force to N and leave out rows below 0.5 N",
        )
    return force


def _turned(values: Floats, axes: Sequence[str]) -> Floats:
    if sorted(axis.removeprefix("-") for axis in axes) != ["x", "y", "z"]:
        raise DatasetError(
            f"axes {','.join(axes)} are no axes", remedy="name x, y and z once, e.g. x,-z,y"
        )
    turn = np.zeros((3, 3))
    for row, axis in enumerate(axes):
        turn[row, "xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    if np.linalg.det(turn) < 0.0:
        raise DatasetError(
            f"axes {','.join(axes)} are a mirror image", remedy="turn the sign of one axis"
        )
    return np.asarray(values @ turn.T)


def _indenters(path: Path, kinds: npt.NDArray[Any], names: Any) -> Texts:
    """Names: from the file's own list where it has one, else the texts or numbers it holds."""
    if kinds.dtype.kind not in "fiu":
        return np.array([text(kind) for kind in kinds], dtype=object)
    if not np.array_equal(kinds, np.floor(kinds)) or kinds.min() < 0:
        raise DatasetError(
            f"{path}: indenter_type is not made of whole numbers", remedy="download the file again"
        )
    if names is None:
        return np.array([f"indenter-{int(kind)}" for kind in kinds], dtype=object)
    if kinds.max() >= len(names):
        raise DatasetError(
            f"{path}: indenter_type {int(kinds.max())} has no name in its list of {len(names)}",
            remedy="export the file again",
        )
    return np.array([text(names[int(kind)]) for kind in kinds], dtype=object)


def _stated_trajectories(path: Path, file: h5py.File, rows: int) -> Texts | None:
    """Id of each row's trajectory, of a file that palpate exported; None where it states none."""
    if "trajectory/data" not in file or "trajectory/names" not in file:
        return None
    number = file["trajectory/data"][()].reshape(-1)
    names = np.array([text(name) for name in file["trajectory/names"][()]], dtype=object)
    known = np.isin(number, np.arange(len(names))).all()
    if number.dtype.kind not in "iu" or len(number) != rows or not known:
        raise DatasetError(
            f"{path}: trajectory has {len(number)} numbers for {rows} rows, or one that has no name"
            f" in its list of {len(names)}",
            remedy="export the file again",
        )
    return np.asarray(names[number])


def _check_unique(path: Path, rows: Floats) -> None:
    _, first, counts = np.unique(rows, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        row = int(first[counts > 1].min())
        again = np.flatnonzero((rows == rows[row]).all(axis=1))[1]
        raise DatasetError(
            f"{path}: row {again} repeats row {row} ({int((counts - 1).sum())} repeated rows in"
            " all), so a trajectory is there twice",
            remedy="download the file again, or remove the repeated trajectory",
        )


def _check_frame(folder: Path, files: list[_PublishedFile]) -> None:
    where = np.median(np.concatenate([f.location for f in files]), axis=0)
    push = np.median(np.concatenate([f.force for f in files]), axis=0)
    if where[2] >= 0.0 or push[2] <= 0.0:
        raise DatasetError(
            f"{folder}: contacts lie about {np.round(where * 1e3, 1)} mm and push with"
            f" {np.round(push, 2)} N; in the sensor frame the pad looks to -z and is pushed to +z",
            remedy="give --axes, and --force-on-indenter if the force is that on the indenter",
        )


def _trial(unit: str, file: _PublishedFile, run: PublishedRun, trajectory: str) -> TrialRows:
    return TrialRows(
        header=TrialHeader(unit, trajectory, run.indenter, arm=""),
        rest=np.full(ELECTRODES, np.nan),
        travel_m=run.travel_m,
        tared=file.tared[run.rows],
        force=file.force[run.rows],
        location=file.location[run.rows],
    )


Texts = npt.NDArray[np.object_]

FALLEN_N = THRESHOLD_N + 1e-3
"""A force that falls to this or below is back at 0.5 N; the rest is rounding."""

JUMP_M = 0.5e-3
"""Rows of one trajectory are 0.1 mm apart; the tip does not jump five increments."""

SAME_PLACE_M = 1.5e-3
"""How far apart one trajectory may begin on two BioTacs: registration error plus 0.5 N's depth."""

SAME_DIRECTION = np.cos(np.radians(15.0))
"""Cosine of the angle that two BioTacs' paths of one trajectory may differ by: half of the 30
degrees or more by which planned ones of one point differ."""

MIN_PATH_M = 0.3e-3
"""A shorter path has no direction worth comparing."""


@dataclass(frozen=True, slots=True)
class PublishedRun:
    """Rows of one trajectory on one BioTac.

    Attributes:
        rows: Where.
        indenter: By name.
        start: Tip at 0.5 N [m], shape (3,).
        direction: Of the path, a unit vector; zero where the path is too short.
        travel_m: Of each row along the path, from 0 [m], shape (R,).
        trajectory: Its id, where the file states it.
    """

    rows: slice
    indenter: str
    start: Floats
    direction: Floats
    travel_m: Floats
    trajectory: str = ""


def find_runs(
    name: str,
    force: Floats,
    location: Floats,
    indenter: Texts,
    trajectory: Texts | None = None,
) -> list[PublishedRun]:
    """Cut the rows of a file into trajectories.

    A trajectory begins where its id changes. Where ids are not known, it begins where the indenter
    changes, where the force (N, 3) [N] falls back to 0.5 N, or where the tip (N, 3) [m] jumps.

    Raises:
        DatasetError: Ids are not known, and most rows stand alone, so they are in no order of
            trajectories.
    """
    if trajectory is not None:
        begins = np.append(True, trajectory[1:] != trajectory[:-1])
        return _cut(begins, location, indenter, trajectory)
    magnitude = np.linalg.norm(force, axis=1)
    begins = np.ones(len(force), np.bool_)
    begins[1:] = (
        (indenter[1:] != indenter[:-1])
        | ((magnitude[1:] <= FALLEN_N) & (magnitude[1:] < magnitude[:-1]))
        | (np.linalg.norm(np.diff(location, axis=0), axis=1) > JUMP_M)
    )
    runs = _cut(begins, location, indenter, np.full(len(force), "", dtype=object))
    alone = sum(len(run.travel_m) == 1 for run in runs)
    if alone > len(runs) / 2 and len(runs) > 1:
        raise DatasetError(
            f"{name}: {alone} of {len(runs)} trajectories have a single row, so the rows are in"
            " no order of trajectories",
            remedy="use the file as published; a shuffled copy has lost its trajectories",
        )
    return runs


def _cut(
    begins: npt.NDArray[np.bool_], location: Floats, indenter: Texts, trajectory: Texts
) -> list[PublishedRun]:
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(begins))
    return [
        _run(slice(int(a), int(b)), str(indenter[a]), location[a:b], str(trajectory[a]))
        for a, b in zip(starts, ends, strict=True)
    ]


def _run(rows: slice, indenter: str, tip: Floats, trajectory: str) -> PublishedRun:
    way = tip[-1] - tip[0]
    length = float(np.linalg.norm(way))
    along = way / length if length > 0.0 else np.zeros(3)
    # Noise of the tip must not make travel run backward.
    travel_m = np.maximum.accumulate((tip - tip[0]) @ along)
    direction = along if length >= MIN_PATH_M else np.zeros(3)
    return PublishedRun(rows, indenter, tip[0], direction, travel_m, trajectory)


def name_trajectories(units: list[list[PublishedRun]], *, stated: bool = False) -> list[list[str]]:
    """Give the same id to runs of different BioTacs that are the same trajectory.

    Where ids are ``stated``, these are taken. Else such runs have the same indenter, begin in
    nearly the same place and go in nearly the same direction, which is not asked of a path that is
    too short to have one; each BioTac has a trajectory once, so they are assigned one to one. What
    is on one side only gets an id of its own.

    Returns:
        Stated ids, or ``<indenter>/<number>``, in the same order.
    """
    if stated:
        return [[run.trajectory for run in runs] for runs in units]
    assign = require("scipy.optimize", extra="training").linear_sum_assignment
    known: dict[str, list[PublishedRun]] = {}
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


def _distance(one: PublishedRun, other: PublishedRun) -> float:
    """How unlike two runs are, in metres; infinite where they cannot be the same trajectory."""
    apart_m = float(np.linalg.norm(one.start - other.start))
    # The place alone says less than place and direction, so others are preferred.
    compared = one.direction.any() and other.direction.any()
    cosine = float(one.direction @ other.direction) if compared else float(SAME_DIRECTION)
    if apart_m > SAME_PLACE_M or cosine < SAME_DIRECTION:
        return np.inf
    return apart_m + SAME_PLACE_M * (1.0 - cosine)
