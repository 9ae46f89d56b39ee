"""Rows of features as a table with named columns, and tables of others as rows of features.

A table is CSV, Parquet, or the folder of a LeRobotDataset (``lerobot``). Ours has a column for each
number, with its unit in the name: ``electrode_1`` to ``electrode_19``, ``rest_1``, ...,
``force_x_n``, ..., ``time_ns``, ``sensor``. A table of somebody else is read by a map that says
which columns are what.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from palpate import __version__
from palpate.errors import ConfigError, DatasetError
from palpate.process import require
from palpate_training.datasets.container import Provenance, sha256_of
from palpate_training.datasets.export import written_new
from palpate_training.datasets.features import (
    ELECTRODES,
    FEATURE_COLUMNS,
    OF_CONTACT,
    FeatureDataset,
    check_counts,
    check_forces,
    check_order,
    check_rest,
    cut_into_blocks,
)
from palpate_training.datasets.table_columns import MISSING, Columns, TableColumns, Values

if TYPE_CHECKING:
    import pyarrow as pa

BLOCKS = 20
"""Contiguous pieces that a sensor's rows are cut into where nothing says what one press is."""

PROVENANCE_COLUMNS = ("source", "licence")
"""Columns of a CSV file of ours that say the same in every row."""

REST_FORCE_N = 0.5
"""A force above it is a touch in rows that are said to be untouched [N]; noise is below."""

LABELS = ("sensor", "group", "block")
"""Keys of a map, and columns of ours, that hold names."""

METADATA = b"palpate.features"
"""Key of a table's metadata: where its rows come from, as JSON."""

_STEMS = {
    "electrodes": ("electrode", ""), "baseline": ("rest", ""), "force": ("force", "_n"),
    "contact_location": ("contact_location", "_m"),
    "centre_of_pressure": ("centre_of_pressure", "_m"), "contact_normal": ("contact_normal", ""),
}  # fmt: skip
LISTS = {
    "electrodes": "observation.electrodes",
    "baseline": "observation.electrodes_at_rest",
    "force": "observation.force",
    "contact_location": "observation.contact_location",
    "centre_of_pressure": "observation.centre_of_pressure",
    "contact_normal": "observation.contact_normal",
}
"""Names of a LeRobotDataset's features that hold a list, by our arrays."""

_UNITS = {
    "force": {"N": 1.0, "mN": 1e-3},
    "length": {"m": 1.0, "mm": 1e-3},
    "time": {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9},
}
_LENGTHS = ("contact_location", "centre_of_pressure")


class ColumnMap(BaseModel):
    """Which columns of a table are what.

    A value is a list of columns, one for each number, or the name of one column that holds all of
    them; a minus before a name turns the sign. x, y, z are those of the sensor frame: x to the tip,
    y to the left, z out of the nail (docs/conventions.md).

    Attributes:
        electrodes: Raw counts of E1 to E19.
        rest: Counts of the same electrodes, untouched.
        rest_rows: Instead: the first rows of each sensor, which are untouched.
        force: Force on the BioTac, x, y, z.
        contact_location: Tip of the indenter; likewise the next two.
        centre_of_pressure: Mean of the touched skin, weighted by the pressure.
        contact_normal: Out of the skin.
        in_contact: Whether something touches, true or false, or 0 or 1.
        time: Of the row.
        group: Press or episode.
        groups_across_sensors: The same label on several sensors is one press, as of simulated ones
            that were pressed alike; else each sensor has a press of its own.
        block: Piece of a group that is held out as a whole; none = the group, or where each sensor
            has but one, twenty pieces of it.
        sensor: Name of the BioTac.
        force_unit: N or mN.
        length_unit: m or mm.
        time_unit: s, ms, us or ns, of times that are numbers; timestamps say theirs.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    electrodes: Columns
    rest: Columns | None = None
    rest_rows: Annotated[int, Field(ge=1)] | None = None
    force: Columns
    contact_location: Columns | None = None
    centre_of_pressure: Columns | None = None
    contact_normal: Columns | None = None
    in_contact: str | None = None
    time: str | None = None
    group: str | None = None
    groups_across_sensors: bool = False
    block: str | None = None
    sensor: str | None = None
    force_unit: Literal["N", "mN"] = "N"
    length_unit: Literal["m", "mm"] = "m"
    time_unit: Literal["s", "ms", "us", "ns"] = "s"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Refuse a column in two places, and keys that contradict."""
        if self.rest is not None and self.rest_rows is not None:
            raise ValueError("rest and rest_rows are both there: give one of them")
        if self.groups_across_sensors and self.group is None:
            raise ValueError("groups_across_sensors is there without group: name its column")
        keys = ("electrodes", "rest", "force", *OF_CONTACT, "in_contact", "time")
        told = [names for key in keys if (names := getattr(self, key)) is not None]
        numbers = [
            name for names in told for name in ([names] if isinstance(names, str) else names)
        ]
        labels = {getattr(self, name) for name in LABELS} - {None}  # may share a column
        counted = Counter(name.removeprefix("-") for name in (*numbers, *labels))
        if repeated := [name for name, times in counted.items() if times > 1]:
            raise ValueError(f"column {repeated[0]!r} is named twice: each holds one thing")
        return self

    @classmethod
    def read(cls, path: Path) -> ColumnMap:
        """Read a TOML file.

        Raises:
            ConfigError: It is missing, no TOML, or says something else.
        """
        try:
            return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise ConfigError(f"{path}: {error}", remedy="see docs/data.md") from error
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "keys"
            raise ConfigError(
                f"{path}: {where}: {first['msg'].removeprefix('Value error, ')}",
                remedy="electrodes and force must be there; all names: docs/data.md",
            ) from error

    @classmethod
    def ours(cls, columns: Sequence[str]) -> ColumnMap:
        """Of a table with palpate's own names, as far as it has them."""
        known: dict[str, Columns] = {
            name: names
            for name in _STEMS
            if set(names := columns_of(name)) <= set(columns) or name in ("electrodes", "force")
        }
        if {LISTS["electrodes"], LISTS["force"], *LABELS} <= set(columns):  # LeRobot's, by us
            known = {name: column for name, column in LISTS.items() if column in columns}
        rest = known.pop("baseline", None)
        single = {
            name: name for name in ("in_contact", "group", "block", "sensor") if name in columns
        }
        more = {
            "rest": rest,
            "time": "time_ns" if "time_ns" in columns else None,
            "time_unit": "ns",
            "groups_across_sensors": {"group", "block"}
            <= set(columns),  # as `table_of` writes them
        }
        return cls.model_validate(known | more | single)


def columns_of(name: str) -> list[str]:
    """Names that palpate gives the columns of an array with several numbers a row."""
    stem, unit = _STEMS[name]
    size = FEATURE_COLUMNS[name].shape[0]
    ends = [str(number + 1) for number in range(size)] if size == ELECTRODES else list("xyz")
    return [f"{stem}_{end}{unit}" for end in ends]


def table_of(data: FeatureDataset) -> pa.Table:
    """All arrays of a data set, a column for each number; provenance in the schema's metadata.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    arrow = require("pyarrow", extra="training")
    columns: dict[str, Any] = {}
    for name, array in data.arrays().items():
        if name == "sensor":
            columns[name] = np.array(data.sensor_names, object)[array]
        elif name in _STEMS:
            columns |= dict(zip(columns_of(name), array.T, strict=True))
        else:
            columns[name] = array
    return arrow.table(columns).replace_schema_metadata({METADATA: facts_of(data)})


def facts_of(data: FeatureDataset) -> bytes:
    """Where the rows come from, as JSON: what a file of ours says beside its columns."""
    return json.dumps({"provenance": asdict(data.provenance)}).encode()


def export_table(path: Path, data: FeatureDataset, *, csv: bool = False) -> None:
    """Write a table, whole or not at all: Parquet, or CSV.

    Raises:
        DatasetError: The file exists, or the disk refused.
        MissingExtraError: pyarrow is not installed.
    """
    require("pyarrow", extra="training")
    import pyarrow.csv
    import pyarrow.parquet

    table = table_of(data)
    if csv:  # which has no metadata, so every row says where it comes from
        for name in PROVENANCE_COLUMNS:
            words = [getattr(data.provenance, name)] * len(data)
            table = table.append_column(name, [words])

    def write(part: Path) -> None:
        if csv:
            pyarrow.csv.write_csv(table, part)
        else:
            pyarrow.parquet.write_table(table, part, compression="zstd")

    written_new(path, write)


def read_table(path: Path, columns: ColumnMap | None = None) -> pa.Table:
    """Read a CSV or Parquet file whole.

    Args:
        path: Of the file.
        columns: Which are labels: in CSV they stay the text that they are, as "007" and "7" are two
            fingers; None = palpate's own names.

    Raises:
        DatasetError: It is missing, or neither.
        MissingExtraError: pyarrow is not installed.
    """
    arrow = require("pyarrow", extra="training")
    import pyarrow.csv
    import pyarrow.parquet

    names = LABELS if columns is None else [getattr(columns, name) for name in LABELS]
    labels = pyarrow.csv.ConvertOptions(
        column_types={name: arrow.string() for name in names if name}
    )
    try:
        if path.suffix.lower() == ".csv":
            return pyarrow.csv.read_csv(path, convert_options=labels)
        return pyarrow.parquet.read_table(path)
    except (OSError, arrow.ArrowException) as error:
        raise DatasetError(
            f"{path} cannot be read as a table: {str(error).splitlines()[0]}",
            remedy="give a CSV file with a heading, a Parquet file, or a LeRobotDataset's folder",
        ) from error


def dataset_of(
    table: pa.Table,
    columns: ColumnMap,
    *,
    source: Path,
    sensor: str | None = None,
    licence: str | None = None,
    command: str = "",
    drop_incomplete: bool = False,
) -> FeatureDataset:
    """Rows of features from a table.

    Args:
        table: Its columns may hold numbers, or lists of them.
        columns: Which of them is what.
        source: Where the table was, for errors and provenance.
        sensor: Name of the BioTac where no column says it; None = the table's file name.
        licence: What may be done with the rows; None = as a file of ours says, else it is unknown.
        command: For provenance.
        drop_incomplete: Leave rows out in which a number is missing; else they are an error.

    Raises:
        DatasetError: A column is missing, there twice, of another width, or holds something else; a
            number is missing; electrodes are no whole counts, the rest no counts; a force is beyond
            ``FORCE_MOST_N``; nothing says what electrodes read untouched; rows of a press are not
            in order of time, or the time of a sensor stands still.
    """
    reader = TableColumns(table, source)
    arrays: dict[str, Any] = {
        "electrodes": reader.numbers(columns.electrodes, ELECTRODES),
        "force": reader.numbers(columns.force, 3) * _UNITS["force"][columns.force_unit],
    }
    if columns.rest is not None:
        arrays["baseline"] = reader.numbers(columns.rest, ELECTRODES)
    for name in (*_LENGTHS, "contact_normal"):
        if (names := getattr(columns, name)) is not None:
            scale = _UNITS["length"][columns.length_unit] if name in _LENGTHS else 1.0
            arrays[name] = reader.numbers(names, 3) * scale
    if columns.in_contact is not None:
        arrays["in_contact"] = reader.truths(columns.in_contact)
    if columns.time is not None:
        arrays["time_ns"] = reader.times(columns.time, _UNITS["time"][columns.time_unit])
    names, arrays["sensor"] = reader.labels(columns.sensor, sensor or source.stem)
    for name in ("group", "block"):
        _, arrays[name] = reader.labels(getattr(columns, name), "", keep=True)
    rows = len(arrays["electrodes"])
    kept = _complete(arrays, source, drop_incomplete=drop_incomplete)
    arrays = {name: array[kept] for name, array in arrays.items()}
    there, arrays["sensor"] = np.unique(arrays["sensor"], return_inverse=True)
    gone = [name for number, name in enumerate(names) if number not in there]
    names = tuple(names[number] for number in there)
    check_counts(arrays["electrodes"], np.flatnonzero(kept), str(source))
    arrays["electrodes"] = np.rint(arrays["electrodes"])
    if "baseline" not in arrays:
        arrays["baseline"] = _rest(arrays, columns.rest_rows, np.flatnonzero(kept), source)
    check_rest(arrays["baseline"], np.flatnonzero(kept), str(source))
    check_forces(arrays["force"], np.flatnonzero(kept), str(source))
    across = columns.groups_across_sensors
    arrays |= _groups(arrays, labelled=columns.block is not None, across=across)
    if "time_ns" in arrays:
        check_order(arrays, np.flatnonzero(kept), str(source))
    ours = columns == ColumnMap.ours(table.column_names)
    told = f"columns: {columns.model_dump_json(exclude_defaults=True)}"
    notes = ["palpate's own columns" if ours else told]
    if left_out := rows - len(arrays["electrodes"]):
        notes.append(f"{left_out} incomplete rows left out")
    if gone:
        notes.append(f"no row is left of {', '.join(gone)}")
    if "time_ns" in arrays and (repeated := _repeated_times(arrays, names, source)):
        notes.append(f"{repeated} rows have the time of the row before")
    known = _provenance(table)
    return FeatureDataset(
        **{name: arrays[name].astype(FEATURE_COLUMNS[name].dtype) for name in arrays},
        sensor_names=names,
        provenance=Provenance(
            source=known.get("source") or f"{source.name}, {rows} rows",
            command=command,
            input_sha256=sha256_of(source) if source.is_file() else "",
            licence=licence or known.get("licence") or "not stated",
            palpate_version=__version__,
            notes="; ".join(notes),
        ),
        name=str(source),
    )


def _provenance(table: pa.Table) -> dict[str, str]:
    """What a file of ours says of its rows; nothing of a file of others."""
    try:
        facts = json.loads((table.schema.metadata or {})[METADATA])["provenance"]
        return {name: str(facts[name]) for name in PROVENANCE_COLUMNS}
    except (KeyError, TypeError, ValueError):
        pass
    if not {*columns_of("electrodes"), *PROVENANCE_COLUMNS} <= set(table.column_names):
        return {}
    said = {name: table.column(name).unique().to_pylist() for name in PROVENANCE_COLUMNS}
    return {name: "; ".join(map(str, filter(None, words))) for name, words in said.items()}


def _repeated_times(arrays: Mapping[str, Any], names: Sequence[str], source: Path) -> int:
    """Rows with the time of the row before of the same sensor.

    Raises:
        DatasetError: So have all rows of a sensor that has several: that is no time of the rows.
    """
    repeated = 0
    for number, name in enumerate(names):
        times = arrays["time_ns"][arrays["sensor"] == number]
        same = int(np.count_nonzero(np.diff(times) == 0))
        if 0 < same == len(times) - 1:
            raise DatasetError(
                f"{source}: time is the same in all {len(times)} rows of {name!r}",
                remedy="name a column of times that go on from row to row, or none",
            )
        repeated += same
    return repeated


def _complete(
    arrays: Mapping[str, Any], source: Path, *, drop_incomplete: bool
) -> npt.NDArray[np.bool_]:
    """Rows in which nothing is missing that must be there."""
    kept = np.ones(len(arrays["electrodes"]), np.bool_)
    touching = arrays["in_contact"] == 1 if "in_contact" in arrays else kept.copy()
    for name, values in arrays.items():
        if values.ndim == 2:
            needed = touching if name in (*_LENGTHS, "contact_normal") else True
            lacking = ~np.isfinite(values).all(axis=1) & needed
        else:
            lacking = values == MISSING
        if lacking.any() and not drop_incomplete:
            raise DatasetError(
                f"{source}: {name} is not known in row {np.flatnonzero(lacking)[0]}"
                f" ({lacking.sum()} rows in all)",
                remedy="mend the table, or leave such rows out: --drop-incomplete",
            )
        kept &= ~lacking
    if not kept.any():
        raise DatasetError(f"{source}: no row is complete", remedy="see which columns are empty")
    return kept


def _rest(
    arrays: Mapping[str, Any], count: int | None, rows: npt.NDArray[np.int64], source: Path
) -> Values:
    """Untouched counts of each row: the mean of the first ``count`` rows of its sensor.

    Raises:
        DatasetError: There are too few, or something touches in one of them; ``rows`` are those of
            the table.
    """
    if count is None:
        raise DatasetError(
            f"{source}: nothing says what the electrodes read untouched",
            remedy="name columns of the rest, or untouched rows at the beginning: rest_rows = 100",
        )
    rest: Values = np.empty_like(arrays["electrodes"])
    for sensor in np.unique(arrays["sensor"]):
        own = np.flatnonzero(arrays["sensor"] == sensor)
        if len(own) <= count:
            raise DatasetError(
                f"{source}: a sensor has {len(own)} rows, {count} of them untouched",
                remedy="give fewer untouched rows: rest_rows",
            )
        first, force = own[:count], arrays["force"][own]
        # From the least force: that of a force sensor which was not zeroed is no touch.
        size = np.linalg.norm(force - force[np.linalg.norm(force, axis=1).argmin()], axis=1)
        touched = size[:count] > REST_FORCE_N
        if "in_contact" in arrays:
            touched |= arrays["in_contact"][first] == 1
        if touched.any():
            row = int(touched.argmax())
            raise DatasetError(
                f"{source}: row {rows[first[row]]} is one of the {count} untouched ones of its"
                f" sensor, but something touches in it ({np.linalg.norm(force[row]):.2g} N)",
                remedy="give fewer untouched rows: rest_rows; or name columns of the rest",
            )
        rest[own] = arrays["electrodes"][first].mean(axis=0)
    return rest


def _apart(*labels: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The last label of each row; another number where one is told apart by those before it."""
    found, number = np.unique(labels, axis=1, return_inverse=True)
    return labels[-1] if len(np.unique(found[-1])) == found.shape[1] else number.reshape(-1)


def _groups(arrays: Mapping[str, Any], *, labelled: bool, across: bool) -> dict[str, Any]:
    """Group and block of each row: as labelled, or pieces of each sensor's rows.

    ``across``: A group may have rows of several sensors, which were pressed alike; to tell them
    apart would let the same press into training and test.
    """
    apart = () if across else (arrays["sensor"],)
    group = _apart(*apart, arrays["group"])
    block = _apart(*apart, arrays["group"], arrays["block"])
    if labelled or len(np.unique(group)) > (1 if across else len(np.unique(arrays["sensor"]))):
        return {"group": group, "block": block}
    for place, number in enumerate(np.unique(group)):
        sensors, rows = np.unique(arrays["sensor"][group == number], return_counts=True)
        pieces = min(BLOCKS, *rows)
        for sensor, count in zip(sensors, rows, strict=True):  # pressed alike, so cut alike
            own = (group == number) & (arrays["sensor"] == sensor)
            block[own] = BLOCKS * place + cut_into_blocks(count, pieces)
    return {"group": group, "block": block}
