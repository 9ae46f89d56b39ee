"""Rows of features: the arrays, what they mean, the checks they pass, and the file that holds them.

On disk: HDF5 schema ``palpate.features`` version 1, written whole or not at all.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.hdf5 import (
    Hdf5Schema,
    check_rows,
    hdf5_written_whole,
    opened,
    read_array,
    rows_sha256,
    text,
)
from palpate.messages import COUNTS_MAX
from palpate.messages.estimates import UNIT_TOLERANCE
from palpate_training.datasets.container import (
    Provenance,
    StoredColumn,
    joined_provenance,
    read_provenance,
    refuse_repeated,
    write_provenance,
)

_log = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]
CountArray = npt.NDArray[np.uint16]
IndexArray = npt.NDArray[np.int32]
TimeArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ELECTRODES = 19
"""Sensing electrodes of a BioTac."""


@dataclass(frozen=True, slots=True)
class FeatureDataset:
    """Rows of electrodes with the force, and where known the contact location, at the same time.

    The rows that a sensor has of a group are in order of time. Checked on construction
    (``DatasetError``).

    Attributes:
        electrodes: Raw counts [counts], uint16, shape ``(N, 19)``.
        baseline: Untouched counts in force at that row [counts], shape ``(N, 19)``.
        force: Force on the BioTac [N], sensor frame, shape ``(N, 3)``.
        group: Recording, trajectory or press that the row belongs to, shape ``(N,)``.
        block: Contiguous piece that is held out as a whole, shape ``(N,)``; unique over groups.
        sensor: Index into ``sensor_names``, shape ``(N,)``.
        sensor_names: Names of the sensors, each another.
        provenance: Where it comes from.
        contact_location: Tip of the indenter [m], sensor frame, shape ``(N, 3)``; NaN where there
            is no contact; None where it is not known.
        centre_of_pressure: Mean of the touched skin, weighted by the pressure [m], sensor frame,
            shape ``(N, 3)``; NaN where there is no contact; None where it is not known.
        contact_normal: Unit vector out of the skin where it is touched, shape ``(N, 3)``; likewise.
        in_contact: Whether the indenter touches, shape ``(N,)``; None = not known.
        time_ns: Time of the row [ns] on one clock per sensor, shape ``(N,)``; None = not known.
    """

    electrodes: CountArray
    baseline: FloatArray
    force: FloatArray
    group: IndexArray
    block: IndexArray
    sensor: IndexArray
    sensor_names: tuple[str, ...]
    provenance: Provenance
    contact_location: FloatArray | None = None
    centre_of_pressure: FloatArray | None = None
    contact_normal: FloatArray | None = None
    in_contact: BoolArray | None = None
    time_ns: TimeArray | None = None
    name: str = field(default="dataset", compare=False)

    def __post_init__(self) -> None:
        _check_shapes(self)
        _check_values(self)

    def __len__(self) -> int:
        return len(self.electrodes)

    @property
    def tared_counts(self) -> FloatArray:
        """Raw minus baseline [counts], float32, shape ``(N, 19)``."""
        tared = self.electrodes.astype(np.float32) - self.baseline
        return tared.astype(np.float32, copy=False)

    def touching(self, threshold_n: float) -> BoolArray:
        """Which rows are in contact, shape ``(N,)``.

        Args:
            threshold_n: Force above which a row counts as such where ``in_contact`` is None [N].
        """
        if self.in_contact is not None:
            return self.in_contact
        return np.asarray(np.linalg.norm(self.force, axis=1) > threshold_n)

    def arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """The arrays that are present, by name, in the order of the schema."""
        named = {name: getattr(self, name) for name in FEATURE_COLUMNS}
        return {name: array for name, array in named.items() if array is not None}

    def content_sha256(self) -> str:
        """SHA-256 of names, shapes and values, hex; does not depend on how the file is laid out."""
        return rows_sha256(self.sensor_names, self.arrays())


def joined(
    parts: Sequence[FeatureDataset],
    *,
    groups: Sequence[Sequence[str]] | None = None,
    command: str = "",
) -> FeatureDataset:
    """Put data sets together; groups and blocks of different ones stay apart.

    Sensors of the same name are the same sensor.

    Args:
        parts: At least one, all with the same columns.
        groups: What each group of each part is called, by its number: those of the same name are
            one, and held out together. None = groups of different parts are different ones.
        command: For provenance.

    Raises:
        DatasetError: A part lacks a column that another one has, has another licence, or holds the
            same presses.
    """
    refuse_same_presses([part.name for part in parts], parts)
    columns = [set(part.arrays()) for part in parts]
    for part, have in zip(parts, columns, strict=True):
        if missing := sorted(set.union(*columns) - have):
            raise DatasetError(
                f"{part.name} does not say {', '.join(missing)}, as another data set does",
                remedy="join data sets with the same columns",
            )
    names = tuple(dict.fromkeys(name for part in parts for name in part.sensor_names))
    arrays: dict[str, list[npt.NDArray[np.generic]]] = {}
    first = {"group": 0, "block": 0}
    numbers: dict[str, int] = {}
    for part, called in zip(parts, groups or itertools.repeat(None, len(parts)), strict=True):
        own = dict(part.arrays())
        own["sensor"] = np.array([names.index(name) for name in part.sensor_names])[part.sensor]
        for name in first:
            _, number = np.unique(own[name], return_inverse=True)
            own[name] = first[name] + number
            first[name] += int(number.max(initial=-1)) + 1
        if called is not None:
            number = np.array([numbers.setdefault(name, len(numbers)) for name in called])
            own["group"] = number[part.group]
        for name, array in own.items():
            arrays.setdefault(name, []).append(array.astype(getattr(part, name).dtype))
    return FeatureDataset(
        **{name: np.concatenate(some) for name, some in arrays.items()},
        sensor_names=names,
        provenance=joined_provenance(
            [part.provenance for part in parts], [part.content_sha256() for part in parts], command
        ),
        name="joined",
    )


def refuse_same_presses(names: Sequence[str | Path], parts: Sequence[FeatureDataset]) -> None:
    """Refuse data sets that have presses in common, whatever was made of them.

    Compared are raw counts, as the force may have been paired otherwise and another rest
    subtracted; and tared counts with the force, as the rest may have been assumed.

    Args:
        names: Of the data sets, for the error.
        parts: The data sets.

    Raises:
        DatasetError: Two have.
    """
    refuse_repeated(names, [(part.tared_counts, part.force) for part in parts])
    refuse_repeated(names, [counts_under_force(part.electrodes, part.force) for part in parts])


def counts_under_force(
    electrodes: npt.NDArray[np.number], force: npt.NDArray[np.floating]
) -> tuple[FloatArray, FloatArray]:
    """Raw counts as ``refuse_repeated`` compares them, whatever the force of a row is.

    Args:
        electrodes: Raw counts, shape ``(N, 19)``.
        force: Force [N], shape ``(N, 3)``.

    Returns:
        The counts, and 1 where they tell a press, shape ``(N, 1)``; 0 where there is no force, or
        no electrode that works: such rows are the same in many recordings.
    """
    works = ~at_an_end(electrodes).all(axis=1, keepdims=True)
    told = force.any(axis=1, keepdims=True) & works
    return electrodes.astype(np.float32), np.asarray(told, np.float32)


NOMINAL_PERIOD_S = 0.01
"""Time between rows where a data set has no times: a BioTac's 100 Hz."""


def period_of(time_ns: TimeArray | None) -> float:
    """Time between two rows of a sensor [s]; ``time_ns`` is that of its rows, in their order."""
    if time_ns is None:
        return NOMINAL_PERIOD_S
    return period_of_steps(np.diff(time_ns)) or NOMINAL_PERIOD_S


STEP_TOLERANCE = 0.5
"""Share of a step by which a row may be early or late."""


def period_of_steps(steps_ns: npt.NDArray[np.int64]) -> float:
    """Time between two rows [s] by the steps of their times [ns], shape ``(N - 1,)``.

    Rows of the same time are a burst, whose step to the next time is that of all its rows. Left
    out are steps of another length, as over a missing row or back; beside a burst a step may be
    longer, as rows may have the time of the first of the burst or of its last.

    Returns:
        The mean of the others; 0 where no step is forward.
    """
    ends = np.flatnonzero(steps_ns)
    steps = 1e-9 * steps_ns[ends].astype(np.float64)
    if not (steps > 0.0).any():
        return 0.0
    rows = np.diff(ends, prepend=-1, append=len(steps_ns))
    before, longer = rows[:-1], np.maximum(rows[:-1], rows[1:])
    period = float(np.median(steps[steps > 0.0]))
    most = (1.0 + STEP_TOLERANCE) * period * longer
    for _ in range(2):  # the second time by the period of rows, and not of bursts
        kept = (steps >= (1.0 - STEP_TOLERANCE) * period) & (steps <= most)
        if not kept.any():
            break
        period = float(steps[kept].sum() / before[kept].sum())
        most = (longer + STEP_TOLERANCE) * period
    return period


def recording_of(data: FeatureDataset) -> IndexArray:
    """Recording of each row, shape ``(N,)``: the rows of a group that are of the same sensor."""
    group = np.unique(data.group, return_inverse=True)[1].astype(np.int64)
    pairs = group * len(data.sensor_names) + data.sensor
    _, recording = np.unique(pairs, return_inverse=True)
    return np.asarray(recording, np.int32)


def press_of(data: FeatureDataset) -> IndexArray:
    """Press of each row, shape ``(N,)``: its group, or of a sensor's only group its block.

    A group of several sensors is one press as long as there are others: they were pressed alike.
    """
    recording = recording_of(data)
    first = np.unique(recording, return_index=True)[1]
    sensor = data.sensor[first]
    _, group, sensors = np.unique(data.group[first], return_inverse=True, return_counts=True)
    if len(sensors) == 1:
        return data.block
    alone = (np.bincount(sensor)[sensor] == 1) & (sensors[group] == 1)
    if not alone.any():
        return data.group
    pairs = np.stack([data.group, np.where(alone[recording], data.block, 0)], axis=1)
    _, press = np.unique(pairs, axis=0, return_inverse=True)
    return press.reshape(-1).astype(np.int32)


def of_sensor(data: FeatureDataset, name: str) -> FeatureDataset:
    """The rows of one of its sensors, of which there must be some, alone."""
    own = data.sensor == data.sensor_names.index(name)
    columns = {column: values[own] for column, values in data.arrays().items()}
    columns["sensor"] = np.zeros(own.sum(), np.int32)
    return replace(data, **columns, sensor_names=(name,), name=f"{data.name}, {name}")


def cut_into_blocks(rows: int, blocks: int) -> IndexArray:
    """Number the contiguous pieces of one recording, of equal length to within a row.

    Returns:
        Block of every row, ``0 .. blocks - 1``, shape ``(rows,)``.
    """
    return (np.arange(rows, dtype=np.int64) * blocks // rows).astype(np.int32)


@dataclass(frozen=True, slots=True)
class FeatureColumn(StoredColumn):
    """An array of a data set of features: also the shape of one row, and whether it may lack."""

    shape: tuple[int, ...] = ()
    optional: bool = False


FEATURE_COLUMNS: dict[str, FeatureColumn] = {
    "electrodes": FeatureColumn("counts", np.uint16, (ELECTRODES,)),
    "baseline": FeatureColumn("counts", np.float32, (ELECTRODES,)),
    "force": FeatureColumn("N", np.float32, (3,)),
    "group": FeatureColumn("1", np.int32),
    "block": FeatureColumn("1", np.int32),
    "sensor": FeatureColumn("1", np.int32),
    "contact_location": FeatureColumn("m", np.float32, (3,), optional=True),
    "centre_of_pressure": FeatureColumn("m", np.float32, (3,), optional=True),
    "contact_normal": FeatureColumn("1", np.float32, (3,), optional=True),
    "in_contact": FeatureColumn("1", np.bool_, optional=True),
    "time_ns": FeatureColumn("ns", np.int64, optional=True),
}


OF_CONTACT = ("contact_location", "centre_of_pressure", "contact_normal")
"""Columns that only a contact has."""


def check_rest(rest: npt.NDArray[np.floating], rows: npt.NDArray[np.int64], name: str) -> None:
    """Refuse untouched counts that no BioTac sends.

    Args:
        rest: Of each row [counts], shape ``(N, 19)``.
        rows: Their numbers in the file, shape ``(N,)``.
        name: Of the file.

    Raises:
        DatasetError: Some are below 0 or above ``COUNTS_MAX``, or those of a row are all 0.
    """
    bad = (rest < 0.0) | (rest > COUNTS_MAX)
    bad |= ~rest.any(axis=1, keepdims=True)  # of counts from which the rest was subtracted
    if bad.any():
        row, electrode = (int(index) for index in np.argwhere(bad)[0])
        raise DatasetError(
            f"{name}: the rest of E{electrode + 1} is {rest[row, electrode]:g} in row"
            f" {rows[row]}, not untouched counts (0 to {COUNTS_MAX}, not all 0)",
            remedy="give raw counts of the untouched BioTac, nothing subtracted or scaled",
        )


def check_counts(counts: npt.NDArray[Any], rows: npt.NDArray[np.int64], name: str) -> None:
    """Refuse electrodes that are no raw counts; arguments as of ``check_rest``.

    Raises:
        DatasetError: One is not a whole number from 0 to ``COUNTS_MAX``.
    """
    values = counts.astype(np.float64)
    bad = ~((values >= 0.0) & (values <= COUNTS_MAX))  # what is not a number is neither
    bad[~bad] = np.abs(values[~bad] - np.rint(values[~bad])) > 1e-6
    if bad.any():
        row, electrode = (int(index) for index in np.argwhere(bad)[0])
        raise DatasetError(
            f"{name}: E{electrode + 1} reads {values[row, electrode]:g} in row {rows[row]},"
            f" not whole counts from 0 to {COUNTS_MAX}",
            remedy="give raw counts as the BioTac sends them, nothing subtracted or scaled",
        )


def at_an_end(counts: npt.NDArray[np.number]) -> npt.NDArray[np.bool_]:
    """Where counts are at an end of the converter's range, within a count; of the same shape.

    Such an electrode is lost, or pressed beyond what its BioTac can measure.
    """
    return np.asarray((counts <= 1) | (counts >= COUNTS_MAX - 1))


def rows_at_ends(counts: npt.NDArray[np.number]) -> dict[str, int]:
    """In how many rows an electrode is at an end of the range, by ``E1`` to ``E19``.

    Electrodes that never are have no entry. Counts of shape (N, 19).
    """
    rows = at_an_end(counts).sum(axis=0)
    return {f"E{electrode + 1}": int(rows[electrode]) for electrode in np.flatnonzero(rows)}


def electrodes_at_ends(data: FeatureDataset) -> dict[str, dict[str, int]]:
    """``rows_at_ends`` of each sensor that has any, by its name."""
    found = {
        name: rows_at_ends(data.electrodes[data.sensor == number])
        for number, name in enumerate(data.sensor_names)
    }
    return {name: rows for name, rows in found.items() if rows}


def check_order(arrays: Mapping[str, Any], rows: npt.NDArray[np.int64], name: str) -> None:
    """Refuse rows of a sensor and group that are not in order of time.

    Args:
        arrays: ``sensor``, ``group`` and ``time_ns`` of each row.
        rows: Their numbers in the file, shape ``(N,)``.
        name: Of the file.

    Raises:
        DatasetError: It is so: its neighbours in time might be learned from while it is tested.
    """
    order = np.lexsort((np.arange(len(rows)), arrays["group"], arrays["sensor"]))
    same = np.ones(len(rows) - 1, np.bool_)
    for label in ("sensor", "group"):
        same &= np.diff(arrays[label][order]) == 0
    back = np.flatnonzero(same & (np.diff(arrays["time_ns"][order]) < 0))
    if back.size:
        raise DatasetError(
            f"{name}: row {rows[order[back[0] + 1]]} is earlier than the one before it of the"
            f" same press ({back.size} rows in all)",
            remedy="sort the rows by sensor and time",
        )


FORCE_MOST_N = 300.0
"""A longer force is no reading of a fingertip's, or not in newtons [N]. A BioTac breaks far below,
and a zeroed force/torque sensor is off by some newtons; but a press that counts, of 0.5 N, is 500
in mN."""


def check_forces(force: npt.NDArray[np.floating], rows: npt.NDArray[np.int64], name: str) -> None:
    """Refuse forces that no fingertip bears; arguments as of ``check_rest``.

    Raises:
        DatasetError: One is longer than ``FORCE_MOST_N``.
    """
    length = np.linalg.norm(force.astype(np.float64), axis=1)
    over = np.flatnonzero(length > FORCE_MOST_N)
    if over.size:
        raise DatasetError(
            f"{name}: the force is {length[over[0]]:.4g} N in row {rows[over[0]]}, more than a"
            f" fingertip bears ({over.size} rows above {FORCE_MOST_N:g} N)",
            remedy="give newtons (a table in mN says so in its column map: force_unit), and drop"
            " rows that the force sensor did not measure",
        )


LOCATION_MOST_M = 0.1
"""No contact is further from the origin of the sensor frame on a fingertip 28 mm long [m]."""


def _check_shapes(data: FeatureDataset) -> None:
    rows = len(data.electrodes)
    if rows == 0:
        raise DatasetError(f"{data.name}: no rows", remedy="record or ingest at least one press")
    for name, array in data.arrays().items():
        column = FEATURE_COLUMNS[name]
        expected = (rows, *column.shape)
        if name == "electrodes" and array.ndim == 2 and array.shape[1] != ELECTRODES:
            raise DatasetError(
                f"{data.name}: electrodes has {array.shape[1]} columns, a BioTac has {ELECTRODES}",
                remedy="write one column for each of E1..E19; a BioTac SP needs another schema",
            )
        if array.shape != expected:
            raise DatasetError(
                f"{data.name}: {name} has shape {array.shape}, expected {expected}",
                remedy="write one row of every array for each row of electrodes",
            )
        if array.dtype != column.dtype:
            raise DatasetError(
                f"{data.name}: {name} is {array.dtype}, expected {np.dtype(column.dtype)}",
                remedy=f"convert {name} before writing; see training/README.md",
            )


def _check_values(data: FeatureDataset) -> None:
    must_be_finite = {"baseline": data.baseline, "force": data.force}
    touching = data.in_contact if data.in_contact is not None else np.ones(len(data), np.bool_)
    for name in OF_CONTACT:
        if name in data.arrays():
            # Where nothing touches there is none, so NaN is right there and only there.
            must_be_finite[name] = np.where(touching[:, None], getattr(data, name), np.float32(0))
    for name, values in must_be_finite.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            raise DatasetError(
                f"{data.name}: {name} is not finite in row {bad[0]} ({bad.size} rows in all)",
                remedy="drop these rows where the data set is made",
            )
    for name in ("contact_location", "centre_of_pressure"):
        # Half of the rows: of a robot that is away, noise of the force alone may say contact.
        if name in must_be_finite and touching.any():
            away = np.median(np.linalg.norm(must_be_finite[name][touching], axis=1))
            if away > LOCATION_MOST_M:
                raise DatasetError(
                    f"{data.name}: half of {name} is {away:.4g} m and more from the origin of the"
                    f" sensor frame; on a fingertip it is below {LOCATION_MOST_M:g} m",
                    remedy="give metres in the sensor frame (a table in mm says so in its column"
                    " map: length_unit); of a robot that is away for long, zero the force/torque"
                    " sensor before, or the force says contact",
                )
    check_rest(data.baseline, np.arange(len(data)), data.name)
    if data.contact_normal is not None:
        length = np.linalg.norm(data.contact_normal[touching], axis=1)
        wrong = np.flatnonzero(np.abs(length - 1.0) > UNIT_TOLERANCE)
        if wrong.size:
            raise DatasetError(
                f"{data.name}: contact_normal has length {length[wrong[0]]:.4g} in row"
                f" {np.flatnonzero(touching)[wrong[0]]} ({wrong.size} rows in all)",
                remedy="divide each normal by its length where the data set is made",
            )
    above = np.flatnonzero((data.electrodes > COUNTS_MAX).any(axis=1))
    if above.size:
        raise DatasetError(
            f"{data.name}: electrodes is above {COUNTS_MAX} counts in row {above[0]}",
            remedy="raw counts have 12 bits; write them as read, nothing subtracted or scaled",
        )
    if data.sensor.min() < 0 or data.sensor.max() >= len(data.sensor_names):
        raise DatasetError(
            f"{data.name}: sensor holds {data.sensor.max()}, but {len(data.sensor_names)} sensors"
            " are named",
            remedy="sensor is an index into sensor_names",
        )
    if len(set(data.sensor_names)) < len(data.sensor_names):
        raise DatasetError(
            f"{data.name}: two sensors have the same name: {', '.join(data.sensor_names)}",
            remedy="name each sensor once; rows of one sensor have the same index",
        )
    order = np.lexsort((data.group, data.block))
    block, group = data.block[order], data.group[order]
    mixed = np.flatnonzero((np.diff(block) == 0) & (np.diff(group) != 0))
    if mixed.size:
        raise DatasetError(
            f"{data.name}: block {block[mixed[0]]} spans groups {group[mixed[0]]} and"
            f" {group[mixed[0] + 1]}",
            remedy="number blocks uniquely over all groups",
        )
    if data.time_ns is not None:
        check_order(data.arrays(), np.arange(len(data)), data.name)


def check_learnable(data: FeatureDataset) -> None:
    """Refuse rows that nothing can be learned from, before time is spent on it.

    Raises:
        DatasetError: A force is beyond ``FORCE_MOST_N``, or force or electrodes never change.
    """
    check_forces(data.force, np.arange(len(data)), data.name)
    for name, values in (("force", data.force), ("electrodes, tared,", data.tared_counts)):
        if not np.ptp(values, axis=0).any():
            raise DatasetError(
                f"{data.name}: {name} is the same in all {len(data)} rows",
                remedy="record presses of different strength, with both sensors connected",
            )


FEATURES_SCHEMA = Hdf5Schema("palpate.features", 1, "use a file made by `palpate data ingest-...`")

_CHUNK_ROWS = 4096
"""One chunk of electrodes is 150 KiB: small enough to stream, large enough to compress."""


SENSORS_MOST = 4000
"""Their names are one attribute of the file, of which HDF5 takes 64 KiB, and 16 bytes a name."""


def write_dataset(path: Path, data: FeatureDataset) -> str:
    """Write a data set, complete or not at all; returns the content's SHA-256, hex.

    Raises:
        DatasetError: There are more than ``SENSORS_MOST`` sensors, or the disk refused.
    """
    if len(data.sensor_names) > SENSORS_MOST:
        raise DatasetError(
            f"{path}: {len(data.sensor_names)} sensors are more than a file holds: {SENSORS_MOST}",
            remedy="write several data sets with fewer sensors each",
        )
    digest = data.content_sha256()
    with hdf5_written_whole(path, extra="training") as file:
        names = {"sensor_names": list(data.sensor_names)}
        file.attrs.update({**FEATURES_SCHEMA.facts, **names, "content_sha256": digest})
        write_provenance(file, data.provenance)
        for name, array in data.arrays().items():
            dataset = file.create_dataset(
                name,
                data=array,
                chunks=(min(_CHUNK_ROWS, len(data)), *array.shape[1:]),
                compression="gzip",
                compression_opts=4,
                shuffle=True,
            )
            dataset.attrs["unit"] = FEATURE_COLUMNS[name].unit
    _log.info("wrote %s: %d rows, content %s", path, len(data), digest[:12])
    return digest


def open_dataset(path: str | Path) -> FeatureDataset:
    """Read a data set into memory and check everything about it.

    Raises:
        DatasetError: The file is missing, damaged, of another schema or version, or its content
            breaks the schema; the message names the dataset inside the file.
    """
    path = Path(path)
    with opened(path, extra="training", missing="make it: palpate data ingest-record") as file:
        FEATURES_SCHEMA.check(path, file)
        if "sensor_names" not in file.attrs:
            raise DatasetError(
                f"{path}: attribute sensor_names is missing", remedy="name every sensor, in order"
            )
        arrays = {
            name: read_array(path, file, name, column.unit)
            for name, column in FEATURE_COLUMNS.items()
            if name in file or not column.optional
        }
        attributes = dict(file.attrs)
    data = FeatureDataset(
        **arrays,
        sensor_names=tuple(text(name) for name in attributes["sensor_names"]),
        provenance=read_provenance(attributes),
        name=str(path),
    )
    check_rows(path, text(attributes.get("content_sha256", "")), data.content_sha256())
    return data
