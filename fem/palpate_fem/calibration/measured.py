"""Indentations on disk: HDF5 schema ``palpate.indentations`` version 1.

::

    /                          schema, schema_version, frame, origin, source
    /trajectories/<id>         indenter, sensor; outcome (only if simulated)
        pose   (K, 7)  unit "m, 1"  position, unit quaternion w x y z of the indenter, sensor frame
        force  (K, 3)  unit "N"     net force on the BioTac, sensor frame

Datasets and ids (``sphere_medium/03/normal``) are those of the simulation store. Origin is
``measured`` or ``simulated``, so that nothing compares a simulation with itself and calls it a
validation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ConfigError, DatasetError
from palpate.files.hdf5 import (
    Hdf5Schema,
    h5py_module,
    hdf5_written_whole,
    opened,
    read_array,
    schema_of,
    text,
)
from palpate.files.simulation_store import check_id
from palpate_fem.arrays import Floats

INDENTATIONS = Hdf5Schema(
    "palpate.indentations",
    1,
    "write it with palpate_fem.calibration.measured, or set the attributes of palpate.indentations",
)
MEASURED, SIMULATED = "measured", "simulated"
UNITS = {"pose": "m, 1", "force": "N"}
COLUMNS = {"pose": 7, "force": 3}

_UNIT_QUATERNION = 1e-3
"""A quaternion may miss length 1 by this: single precision and rounded text do, mixed-up columns
do not."""


@dataclass(frozen=True, slots=True)
class MeasuredIndentation:
    """One indentation: the way of the indenter and the force that answered.

    Attributes:
        name: Unique in its file; words between slashes, as the ids of a simulation store.
        indenter: Name of the indenter.
        sensor: Which BioTac, e.g. ``biotac1``.
        pose: Indenter in the sensor frame, position [m] and quaternion w x y z, shape (K, 7); the
            quaternions are brought to length 1.
        force: Net force on the BioTac [N], sensor frame, shape (K, 3).
        origin: ``measured`` or ``simulated``.
        outcome: How it ended, if simulated (the words of ``result.IndentationOutcome``).

    Raises:
        DatasetError: Shapes, NaN, no unit quaternion, no movement; names the trajectory.
    """

    name: str
    indenter: str
    sensor: str
    pose: Floats
    force: Floats
    origin: str = MEASURED
    outcome: str = ""

    def __post_init__(self) -> None:
        problem = self._problem()
        if problem:
            raise DatasetError(
                f"trajectory {self.name!r}: {problem}",
                remedy="correct it, or leave this trajectory out",
            )
        lengths = np.linalg.norm(self.pose[:, 3:], axis=1, keepdims=True)
        pose = np.hstack([self.pose[:, :3], self.pose[:, 3:] / lengths])
        object.__setattr__(self, "pose", pose)

    def _problem(self) -> str:
        try:
            check_id(self.name)
        except ConfigError as error:
            return error.problem
        if not self.indenter or not self.sensor:
            return "it names no indenter or no sensor"
        if self.origin not in (MEASURED, SIMULATED):
            return f"origin {self.origin!r} is neither {MEASURED!r} nor {SIMULATED!r}"
        for name, columns in COLUMNS.items():
            array = getattr(self, name)
            if array.ndim != 2 or array.shape[1] != columns:
                return f"{name} has shape {array.shape}, expected (K, {columns})"
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                return f"{name} is not finite in row {row}"
        if len(self.pose) != len(self.force):
            return f"{len(self.pose)} poses but {len(self.force)} forces"
        if len(self.pose) < 2:
            return f"{len(self.pose)} samples, at least 2 are needed"
        lengths = np.linalg.norm(self.pose[:, 3:], axis=1)
        if np.abs(lengths - 1.0).max() > _UNIT_QUATERNION:
            return f"orientation is no unit quaternion in row {np.abs(lengths - 1.0).argmax()}"
        if not np.ptp(self.pose[:, :3], axis=0).any():
            return "the indenter does not move"
        return ""


def write_indentations(
    path: Path, indentations: Sequence[MeasuredIndentation], *, source: str
) -> None:
    """Write indentations; the file appears complete or not at all.

    Args:
        path: File to write (``.h5``).
        indentations: All of one origin, names unique.
        source: Where they come from: command, rig, publication.

    Raises:
        DatasetError: None, two of one name, of both origins, or the disk refused.
    """
    if not indentations:
        raise DatasetError(f"nothing to write to {path}", remedy="give at least one trajectory")
    names = [item.name for item in indentations]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"two trajectories are named {twice!r}", remedy="rename one")
    if len({item.origin for item in indentations}) > 1:
        raise DatasetError(
            "measured and simulated trajectories together", remedy="write them into two files"
        )
    with hdf5_written_whole(path, extra="fem") as file:
        file.attrs.update(INDENTATIONS.facts)
        file.attrs["origin"] = indentations[0].origin
        file.attrs["source"] = source
        for item in indentations:
            group = file.create_group(f"trajectories/{item.name}")
            group.attrs["indenter"] = item.indenter
            group.attrs["sensor"] = item.sensor
            if item.outcome:
                group.attrs["outcome"] = item.outcome
            for name, unit in UNITS.items():
                group.create_dataset(name, data=getattr(item, name)).attrs["unit"] = unit


def read_indentations(path: Path) -> tuple[MeasuredIndentation, ...]:
    """Read indentations and check everything about them but the names of the indenters.

    Args:
        path: File of schema ``palpate.indentations``.

    Returns:
        The trajectories, sorted by name.

    Raises:
        DatasetError: The file is missing, damaged, of another schema, version, frame or unit, or a
            trajectory is wrong; the message names file and trajectory.
    """
    h5 = h5py_module("fem")
    with opened(path, extra="fem", missing="give a file of indentations (.h5)") as file:
        origin = _origin(path, file)
        groups = file.get("trajectories")
        found = _trajectories(groups, h5.Group) if isinstance(groups, h5.Group) else {}
        if not found:
            raise DatasetError(
                f"{path}: no trajectories", remedy="write each as a group /trajectories/<id>"
            )
        return tuple(_read(path, name, found[name], origin) for name in sorted(found))


def is_file_of(path: Path, schema: str) -> bool:
    """Whether a file is HDF5 and states this schema."""
    try:
        return schema_of(path, extra="fem") == schema
    except DatasetError:
        return False


def _origin(path: Path, file: Any) -> str:
    """Check the attributes at the root and return the origin."""
    INDENTATIONS.check(path, file)
    origin = text(file.attrs.get("origin", ""))
    if origin not in (MEASURED, SIMULATED):
        raise DatasetError(
            f"{path}: attribute origin is {origin!r}",
            remedy=f"set it to {MEASURED!r} or {SIMULATED!r}",
        )
    return origin


def _trajectories(group: Any, kind: type, above: str = "") -> dict[str, Any]:
    """Groups with arrays, or with nothing in them, by id: an id may have slashes."""
    found: dict[str, Any] = {}
    for name, child in group.items():
        if not isinstance(child, kind):
            continue
        inner = _trajectories(child, kind, f"{above}{name}/")
        held = group[name]
        has_arrays = any(array in held and not isinstance(held[array], kind) for array in COLUMNS)
        if has_arrays or not inner:
            found[above + name] = child
        found |= inner
    return found


def _read(path: Path, name: str, group: Any, origin: str) -> MeasuredIndentation:
    for attribute in ("indenter", "sensor"):
        if attribute not in group.attrs:
            raise DatasetError(
                f"{path}: trajectory {name!r} has no attribute {attribute}", remedy="set it"
            )
    try:
        return MeasuredIndentation(
            name,
            text(group.attrs["indenter"]),
            text(group.attrs["sensor"]),
            _array(name, group, "pose"),
            _array(name, group, "force"),
            origin,
            text(group.attrs.get("outcome", "")),
        )
    except DatasetError as error:
        raise DatasetError(f"{path}: {error.problem}", remedy=error.remedy) from error


def _array(trajectory: str, group: Any, name: str) -> Floats:
    where = f"trajectory {trajectory!r}"
    values = read_array(where, group, name, UNITS[name])
    if values.dtype.kind not in "fiu":
        raise DatasetError(
            f"{where}: {name} holds {values.dtype}, no numbers", remedy=f"write {name} as float64"
        )
    return np.asarray(values, np.float64)
