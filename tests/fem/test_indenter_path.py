"""Paths: what is refused, with its place, and files that give back the same bits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import ConfigError
from palpate_fem.indenter.path import check_path, read_path

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
