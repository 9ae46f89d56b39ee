"""The table of electrodes is the documented one, and what follows from it fits it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from palpate.anatomy import (
    ELECTRODE_MIRROR,
    ELECTRODE_NORMALS,
    ELECTRODE_POSITIONS,
    EXCITATION_NORMALS,
    EXCITATION_POSITIONS,
    SP_ELECTRODE_MIRROR,
    SP_ELECTRODE_POSITIONS,
    SP_EXCITATION_POSITIONS,
)


def test_the_table_is_the_one_of_the_conventions(root: Path) -> None:
    text = (root / "docs/conventions.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| E(\d+) \|(.+)\|$", text, re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 20))
    numbers = np.array([[float(cell) for cell in row.split("|")] for _, row in rows])
    np.testing.assert_allclose(ELECTRODE_POSITIONS, 1e-3 * numbers[:, :3], atol=1e-12)
    np.testing.assert_allclose(ELECTRODE_NORMALS, numbers[:, 3:], atol=1e-3)  # three printed digits
    for normals in (ELECTRODE_NORMALS, EXCITATION_NORMALS):
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)


def test_the_table_is_mirror_symmetric() -> None:
    flip = np.array([1.0, -1.0, 1.0])
    for table in (ELECTRODE_POSITIONS, ELECTRODE_NORMALS):
        np.testing.assert_array_equal(table[ELECTRODE_MIRROR], table * flip)
    for table in (EXCITATION_POSITIONS, EXCITATION_NORMALS):
        np.testing.assert_array_equal(table[[2, 3, 0, 1]], table * flip)


def test_the_table_of_the_sp_is_the_one_of_the_conventions(root: Path) -> None:
    text = (root / "docs/conventions.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| SP E(\d+) \|(.+)\|$", text, re.MULTILINE)
    assert [int(number) for number, _ in rows] == [*range(1, 11), *range(21, 25)]
    for number, row in rows:
        position = [1e-3 * float(cell) for cell in row.split("|")]
        np.testing.assert_allclose(SP_ELECTRODE_POSITIONS[int(number) - 1], position, atol=1e-12)


def test_the_table_of_the_sp_is_mirror_symmetric() -> None:
    flip = np.array([1.0, -1.0, 1.0])
    assert SP_ELECTRODE_POSITIONS.shape == (24, 3)
    mirrored = SP_ELECTRODE_POSITIONS[SP_ELECTRODE_MIRROR]
    np.testing.assert_array_equal(mirrored, SP_ELECTRODE_POSITIONS * flip)
    mirrored = SP_EXCITATION_POSITIONS[[2, 3, 0, 1]]
    np.testing.assert_array_equal(mirrored, SP_EXCITATION_POSITIONS * flip)
    # On the pad's side of a core some 16 mm wide and 20 mm long.
    assert (SP_ELECTRODE_POSITIONS[:, 2] < 0).all()
    assert np.ptp(SP_ELECTRODE_POSITIONS, axis=0).max() < 0.021
