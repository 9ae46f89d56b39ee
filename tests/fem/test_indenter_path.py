"""Paths: what is refused, with its place, files that give back the same bits, and words."""

from __future__ import annotations

import contextlib
import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import ConfigError
from palpate_fem.indenter.path import (
    COLUMNS,
    FILE_BYTES_MOST,
    POSES_MOST,
    PathSegment,
    check_path,
    parse_segments,
    read_path,
    show_segments,
)

HEADER = "x_m,y_m,z_m,qw,qx,qy,qz"
GOOD = [[0.0, 0.0, -0.0085, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -0.008, 1.0, 0.0, 0.0, 0.0]]


def changed(row: int, column: int, value: float) -> list[list[float]]:
    path = [list(pose) for pose in GOOD]
    path[row][column] = value
    return path


def test_a_good_path_is_copied_and_its_quaternions_get_length_1() -> None:
    given_path = np.array(changed(1, 3, 1.0 + 5e-7))
    path = check_path(given_path)
    assert path is not given_path
    assert given_path[1, 3] == 1.0 + 5e-7
    np.testing.assert_allclose(path, GOOD, atol=1e-15)
    assert path.dtype == np.float64


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        ([], "has no pose"),
        (np.empty((0, 7)), "has no pose"),
        (GOOD[:1], "one pose, where the indenter starts, and no step"),
        (GOOD[0], r"shape \(7,\)"),
        ([pose[:6] for pose in GOOD], r"shape \(2, 6\)"),
        ([GOOD[0], GOOD[1][:5]], "not an array of numbers"),
        ([["a"] * 7] * 2, "not an array of numbers"),
        (None, "shape|array"),
        (changed(1, 2, math.nan), r"path\[1\] is not finite"),
        (changed(0, 4, math.inf), r"path\[0\] is not finite"),
        (changed(1, 2, -8.3), r"path\[1\] is 8\.3 m away"),
        (changed(1, 3, 1.0 + 2e-6), r"path\[1\] has a quaternion of length 1\.000002"),
        (changed(0, 3, 0.0), r"path\[0\] has a quaternion of length 0"),
        (np.tile(GOOD[0], (POSES_MOST + 1, 1)), r"has 10,001 poses, at most 10,000"),
    ],
)
def test_a_wrong_path_is_refused_with_the_reason(path: Any, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        check_path(path)
    assert caught.value.remedy


@settings(max_examples=30)
@given(
    positions=st.lists(st.tuples(*3 * [st.floats(-0.2, 0.2)]), min_size=2, max_size=5),
    turn=st.tuples(*4 * [st.floats(-1, 1)]).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_a_file_gives_back_the_path(
    tmp_path_factory: pytest.TempPathFactory,
    positions: list[tuple[float, float, float]],
    turn: tuple[float, float, float, float],
) -> None:
    file = tmp_path_factory.mktemp("path") / "path.csv"
    quaternion = np.array(turn) / np.linalg.norm(turn)
    path = check_path([[*position, *quaternion] for position in positions])
    np.savetxt(file, path, "%.17g", ",", header=HEADER, comments="")
    np.testing.assert_array_equal(read_path(file)[:, :3], path[:, :3])
    np.testing.assert_allclose(read_path(file), path, atol=1e-15)


LINE = "0,0,-0.0085,1,0,0,0"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", r"line 1: the header is ''"),
        (f"{LINE}\n{LINE}\n", "line 1: the header is"),
        (f"x,y,z,qw,qx,qy,qz\n{LINE}\n", "line 1: the header is"),
        (f"{HEADER}\n", "has no pose"),
        (f"{HEADER}\n{LINE}\n", "no step"),
        (f"{HEADER}\n{LINE}\n0,0,0,1,0,0\n", "line 3: 6 values, not 7"),
        (f"{HEADER}\n{LINE}\n\n{LINE}\n", "line 3: 0 values"),
        (f"{HEADER}\n{LINE}\n{LINE},\n", "line 3: 8 values"),
        (f"{HEADER}\n0,0,deep,1,0,0,0\n{LINE}\n", "line 2: z_m = 'deep' is not a number"),
        (f"{HEADER}\n{LINE}\n0,,0,1,0,0,0\n", "line 3: y_m = '' is not a number"),
        (f"{HEADER}\n{LINE}\n-0.0_003997,0,0,1,0,0,0\n", "line 3: x_m = .* is not a number"),
        (f"{HEADER}\n{LINE}\n\uff12e-3,0,0,1,0,0,0\n", "line 3: x_m = .* is not a number"),
        (f"{HEADER}\n{LINE}\n0,0,nan,1,0,0,0\n", "line 3 is not finite"),
        (f"{HEADER}\n{LINE}\n0,0,0,-inf,0,0,0\n", "line 3 is not finite"),
        (f"{HEADER}\n{LINE}\n0,0,-8.3,1,0,0,0\n", "line 3 is 8.3 m away"),
        (f"{HEADER}\n{LINE}\n{LINE}\n0,0,0,2,0,0,0\n", "line 4 has a quaternion of length 2"),
        (f'{HEADER}\n"0,0\n', "not CSV|values"),
    ],
)
def test_a_wrong_file_is_refused_with_the_line(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "wrong.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=problem) as caught:
        read_path(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00binary"])
def test_no_file_and_no_text_are_refused(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "path.csv"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_path(file)


def test_files_of_spreadsheets_are_read(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_bytes(f"\ufeff{HEADER}\r\n{LINE}\r\n {LINE}\r\n".encode())
    assert read_path(file).shape == (2, 7)


def columns_of(path: list[list[float]]) -> dict[str, list[float]]:
    return dict(zip(COLUMNS, map(list, zip(*path, strict=True)), strict=True))


def written(file: Path, columns: dict[str, Any]) -> Path:
    """The columns in a file of the kind that its suffix says."""
    if file.suffix == ".json":
        file.write_text(json.dumps(columns), encoding="utf-8")
    else:
        np.savez(file, **columns)
    return file


@pytest.mark.parametrize("name", ["poses.json", "poses.npz"])
def test_files_with_named_columns_give_back_the_path(tmp_path: Path, name: str) -> None:
    path = check_path(GOOD)
    path[1, :3] = 1 / 300, -1 / 700, np.pi * 1e-3
    found = read_path(written(tmp_path / name, columns_of(path.tolist())))
    np.testing.assert_array_equal(found, path)


@pytest.mark.parametrize("name", ["poses.json", "poses.npz"])
@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"qz": None}, "'qz' is missing"),
        ({"time_s": [0.0, 1.0]}, "'time_s' is not a column"),
        ({"z_m": [0.0]}, "differ in length"),
        ({"z_m": [[0.0, 1.0]]}, "z_m is not a list of numbers"),
        ({"z_m": ["low", "high"]}, "z_m is not a list of numbers"),
        ({"z_m": [True, False]}, "z_m is not a list of numbers"),
        ({"z_m": 1.0}, "z_m is not a list of numbers"),
        ({"z_m": [0.0, math.nan]}, r"\[1\] is not finite"),
        ({"z_m": [0.0, -8.3]}, r"\[1\] is 8.3 m away"),
        ({"qw": [1.0, 2.0]}, r"\[1\] has a quaternion of length 2"),
        ({key: [] for key in COLUMNS}, "has no pose"),
        ({key: column[:1] for key, column in columns_of(GOOD).items()}, "no step"),
        ({key: 6000 * column for key, column in columns_of(GOOD).items()}, "12,000 poses|bytes"),
    ],
)
def test_wrong_columns_are_refused(
    tmp_path: Path, name: str, change: dict[str, Any], problem: str
) -> None:
    columns = {k: v for k, v in (columns_of(GOOD) | change).items() if v is not None}
    with pytest.raises(ConfigError, match=problem) as caught:
        read_path(written(tmp_path / name, columns))
    assert caught.value.remedy
    assert name in str(caught.value)


def claimed(size: int) -> bytes:
    """A small .npz file with a member that unpacks to so many bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr("x_m.npy", bytes(size))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.json", b"[1, 2]", "holds no object"),
        ("a.json", b"{", "not JSON"),
        ("a.json", b"[" * 100_000, "not JSON"),
        ("a.json", b"\xff\xfe", "cannot be read"),
        ("a.json", b'{"x_m": [1, [2]]}', "'qw' is missing"),
        ("a.json", json.dumps(columns_of(GOOD) | {"x_m": [1, [2]]}).encode(), "x_m is not a list"),
        ("a.npz", b"", "not an .npz"),
        ("a.npz", b"PK\x03\x04" + bytes(100), "not an .npz"),
        ("a.npz", claimed(100), "not an .npz|is missing|not a list"),
        ("a.npz", claimed(FILE_BYTES_MOST + 1), "unpacks to"),
        ("a.csv", bytes(FILE_BYTES_MOST + 1), "more than"),
        ("a.npz", bytes(FILE_BYTES_MOST + 1), "more than"),
    ],
)
def test_damaged_and_huge_files_are_refused(
    tmp_path: Path, name: str, content: bytes, problem: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=problem):
        read_path(tmp_path / name)


@settings(max_examples=60)
@given(cut=st.integers(0, 2000), flips=st.lists(st.integers(0, 16_000), max_size=4))
def test_any_damage_to_an_npz_file_is_a_typed_error_or_none(
    tmp_path_factory: pytest.TempPathFactory, cut: int, flips: list[int]
) -> None:
    file = tmp_path_factory.mktemp("npz") / "poses.npz"
    content = bytearray(written(file, columns_of(GOOD)).read_bytes())
    for bit in flips:
        content[bit // 8 % len(content)] ^= 1 << bit % 8
    file.write_bytes(bytes(content[: len(content) - cut]))
    with contextlib.suppress(ConfigError):
        assert read_path(file).shape == (2, 7)


def test_no_object_of_python_is_unpacked(tmp_path: Path) -> None:
    bad = columns_of(GOOD) | {"x_m": np.array([{}, {}], object)}
    with pytest.raises(ConfigError, match=r"not an \.npz"):
        read_path(written(tmp_path / "poses.npz", bad))


DEG = math.pi / 180.0


@pytest.mark.parametrize(
    ("words", "segments"),
    [
        ("press 2 mm", [PathSegment("press", 2e-3)]),
        (
            "press 1.5 mm at 30 deg towards -y,\n slide 1 mm towards 45 deg,unload",
            [
                PathSegment("press", 1.5e-3, 30 * DEG, 270 * DEG),
                PathSegment("slide", 1e-3, azimuth_rad=45 * DEG),
                PathSegment("unload"),
            ],
        ),
        (
            "press 1 mm at 10 deg, twist -20 deg, roll 5 deg towards proximal, unload 0.5 mm",
            [
                PathSegment("press", 1e-3, 10 * DEG),
                PathSegment("twist", -20 * DEG),
                PathSegment("roll", 5 * DEG, azimuth_rad=180 * DEG),
                PathSegment("unload", 0.5e-3),
            ],
        ),
    ],
)
def test_words_are_segments_and_back(words: str, segments: list[PathSegment]) -> None:
    found = parse_segments(words)
    assert [one.kind for one in found] == [one.kind for one in segments]
    for one, wanted in zip(found, segments, strict=True):
        assert one.amount == (None if wanted.amount is None else pytest.approx(wanted.amount))
        assert one.angle_rad == pytest.approx(wanted.angle_rad)
        assert one.azimuth_rad == pytest.approx(wanted.azimuth_rad)
    assert show_segments(parse_segments(show_segments(found))) == show_segments(found)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("", "'' is no segment"),
        ("press 2 mm,", "'' is no segment"),
        ("push 2 mm", "'push 2 mm' is no segment"),
        ("press 2", "no segment"),
        ("press 2 cm", "no segment"),
        ("press two mm", "'two' is not a number"),
        ("press 0_2 mm", "'0_2' is not a number"),
        ("press 2 mm, slide 1_0 mm towards distal", "'1_0' is not a number"),
        ("press \uff12 mm", "is not a number"),
        ("press 2 mm at \u0663 deg", "is not a number"),
        ("press nan mm", "'nan' is not a number"),
        ("press inf mm", "'inf' is not a number"),
        ("press", "does not say how far"),
        ("press 2 deg", "is in deg"),
        ("press 0 mm", "no such way"),
        ("press -1 mm", "no such way"),
        ("press 2000 mm", "no such way"),
        ("press 2 mm towards +y", "leads nowhere"),
        ("press 2 mm at 90 deg", "does not lead into the skin"),
        ("press 2 mm at x deg", "'x' is not a number"),
        ("slide 1 mm towards +y", "clear of the skin"),
        ("press 1 mm, slide 1 mm", "where to"),
        ("press 1 mm, slide 1 mm towards left", "'left' is no direction"),
        ("press 1 mm, slide 1 mm towards +y deg", "not a number"),
        ("press 1 mm, slide 1 mm at 30 deg towards +y", "only a press"),
        ("press 1 mm, twist 20 mm", "is in mm"),
        ("press 1 mm, twist 0 deg", "no such way"),
        ("press 1 mm, twist 400 deg", "no such way"),
        ("press 1 mm, twist 20 deg towards +y", "leads nowhere"),
        (", ".join(["press 1 mm"] * 300), "300 segments"),
    ],
)
def test_words_that_are_no_path_are_refused(words: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_segments(words)
    assert problem in str(caught.value)
    assert caught.value.remedy
