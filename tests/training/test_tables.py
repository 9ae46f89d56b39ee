"""Tables with named columns, and LeRobotDatasets: there and back, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from tests.training.invented_population import population
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import data_app
from palpate_training.datasets.features import (
    FeatureDataset,
    joined,
    open_dataset,
    period_of,
    write_dataset,
)
from palpate_training.datasets.lerobot import export_lerobot, read_lerobot
from palpate_training.datasets.tables import (
    ColumnMap,
    columns_of,
    dataset_of,
    export_table,
    read_table,
    table_of,
)

STEP_NS = 10_000_000


@pytest.fixture(scope="module")
def data() -> FeatureDataset:
    known = population(specimens=3, presses=6, each=2)
    order = np.lexsort((np.arange(len(known)), known.group, known.sensor))
    arrays: dict[str, Any] = {name: array[order] for name, array in known.arrays().items()}
    arrays["time_ns"] = np.arange(len(known), dtype=np.int64) * STEP_NS + 10**18
    return FeatureDataset(
        **arrays,
        sensor_names=known.sensor_names,
        provenance=replace(known.provenance, source="invented", licence="free"),
    )


@pytest.mark.parametrize("csv", [True, False])
def test_a_table_comes_back_as_it_was(data: FeatureDataset, tmp_path: Path, csv: bool) -> None:
    path = tmp_path / ("rows.csv" if csv else "rows.parquet")
    export_table(path, data, csv=csv)
    table = read_table(path)
    back = dataset_of(table, ColumnMap.ours(table.column_names), source=path)
    assert back.sensor_names == data.sensor_names
    # Groups, too, for the same split with the same seed; those of several sensors stay together.
    for name, array in data.arrays().items():
        np.testing.assert_array_equal(getattr(back, name), array, err_msg=name)
    assert back.provenance.notes == "palpate's own columns"
    assert (back.provenance.source, back.provenance.licence) == ("invented", "free")
    with pytest.raises(DatasetError, match="exists"):
        export_table(path, data, csv=csv)


def test_a_strangers_table_is_read_by_a_map(data: FeatureDataset, tmp_path: Path) -> None:
    count = len(data)
    force = data.force.astype(np.float64)
    table = pa.table(
        {
            "t": np.arange(count) * 0.01,
            "skin": [row.tolist() for row in data.electrodes],
            "Fy": 1e3 * force[:, 1],
            "Fx": 1e3 * force[:, 0],
            "up": -1e3 * force[:, 2],
            "episode": data.group,
        }
    )
    (tmp_path / "map.toml").write_text(
        'electrodes = "skin"\nrest_rows = 2\nforce = ["Fx", "Fy", "-up"]\nforce_unit = "mN"\n'
        'time = "t"\ngroup = "episode"\n'
    )
    pq.write_table(table, tmp_path / "lab.parquet")
    arguments = ["import", str(tmp_path / "lab.parquet"), str(tmp_path / "lab.h5")]
    arguments += ["--columns", str(tmp_path / "map.toml"), "--sensor", "left", "--licence", "CC0"]
    result = CliRunner().invoke(data_app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    back = open_dataset(tmp_path / "lab.h5")
    np.testing.assert_allclose(back.force, data.force, atol=1e-5)
    np.testing.assert_array_equal(back.electrodes, data.electrodes)
    np.testing.assert_allclose(back.baseline[0], data.electrodes[:2].mean(axis=0), rtol=1e-6)
    assert back.sensor_names == ("left",)
    assert back.provenance.licence == "CC0"
    assert back.time_ns is not None
    assert set(np.diff(back.time_ns)) == {STEP_NS}
    same = back.group[:, None] == back.group
    np.testing.assert_array_equal(same, data.group[:, None] == data.group)


def test_labels_in_csv_are_names(data: FeatureDataset, tmp_path: Path) -> None:
    """Not numbers, of which "007" and "7" would be one, nor words for nothing."""
    names = ("007", "7", "NA")
    own, other = tmp_path / "own.csv", tmp_path / "other.csv"
    export_table(own, replace(data, sensor_names=names), csv=True)
    heading, rows = own.read_text().split("\n", 1)
    other.write_text(
        heading.replace('"sensor"', '"finger"').replace('"group"', '"press"') + "\n" + rows
    )
    ours = ColumnMap.ours(read_table(own).column_names)
    for path, columns in (
        (own, ours),
        (other, ours.model_copy(update={"sensor": "finger", "group": "press"})),
    ):
        back = dataset_of(read_table(path, columns), columns, source=path)
        assert back.sensor_names == names
        np.testing.assert_array_equal(back.sensor, data.sensor)
    other.write_text(own.read_text().replace('"NA"', '""'))
    with pytest.raises(DatasetError, match=f"sensor is not known in row {data.sensor.argmax()}"):
        dataset_of(read_table(other), ours, source=other)


def test_without_groups_a_file_is_cut_into_blocks(data: FeatureDataset) -> None:
    table = table_of(data).drop_columns(["group", "block", "sensor"])
    back = dataset_of(table, ColumnMap.ours(table.column_names), source=Path("x.csv"))
    assert len(np.unique(back.block)) == 20
    assert len(np.unique(back.group)) == 1
    assert (np.diff(back.block) >= 0).all()


def test_whole_numbers_of_groups_are_kept_where_they_tell_presses_apart() -> None:
    known = population(specimens=2, presses=6, each=2)
    numbers = (known.group * 7 + 3) * 2 + known.sensor  # each of one sensor, in no order
    names = table_of(known).column_names
    apart = {"block": None, "groups_across_sensors": False}
    columns = ColumnMap.ours(names).model_copy(update=apart)

    def read(labels: list[Any]) -> FeatureDataset:
        place = names.index("group")
        table = table_of(known).set_column(place, "group", pa.array(labels))
        return dataset_of(table, columns, source=Path("x"))

    kept = read(list(numbers))
    np.testing.assert_array_equal(kept.group, numbers)
    same_press(kept.block, numbers)
    for other in (
        read([f"0{number}" for number in numbers]),  # "07" and "7" would be one
        read([int(number) + 10**9 for number in numbers]),  # a file holds 31 bits
        read([int(number) - 3 for number in numbers - numbers.max()]),
    ):
        same_press(other.group, numbers)
        assert set(other.group) == set(range(len(np.unique(numbers))))
    shared = read(list(known.group))  # a press of each sensor
    same_press(shared.group, numbers)


def test_a_press_of_several_sensors_is_one_if_the_map_says_so(data: FeatureDataset) -> None:
    """Else it could be learned from on one sensor and tested with on another."""
    names = [
        {"group": "press", "block": "piece"}.get(name, name) for name in table_of(data).column_names
    ]
    table = table_of(data).rename_columns(names)
    columns = ColumnMap.ours(names).model_copy(update={"group": "press"})
    apart = dataset_of(table, columns, source=Path("x"))
    same_press(apart.group, data.group * 10 + data.sensor)
    alike = columns.model_copy(update={"groups_across_sensors": True})
    together = dataset_of(table, alike, source=Path("x"))
    same_press(together.group, data.group)
    same_press(together.block, data.group)
    single = table.set_column(names.index("press"), "press", pa.array(["only"] * len(data)))
    cut = dataset_of(single, alike, source=Path("x"))
    assert len(np.unique(cut.group)) == 1
    for sensor in range(3):  # each from its beginning to its end
        own = cut.block[cut.sensor == sensor]
        assert list(np.unique(own)) == list(range(cut.block.max() + 1))
        assert (np.diff(own) >= 0).all()


@pytest.mark.parametrize("names", [("press", "part"), ("group", "block")])
def test_what_columns_are_called_decides_nothing(
    data: FeatureDataset, names: tuple[str, str]
) -> None:
    table = table_of(data)
    called = dict(zip(("group", "block"), names, strict=True))
    table = table.rename_columns([called.get(one, one) for one in table.column_names])
    told = {"group": names[0], "block": names[1], "groups_across_sensors": False}
    columns = ColumnMap.ours(table.column_names).model_copy(update=told)
    same_press(dataset_of(table, columns, source=Path("x")).group, data.group * 10 + data.sensor)


def no_rest(table: pa.Table) -> pa.Table:
    """A table of which somebody subtracted the rest."""
    for name in columns_of("baseline"):
        place = table.column_names.index(name)
        table = table.set_column(place, name, pa.array(np.zeros(len(table))))
    return table


def test_timestamps_are_taken_as_they_are(data: FeatureDataset, tmp_path: Path) -> None:
    """Whatever the unit of the column is, or the map says."""
    assert data.time_ns is not None
    stamps = pa.array(data.time_ns).cast(pa.timestamp("ns"))
    table = table_of(data)
    place = table.column_names.index("time_ns")
    columns = ColumnMap.ours(table.column_names).model_copy(update={"time_unit": "s"})
    for kind in ("timestamp[ns]", "timestamp[ms]", pa.timestamp("us", "Europe/Berlin")):
        stamped = table.set_column(place, "time_ns", stamps.cast(kind))
        back = dataset_of(stamped, columns, source=Path("x"))
        np.testing.assert_array_equal(back.time_ns, data.time_ns)
    pyarrow.csv.write_csv(stamped, tmp_path / "stamped.csv")
    back = dataset_of(read_table(tmp_path / "stamped.csv"), columns, source=Path("x"))
    np.testing.assert_array_equal(back.time_ns, data.time_ns)


@pytest.mark.parametrize(("unit", "ns"), [("us", 10**3), ("ms", 10**6), ("s", 10**9)])
def test_whole_times_are_not_rounded(data: FeatureDataset, unit: str, ns: int) -> None:
    whole = (10**18 + 10**9 + 7 * 10**3) // ns + np.arange(len(data))
    table = table_of(data)
    place = table.column_names.index("time_ns")
    columns = ColumnMap.ours(table.column_names).model_copy(update={"time_unit": unit})
    for kind in (np.int64, np.uint64):
        times = pa.array(whole.astype(kind))
        back = dataset_of(table.set_column(place, "time_ns", times), columns, source=Path("x"))
        assert back.time_ns is not None
        np.testing.assert_array_equal(back.time_ns, whole * ns)
    lacking = lack(table.set_column(place, "time_ns", times), "time_ns")
    with pytest.raises(DatasetError, match="time_ns is not known in row 4"):
        dataset_of(lacking, columns, source=Path("x"))
    far = table.set_column(place, "time_ns", pa.array(np.full(len(data), 2**63, np.uint64)))
    with pytest.raises(DatasetError, match=r"holds 9\.22337e\+18 in row 0, not a time"):
        dataset_of(far, columns, source=Path("x"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: of_type(rows, "time_ns", pa.duration("ns")), r"'time_ns' holds duration"),
        (lambda rows: of_type(rows, "time_ns", pa.timestamp("s")), "not times from 1678 to 2261"),
        (lambda rows: of_type(rows, "force_x_n", pa.timestamp("s")), "'force_x_n' holds timestamp"),
        (lambda rows: put(rows, "time_ns", "noon"), "'time_ns' holds string, not numbers"),
        (
            lambda rows: rows.drop_columns(["time_ns"]).append_column(
                "time_ns", pa.array(np.arange(len(rows), dtype=np.int32), pa.time32("s"))
            ),
            "not numbers, or timestamps with a date -> give numbers, or timestamps with a date,",
        ),
        (
            lambda rows: put(rows, "in_contact", "yes"),
            "'in_contact' holds string, not true or false, or 1 or 0 -> give true or false",
        ),
        (
            lambda rows: put(rows, "sensor", f" {rows['sensor'][4]}"),
            "'sensor' holds .* and ' .*', which differ in spaces only",
        ),
        (lambda rows: rows.drop_columns(["electrode_7"]), "no column 'electrode_7'"),
        (lambda rows: rows.drop_columns(columns_of("baseline")), "untouched"),
        (lambda rows: put(rows, "electrode_3", 17.5), r"E3 reads 17\.5 in row 4"),
        (lambda rows: put(rows, "electrode_3", 4096.0), r"E3 reads 4096 in row 4"),
        (lambda rows: put(rows, "electrode_3", float("nan")), "electrodes is not known in row 4"),
        (lambda rows: put(rows, "rest_3", -5.0), r"rest of E3 is -5 in row 4"),
        (lambda rows: put(rows, "rest_3", 1e9), r"rest of E3 is 1e\+09 in row 4"),
        (no_rest, r"rest of E1 is 0 in row 0"),
        (lambda rows: put(rows, "force_z_n", -5000.0), "force is 5000 N in row 4.*force_unit"),
        (lambda rows: put(rows, "force_z_n", float("inf")), "force is not known in row 4"),
        (lambda rows: put(rows, "in_contact", 3.0), "'in_contact' holds 3 in row 4"),
        (lambda rows: put(rows, "in_contact", None), "in_contact is not known in row 4"),
        (lambda rows: put(rows, "group", None), "group is not known in row 4"),
        (lambda rows: put(rows, "group", float("nan")), "group is not known in row 4"),
        (lambda rows: put(rows, "sensor", " "), "sensor is not known in row 4"),
        (lambda rows: lack(rows, "time_ns"), "time_ns is not known in row 4"),
        (lambda rows: put(rows, "time_ns", 0.0), "row 4 is earlier than the one before it"),
        (
            lambda rows: rows.append_column("force_x_n", rows["force_x_n"]),
            "several columns 'force_x_n'",
        ),
        (lambda rows: put(rows, "force_x_n", "much"), "'force_x_n' holds string"),
        (lambda rows: rows.slice(0, 0), "no rows"),
    ],
)
def test_a_wrong_table_is_refused(data: FeatureDataset, change: object, says: str) -> None:
    table = change(table_of(data))  # type: ignore[operator]
    with pytest.raises(DatasetError, match=says):
        dataset_of(table, ColumnMap.ours(table.column_names), source=Path("lab.csv"))


def of_type(table: pa.Table, name: str, kind: pa.DataType) -> pa.Table:
    """A table with one column of another type."""
    values = table.column(name).cast("int64", safe=False).cast(kind)
    return table.set_column(table.column_names.index(name), name, values)


def lack(table: pa.Table, name: str) -> pa.Table:
    """A table without the value in row 4 of one column, of the same type."""
    values = table.column(name).to_pylist()
    values[4] = None
    kind = table.schema.field(name).type
    return table.set_column(table.column_names.index(name), name, pa.array(values, kind))


def put(table: pa.Table, name: str, value: object) -> pa.Table:
    """A table with another value in row 4 of one column."""
    values = table.column(name).to_pylist()
    if isinstance(value, str):
        values = [str(one) for one in values]
    else:
        values = [float(one) for one in values]
    values[4] = value
    return table.set_column(table.column_names.index(name), name, pa.array(values))


def test_incomplete_rows_are_left_out_only_if_that_is_said(data: FeatureDataset) -> None:
    table = put(table_of(data), "force_z_n", float("nan"))
    found = dataset_of(
        table, ColumnMap.ours(table.column_names), source=Path("x"), drop_incomplete=True
    )
    assert len(found) == len(data) - 1
    assert "1 incomplete rows left out" in found.provenance.notes
    for name in ("time_ns", "sensor", "group", "in_contact"):
        lacking = lack(table_of(data), name)
        columns = ColumnMap.ours(lacking.column_names)
        found = dataset_of(lacking, columns, source=Path("x"), drop_incomplete=True)
        assert len(found) == len(data) - 1
        assert found.sensor_names == data.sensor_names
        assert data.time_ns is not None
        np.testing.assert_array_equal(found.time_ns, np.delete(data.time_ns, 4))


def test_errors_count_rows_of_the_table(data: FeatureDataset) -> None:
    """Also where earlier ones were left out."""
    table = put(table_of(data), "electrode_3", 17.5)
    table = table.set_column(0, "electrode_1", pa.array([None, *data.electrodes[1:, 0]]))
    columns = ColumnMap.ours(table.column_names)
    with pytest.raises(DatasetError, match=r"E3 reads 17\.5 in row 4"):
        dataset_of(table, columns, source=Path("x"), drop_incomplete=True)


def test_a_minus_turns_all_numbers_of_a_list(data: FeatureDataset) -> None:
    table = table_of(data).append_column("push", pa.array(data.force.tolist()))
    rest = columns_of("baseline")
    columns = ColumnMap(electrodes=columns_of("electrodes"), rest=rest, force="-push")
    found = dataset_of(table, columns, source=Path("x"))
    np.testing.assert_array_equal(found.force, -data.force)
    with pytest.raises(DatasetError, match=r"no column 'pull'"):
        dataset_of(table, columns.model_copy(update={"force": "-pull"}), source=Path("x"))


@pytest.mark.parametrize("name", ["contact_location", "centre_of_pressure"])
def test_locations_in_mm_are_not_taken_for_metres(data: FeatureDataset, name: str) -> None:
    place = pa.array([[12.0, 1.0, -7.0]] * len(data))
    told = {name: columns_of(name) for name in ("electrodes", "force")}
    columns = ColumnMap.model_validate(
        {**told, name: "place", "in_contact": "in_contact", "rest": columns_of("baseline")}
    )
    table = table_of(data).append_column("place", place)
    with pytest.raises(DatasetError, match=f"half of {name} is 13.93 m .* length_unit"):
        dataset_of(table, columns, source=Path("x"))
    in_mm = columns.model_copy(update={"length_unit": "mm"})
    found = getattr(dataset_of(table, in_mm, source=Path("x")), name)
    np.testing.assert_allclose(found[0], [0.012, 0.001, -0.007], rtol=1e-6)


def test_lists_of_another_width_are_refused(data: FeatureDataset) -> None:
    skin = [row.tolist() for row in data.electrodes]
    skin[3] = skin[3][:-1]
    table = table_of(data).append_column("skin", pa.array(skin))
    columns = ColumnMap(electrodes="skin", force=columns_of("force"), rest_rows=3)
    with pytest.raises(DatasetError, match=r"'skin' holds 18 numbers in row 3, not 19"):
        dataset_of(table, columns, source=Path("x"))
    words = table.set_column(
        len(table.column_names) - 1, "skin", pa.array([["a"] * 19] * len(skin))
    )
    with pytest.raises(DatasetError, match=r"'skin' holds list<.*string>, not lists of numbers"):
        dataset_of(words, columns, source=Path("x"))
    short = columns.model_copy(update={"electrodes": ["electrode_1", "electrode_2"]})
    with pytest.raises(DatasetError, match=r"2 columns are named from 'electrode_1' on, not 19"):
        dataset_of(table, short, source=Path("x"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("electrodes = 3\nforce = 'f'", "electrodes"),
        ("electrodes = 'e'", "force"),
        ("electrodes = 'e'\nforce = 'f'\nvoltage = 'v'", "voltage"),
        ("electrodes = 'e'\nforce = 'f'\ntime_unit = 'h'", "time_unit"),
        ("electrodes = ", "map.toml"),
        (
            "electrodes = ['E1', 'E2', 'E1']\nforce = 'f'",
            "map.toml: keys: column 'E1' is named twice",
        ),
        ("electrodes = 'e'\nforce = ['x', 'y', '-x']", "column 'x' is named twice"),
        ("electrodes = 'e'\nforce = 'f'\nrest = 'e'", "column 'e' is named twice"),
        ("electrodes = 'e'\nforce = 'f'\ntime = 't'\ngroup = 't'", "column 't' is named twice"),
        ("electrodes = 'e'\nforce = 'f'\nrest = 'r'\nrest_rows = 3", "rest and rest_rows"),
        ("electrodes = 'e'\nforce = 'f'\ngroups_across_sensors = true", "without group"),
    ],
)
def test_a_wrong_map_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        ColumnMap.read(path)


def test_what_is_no_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rows.parquet").write_bytes(b"\x00\x01")
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "rows.csv").write_text("time\n1.0\n")
    for name in ("rows.parquet", "empty.csv", "none.csv", "none.parquet"):
        with pytest.raises(DatasetError, match="cannot be read"):
            read_table(tmp_path / name)
    table = read_table(tmp_path / "rows.csv")
    with pytest.raises(DatasetError, match="no column 'electrode_1'"):
        dataset_of(table, ColumnMap.ours(table.column_names), source=tmp_path / "rows.csv")


def test_a_lerobot_dataset_has_episodes_at_an_even_rate(
    data: FeatureDataset, tmp_path: Path
) -> None:
    assert data.time_ns is not None
    times = data.time_ns.copy()
    times[4:] += 3 * STEP_NS  # three rows are missing in the first press
    gapped = replace(data, time_ns=times)
    presses = len(np.unique(np.stack([data.group, data.sensor]), axis=1).T)
    assert export_lerobot(tmp_path / "set", gapped) == presses + 1
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["fps"] == 100
    assert info["total_frames"] == len(data)
    table = read_lerobot(tmp_path / "set")
    frame, episode, time_s = (
        table.column(name).to_numpy() for name in ("frame_index", "episode_index", "timestamp")
    )
    np.testing.assert_allclose(time_s, frame / 100.0, atol=1e-4)
    assert list(episode[:6]) == [0, 0, 0, 0, 1, 1]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    np.testing.assert_allclose(
        stats["observation.force"]["mean"], data.force.mean(axis=0), atol=1e-6
    )
    columns = ColumnMap(
        electrodes="observation.electrodes",
        rest="observation.electrodes_at_rest",
        force="observation.force",
        contact_location="observation.contact_location",
        time="time_ns",
        time_unit="ns",
        group="episode_index",
    )
    back = dataset_of(table, columns, source=tmp_path / "set")
    np.testing.assert_array_equal(back.electrodes, data.electrodes)
    np.testing.assert_array_equal(back.time_ns, times)
    assert back.provenance.licence == "free"
    with pytest.raises(DatasetError, match="exists"):
        export_lerobot(tmp_path / "set", data)


def test_a_lerobot_dataset_of_ours_comes_back_without_a_map(
    data: FeatureDataset, tmp_path: Path
) -> None:
    """Also where an episode ends within a press, as a row is missing."""
    assert data.time_ns is not None
    times = data.time_ns.copy()
    times[4:] += 3 * STEP_NS
    gapped = replace(data, time_ns=times)
    write_dataset(tmp_path / "rows.h5", gapped)
    for arguments in (
        ["export", str(tmp_path / "rows.h5"), str(tmp_path / "set"), "--lerobot"],
        ["import", str(tmp_path / "set"), str(tmp_path / "back.h5")],
    ):
        result = CliRunner().invoke(data_app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    back = open_dataset(tmp_path / "back.h5")
    assert back.sensor_names == data.sensor_names
    assert back.content_sha256() == gapped.content_sha256()
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    kinds = {name: features[name]["dtype"] for name in ("sensor", "group", "block", "in_contact")}
    assert kinds == {"sensor": "string", "group": "int64", "block": "int64", "in_contact": "bool"}


def same_press(labels: np.ndarray, known: np.ndarray) -> None:
    """Two numberings tell the same rows apart."""
    pairs = np.unique(np.stack([labels, known]), axis=1).T
    assert len(pairs) == len(np.unique(labels)) == len(np.unique(known))


def test_a_lerobot_dataset_needs_a_rate(data: FeatureDataset, tmp_path: Path) -> None:
    timeless = replace(data, time_ns=None)
    with pytest.raises(DatasetError, match="--fps"):
        export_lerobot(tmp_path / "set", timeless)
    assert not list(tmp_path.iterdir())
    export_lerobot(tmp_path / "set", timeless, fps=50.0)
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["fps"] == 50


def test_a_lerobot_dataset_of_which_a_file_is_missing_is_refused(
    data: FeatureDataset, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match="no LeRobotDataset"):
        read_lerobot(tmp_path)
    export_lerobot(tmp_path / "set", data)
    (tmp_path / "set/data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(DatasetError, match="0 files hold 0 rows"):
        read_lerobot(tmp_path / "set")
    place = tmp_path / "set/meta/info.json"
    place.write_text(place.read_text().replace("v3.0", "v1.6"))
    with pytest.raises(DatasetError, match=r"v1\.6"):
        read_lerobot(tmp_path / "set")


def test_the_command_writes_each_form(data: FeatureDataset, tmp_path: Path) -> None:
    write_dataset(tmp_path / "rows.h5", data)
    for form, name in (("--csv", "a.csv"), ("--parquet", "a.parquet"), ("--lerobot", "a")):
        arguments = ["export", str(tmp_path / "rows.h5"), str(tmp_path / name), form]
        result = CliRunner().invoke(data_app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        assert (tmp_path / name).exists()
        back = ["import", str(tmp_path / name), str(tmp_path / f"{name}.h5")]
        result = CliRunner().invoke(data_app, back, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    for wrong in (["--published"], [], ["--csv", "--lerobot"]):
        arguments = ["export", str(tmp_path / "rows.h5"), str(tmp_path / "b"), *wrong]
        with pytest.raises(ConfigError):
            CliRunner().invoke(data_app, arguments, catch_exceptions=False)


def timed(data: FeatureDataset, times: np.ndarray) -> FeatureDataset:
    """One group of each sensor, with these times of all rows [ns]."""
    return replace(
        data, group=data.sensor.copy(), block=data.sensor.copy(), time_ns=times.astype(np.int64)
    )


def test_a_data_set_whose_times_go_back_is_refused(data: FeatureDataset) -> None:
    assert data.time_ns is not None
    with pytest.raises(DatasetError, match="row 1 is earlier than the one before it"):
        timed(data, data.time_ns[::-1])
    swapped = data.time_ns.copy()
    swapped[[4, 5]] = swapped[[5, 4]]
    with pytest.raises(DatasetError, match=r"row 5 is earlier .* \(1 rows in all\)"):
        timed(data, swapped)


def test_recordings_on_other_clocks_may_be_joined(data: FeatureDataset) -> None:
    """Each recording is in order; the second may be earlier, as after a restart of the host."""
    assert data.time_ns is not None
    later = timed(data, data.time_ns)
    counts = data.electrodes + np.uint16(1)
    earlier = replace(timed(data, data.time_ns - 10**18), electrodes=counts)
    both = joined([later, earlier])
    assert both.time_ns is not None
    assert both.time_ns[0] > both.time_ns[-1]


@pytest.mark.parametrize("together", [1, 2, 3])
def test_rows_that_come_together_do_not_stretch_the_period(together: int) -> None:
    rows = np.arange(600) // together * together
    gap = 10**9 * (rows >= 300)
    period_s = period_of(10**18 + rows * STEP_NS + gap)
    assert period_s == pytest.approx(1e-9 * STEP_NS, rel=1e-3)


def _with_the_next(rows: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Some rows have the time of the next one that is not among them."""
    times = np.where(some, len(rows), rows)
    times[-1] = rows[-1]
    return np.minimum.accumulate(times[::-1])[::-1]


@pytest.mark.parametrize(
    "stamped",
    [
        lambda rows: _with_the_next(rows, np.random.default_rng(0).random(len(rows)) < 1 / 3),
        lambda rows: _with_the_next(rows, rows % 5 == 0),
        lambda rows: rows // 1.6 * 1.6,
        lambda rows: rows // 1.1 * 1.1,
        lambda rows: np.where(rows < 300, 0, rows),
        lambda rows: np.where(rows == 7, 6, rows + rows // 20),
    ],
    ids=["a third", "one in five", "slow clock", "nearly a row", "stood still", "rows missing"],
)
def test_rows_of_which_some_share_a_time_have_the_same_period(stamped: Any) -> None:
    times = np.rint(stamped(np.arange(600)) * STEP_NS).astype(np.int64)
    assert period_of(10**18 + times) == pytest.approx(1e-9 * STEP_NS, rel=0.01)


def test_times_that_repeat_are_told(data: FeatureDataset) -> None:
    rows = np.arange(len(data))
    paired = timed(data, rows // 2 * 2 * STEP_NS)
    table = table_of(paired)
    found = dataset_of(table, ColumnMap.ours(table.column_names), source=Path("x"))
    np.testing.assert_array_equal(found.time_ns, paired.time_ns)
    same = len(data) // 2
    assert f"{same} rows have the time of the row before" in found.provenance.notes


def test_a_time_that_stands_still_is_refused(data: FeatureDataset) -> None:
    last = data.sensor == len(data.sensor_names) - 1
    times = np.where(last, 5, np.arange(len(data)) * STEP_NS)
    table = table_of(timed(data, times))
    told = f"time is the same in all {last.sum()} rows of '{data.sensor_names[-1]}'"
    with pytest.raises(DatasetError, match=told):
        dataset_of(table, ColumnMap.ours(table.column_names), source=Path("x"))


def test_a_sensor_that_has_lost_all_its_rows_is_named_no_more(data: FeatureDataset) -> None:
    force = np.where(data.sensor == 1, np.nan, data.force[:, 0])
    table = table_of(data)
    table = table.set_column(table.column_names.index("force_x_n"), "force_x_n", pa.array(force))
    found = dataset_of(
        table, ColumnMap.ours(table.column_names), source=Path("x"), drop_incomplete=True
    )
    one, gone, three = data.sensor_names
    assert found.sensor_names == (one, three)
    assert np.array(found.sensor_names)[found.sensor].tolist() == [
        data.sensor_names[sensor] for sensor in data.sensor if sensor != 1
    ]
    assert f"no row is left of {gone}" in found.provenance.notes
