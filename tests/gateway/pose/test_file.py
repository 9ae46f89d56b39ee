"""Recorded robot poses: CSV files whole and broken in every way."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, RecordingError
from palpate.messages import Origin
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import PoseReading, Reading

fakes: Any = importlib.import_module("pose_fakes")
COUNT = 150


def device_of(path: Path, **options: Any) -> Device:
    return make_device("pose_file", {"path": path, **fakes.BENCH, **options})


def drain(device: Device) -> list[Reading]:
    readings: list[Reading] = []
    while got := device.read(1.0):
        readings += got
    return readings


def test_a_table_becomes_the_tip(tmp_path: Path) -> None:
    path = fakes.write_csv(tmp_path / "run.csv", fakes.csv_lines(COUNT))
    device = device_of(path)
    assert not device.info.live
    assert device.info.finite
    assert device.info.origin is Origin.REPLAYED
    with device:
        readings = drain(device)
        assert device.read(0.1) == []
        assert device.identity.start_wall_ns is None
        assert device.identity.serial == "run.csv"
        assert device.counters == {"samples": COUNT, "repeated_poses": 0}
    assert fakes.numbers(readings) == list(range(1, COUNT + 1))
    for number, reading in enumerate(readings, 1):
        assert isinstance(reading, PoseReading)
        tip = fakes.tip(number)
        np.testing.assert_allclose(reading.position, tip.position, atol=fakes.NEAR)
        same = float(reading.orientation @ tip.orientation)
        assert abs(abs(same) - 1.0) < fakes.NEAR  # either sign is the same rotation
        assert reading.time_s == pytest.approx(0.004 * (number - 1), abs=1e-12)
        assert reading.tick == number - 1
        assert reading.in_contact is None


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_columns_go_by_name(tmp_path: Path, end: str) -> None:
    plain = fakes.csv_lines(20, unit="mm")
    order = [7, 4, 5, 6, 1, 2, 3, 0]  # the quaternion first, x y z w
    rows = [line.split(",") for line in plain]
    rows = [[row[i] for i in order] for row in rows]
    rows[0] = [f' "{name}"' for name in rows[0]] + ["program", "joint_1"]
    rows[1:] = [[*row, "press 3", ""] for row in rows[1:]]
    lines = ["\ufeff" + ",".join(rows[0]), *(", ".join(row) for row in rows[1:]), ""]
    with device_of(fakes.write_csv(tmp_path / "a.csv", lines, end=end)) as device:
        readings = drain(device)
    assert fakes.numbers(readings) == list(range(1, 21))


def test_wall_clock_of_the_start(tmp_path: Path) -> None:
    lines = fakes.csv_lines(3)
    lines = [f"{line},{'wall_ns' if k == 0 else 10**18 + k}" for k, line in enumerate(lines)]
    path = fakes.write_csv(tmp_path / "a.csv", lines)
    with device_of(path) as device:
        assert device.identity.start_wall_ns == 10**18 + 1
        assert device.read(0.1)[0].time_s == 0.0, "the wall clock of the first row is time zero's"
    with device_of(path, start_wall_ns=5) as device:
        assert device.identity.start_wall_ns == 5


def test_rows_of_the_same_time_are_one_pose(tmp_path: Path) -> None:
    lines = fakes.csv_lines(5)
    lines[3:3] = [lines[2], lines[2]]  # logged faster than the controller told
    with device_of(fakes.write_csv(tmp_path / "a.csv", lines)) as device:
        assert fakes.numbers(drain(device)) == [1, 2, 3, 4, 5]
        assert device.counters == {"samples": 5, "repeated_poses": 2}


def _header(old: str, new: str) -> Any:
    return lambda lines: [lines[0].replace(old, new), *lines[1:]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [], "the file is empty"),
        (lambda lines: ["", "  "], "the file is empty"),
        (lambda lines: lines[:1], "a header and no rows"),
        (lambda lines: lines[1:], "line 1: there is no header, only numbers"),
        (_header("time_s", "time"), "line 1: column 'time_s' is missing -> name the columns"),
        (_header("y_m", "y"), "line 1: column 'y_m' is missing"),
        (_header("x_m,y_m,z_m", "x,y,z"), "line 1: column 'x_m' is missing"),
        (_header("x_m,y_m,z_m", "x_mm,y_m,z_m"), "in m and in mm"),
        (_header("x_m,y_m,z_m", "x_mm,y,z"), "column 'y_mm' is missing"),
        (_header("qw,", "w,"), "column 'qw' is missing"),
        (_header("qw,qx", "qx,qx"), "column 'qx' is there twice"),
        (lambda lines: [x.replace(",", ";") for x in lines], "line 1: .* separated by semicolons"),
        (lambda lines: [x.replace(",", "\t") for x in lines], "line 1: .* separated by tabs"),
        (lambda lines: [x.replace(",", " ") for x in lines], "line 1: .* separated by blanks"),
    ],
)
def test_a_file_that_is_no_table_is_not_opened(tmp_path: Path, change: Any, message: str) -> None:
    device = device_of(fakes.write_csv(tmp_path / "a.csv", change(fakes.csv_lines(5))))
    with pytest.raises(RecordingError, match=message):
        device.open()
    assert not device.is_open


def _cell(row: int, column: int, text: str) -> Any:
    def change(lines: list[str]) -> list[str]:
        cells = lines[row].split(",")
        cells[column] = text
        return [*lines[:row], ",".join(cells), *lines[row + 1 :]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_cell(90, 2, "nan"), r"line 91: column 'y_m': 'nan' is not finite"),
        (_cell(90, 0, "inf"), r"line 91: column 'time_s': 'inf' is not finite"),
        (_cell(90, 3, "1e308"), r"line 91: column 'z_m': '1e308' is out of any robot's reach"),
        (_cell(90, 1, "400"), r"line 91: column 'x_m': '400' is out of any .* x_mm y_mm z_mm"),
        (_cell(90, 1, "1_0"), r"line 91: column 'x_m': '1_0' is not a number"),
        (_cell(90, 1, "\u0664"), r"line 91: column 'x_m': '\u0664' is not a number"),
        (_cell(90, 4, ""), r"line 91: column 'qw': '' is not a number"),
        (_cell(90, 1, "0.4 m"), r"line 91: column 'x_m': '0.4 m' is not a number"),
        (_cell(90, 4, "0"), r"line 91: columns qw qx qy qz: the quaternion has length 0\.\d+, not"),
        (_cell(90, 0, "0.1"), r"line 91: column 'time_s': time goes back from 0.356 to 0.1 s"),
        (lambda lines: [*lines[:90], lines[90] + ",1", *lines[91:]], "line 91: 9 columns, the h"),
        (lambda lines: [*lines[:90], "1,2", *lines[91:]], "line 91: 2 columns, the header has 8"),
        (_cell(90, 1, "x" * (1 << 16)), "line 91: the line is too long"),
        (_cell(90, 1, "0,4"), "line 91: 9 columns, the header has 8"),
    ],
)
def test_a_broken_row_is_named_after_all_before_it(
    tmp_path: Path, change: Any, message: str
) -> None:
    path = fakes.write_csv(tmp_path / "a.csv", change(fakes.csv_lines(COUNT)))
    with device_of(path) as device:
        readings: list[Reading] = []
        error = fakes.read_to_damage(device, readings)
        assert re.search(message, str(error))
        assert str(path) in error.problem
        assert fakes.numbers(readings) == list(range(1, 90))
        assert device.read(0.1) == []


@pytest.mark.parametrize("cut", [1, 2, 40, 100])
def test_a_cut_last_line_is_named(tmp_path: Path, cut: int) -> None:
    path = fakes.write_csv(tmp_path / "a.csv", fakes.csv_lines(COUNT), cut=cut)
    with device_of(path) as device:
        readings = device.read(1.0) + device.read(1.0) + device.read(1.0)
        with pytest.raises(RecordingError, match=f"line {COUNT + 1}: the last line is cut") as e:
            device.read(1.0)
        assert "if the line is whole, end it" in e.value.remedy
        assert len(readings) == COUNT - 1
        assert device.read(1.0) == []


def test_what_is_no_text_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"time_s,\xff\xfe\n1,2\n")
    with pytest.raises(RecordingError, match="line 1: byte 8 of the line is not text"):
        device_of(tmp_path / "a.csv").open()
    with pytest.raises(RecordingError, match=r"nowhere\.csv: cannot be read \(No such file"):
        device_of(tmp_path / "nowhere.csv").open()
    with pytest.raises(RecordingError, match="cannot be read"):
        device_of(tmp_path).open()
    lines = [
        line + ",wall_ns" if k == 0 else line + ",now" for k, line in enumerate(fakes.csv_lines(3))
    ]
    with pytest.raises(
        RecordingError, match="line 2: column 'wall_ns': 'now' is not a whole number"
    ):
        device_of(fakes.write_csv(tmp_path / "b.csv", lines)).open()


def test_wrong_options_are_named() -> None:
    with pytest.raises(ConfigError, match="key 'path' is missing"):
        make_device("pose_file", fakes.BENCH)
    with pytest.raises(ConfigError, match="robot"):
        device_of(Path("a.mcap"), robot="an arm")
    with pytest.raises(ConfigError, match="start_wall_ns"):
        device_of(Path("a.csv"), start_wall_ns=-1)
