"""Recordings of real BioTacs in the study: invented ones in the layout of the public archives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.cli.report import train_report
from palpate_training.evaluation.recordings import (
    AUTHORS_NETWORK,
    FORCE_CALIBRATION,
    LAYERS,
    read_recordings,
)
from palpate_training.evaluation.study import Study, StudyPlan
from palpate_training.figures.plate import CONTACT_NORMAL

SIMPLE = ("zero", "training mean", "ridge")
TOUCHES, TOUCH_ROWS = 20, 30


def write_forces(folder: Path, rows: int = 6000) -> None:
    """Two fingers whose electrodes follow the force."""
    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {}
    for finger in (1, 2):
        force = 2.0 + np.cumsum(rng.normal(0.0, 0.02, (rows, 3)), axis=0)
        mix = rng.normal(size=(3, 19))
        counts = 3000 + 40 * force @ mix + rng.normal(0.0, 1.0, (rows, 19))
        arrays[f"finger{finger}_electrodes_raw"] = counts.astype(np.uint16)
        arrays[f"finger{finger}_baseline_mean"] = np.full(19, 3000.0)
        arrays[f"finger{finger}_force_N"] = force
    (folder / FORCE_CALIBRATION).parent.mkdir(parents=True)
    np.savez(folder / FORCE_CALIBRATION, **arrays)


def write_normals(folder: Path) -> None:
    """A log of twenty touches, each of another plate, a short one, and one that is not touched."""
    rng = np.random.default_rng(1)
    mix = rng.normal(size=(3, 19))
    arrays: dict[str, Any] = {}
    for log, touches in (("log1", 3), ("log2", TOUCHES), ("log3", 0)):
        state = np.repeat([0], 100)
        for number in range(touches):
            state = np.concatenate([state, np.full(TOUCH_ROWS, number + 1), np.zeros(100, int)])
        plates = rng.normal([0.0, 0.0, 2.0], 0.6, (touches + 1, 3))
        plates[0] = (0.0, 0.0, 1.0)
        plates /= np.linalg.norm(plates, axis=1, keepdims=True)
        touched = (state > 0)[:, None]
        arrays |= {
            f"{log}_unix_time_s": 1.5e9 + 0.01 * np.arange(len(state)),
            f"{log}_pdc_raw": np.where(state > 0, 2700, 2400).astype(np.uint16),
            f"{log}_electrodes_raw": (3000 + touched * (300 * plates[state] @ mix)).astype(
                np.uint16
            ),
            f"{log}_contact_normal": plates[state].astype(np.float32),
        }
    (folder / CONTACT_NORMAL).parent.mkdir(parents=True, exist_ok=True)
    np.savez(folder / CONTACT_NORMAL, **arrays)


def write_network(folder: Path) -> None:
    """Always pushes along (0.6, ., 0)."""
    arrays: dict[str, Any] = {}
    widths = [19, *[5] * (LAYERS - 1), 2]
    for layer in range(LAYERS):
        arrays[f"coeff{layer}"] = np.zeros((widths[layer], widths[layer + 1]))
        arrays[f"bias{layer}"] = np.zeros(widths[layer + 1])
    arrays[f"bias{LAYERS - 1}"] = np.array([0.6, 0.0])
    (folder / AUTHORS_NETWORK).parent.mkdir(parents=True, exist_ok=True)
    np.savez(folder / AUTHORS_NETWORK, **arrays)


def study_of(folder: Path, **plan: Any) -> Study:
    source = read_recordings(folder)
    assert source is not None
    return Study(source, StudyPlan(**{"systems": SIMPLE, **plan}))


def test_forces_hold_out_blocks_the_end_and_a_finger(tmp_path: Path) -> None:
    write_forces(tmp_path)
    study = study_of(tmp_path)
    assert list(study.tasks) == ["force"]
    ridge = [cell for cell in study.cells if cell.system == "ridge"]
    tests = {(cell.fold.split, cell.fold.test, cell.fold.part) for cell in ridge}
    fingers = ("lasa-finger1", "lasa-finger2")
    assert tests == {
        *(("block", finger, str(k)) for finger in fingers for k in range(1, 6)),
        *(("tail", finger, "") for finger in fingers),
        ("unit", "lasa-finger1 to lasa-finger2", ""),
        ("unit", "lasa-finger2 to lasa-finger1", ""),
    }
    for cell in ridge:
        rows = cell.fold.rows
        sides = [rows.train, rows.validation, rows.test, rows.guard]
        assert len(np.unique(np.concatenate(sides))) == sum(map(len, sides))
        if cell.fold.split != "unit":
            seen = np.concatenate([rows.train, rows.validation])
            near = np.abs(np.subtract.outer(seen, rows.test[[0, -1]])).min()
            assert near > 100  # a second of guard
    tail = next(cell for cell in ridge if cell.fold.split == "tail")
    assert tail.fold.rows.test.tolist() == list(range(4798, 5998))  # two rows of lag are lost
    blocks = [cell.fold.rows.test for cell in ridge if cell.fold.test == fingers[0]][:5]
    assert np.array_equal(np.sort(np.concatenate(blocks)), np.arange(5998))


def test_forces_are_scored_by_system(tmp_path: Path) -> None:
    write_forces(tmp_path)
    study = study_of(tmp_path, splits=("block", "tail"))
    study.make(tmp_path / "cells", workers=0)
    values = study.results(tmp_path / "cells")
    error = {
        (row["split"], row["test"], row["system"]): row["metrics"]["magnitude_n_median"]
        for row in values["scores"]
    }
    for split in ("block", "tail"):
        one = [error[split, "lasa-finger1", system] for system in SIMPLE]
        assert one[2] < 0.3 * one[1] < 0.3 * one[0]
    assert values["rows"] == {"rows for force": 2 * 5998}


def test_normals_hold_out_touches_and_logs(tmp_path: Path) -> None:
    write_normals(tmp_path)
    study = study_of(tmp_path)
    assert list(study.tasks) == ["normal"]
    folds = [cell.fold for cell in study.cells if cell.system == "ridge"]
    touches = [fold for fold in folds if fold.split == "touch"]
    assert [len(fold.rows.test) for fold in touches] == [TOUCHES // 5 * TOUCH_ROWS] * 5
    assert {fold.test for fold in touches} == {"log2"}
    (log,) = (fold for fold in folds if fold.split == "log")
    assert (log.test, len(log.rows.test)) == ("log2 to all others", 3 * TOUCH_ROWS)
    study.make(tmp_path / "cells", workers=0)
    scores = study.results(tmp_path / "cells")["scores"]
    angle = {(row["split"], row["system"]): row["metrics"]["angle_rad_median"] for row in scores}
    assert angle["touch", "ridge"] < 0.05 < 0.15 < angle["touch", "training mean"]
    assert angle["log", "ridge"] < 0.05


def test_the_authors_network_is_a_row_where_it_is_there(tmp_path: Path) -> None:
    write_normals(tmp_path)
    with pytest.raises(Exception, match="nothing is to be made"):
        study_of(tmp_path, systems=("the authors' network",))
    write_network(tmp_path)
    study = study_of(tmp_path, systems=("the authors' network",), splits=("log",))
    study.make(tmp_path / "cells", workers=0)
    (cell,) = study.cells
    task = study.tasks["normal"]
    estimate = task.fit_and_test(task.systems[-1], cell.fold.rows, 0)["estimate"]
    truth = task.samples.normal[cell.fold.rows.test]  # type: ignore[attr-defined]
    np.testing.assert_allclose(estimate[:, 0], -0.6)  # out of the skin: against the push
    np.testing.assert_allclose(np.abs(estimate[:, 1]), 0.8)
    np.testing.assert_array_equal(np.sign(estimate[:, 1]), np.sign(truth[:, 1]))


def test_damaged_and_missing_archives_are_named(tmp_path: Path) -> None:
    assert read_recordings(tmp_path) is None
    (tmp_path / FORCE_CALIBRATION).parent.mkdir()
    (tmp_path / FORCE_CALIBRATION).write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(DatasetError, match="force_calibration"):
        read_recordings(tmp_path)
    (tmp_path / FORCE_CALIBRATION).unlink()
    write_normals(tmp_path)
    (tmp_path / AUTHORS_NETWORK).write_bytes(b"no archive")
    with pytest.raises(DatasetError, match="published_mlp"):
        read_recordings(tmp_path)


def test_the_command_makes_the_page_of_recordings(tmp_path: Path) -> None:
    write_forces(tmp_path, rows=2500)
    write_normals(tmp_path)
    write_network(tmp_path)
    train_report(tmp_path, tmp_path / "out", systems="zero,ridge,authors", workers=1)
    page = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    for words in (
        "LASA force calibration",
        "Unseen blocks of 18 s",
        "The last 20 % of each recording",
        "Unseen touches",
        "the authors' network",
        "![",
    ):
        assert words in page


def test_real_recordings(shared_data: Path, tmp_path: Path) -> None:
    """What is known of them: how many rows and touches, and that ridge beats the mean."""
    study = study_of(shared_data, tasks=("normal",))
    study.make(tmp_path / "cells", workers=0)
    values = study.results(tmp_path / "cells")
    degrees = {
        (row["split"], row["system"]): np.degrees(row["metrics"]["angle_rad_median"])
        for row in values["scores"]
    }
    assert values["rows"]["rows for normal"] == 4374
    assert 15 < degrees["touch", "training mean"] < 30
    assert degrees["touch", "ridge"] < 12
