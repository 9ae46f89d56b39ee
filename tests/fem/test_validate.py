"""Validation: the paper's table by hand, what is left out, and what is no validation."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation, write_indentations
from palpate_fem.calibration.runs import SimulatedRun, simulate_all
from palpate_fem.config import FingertipParameters
from palpate_fem.plot.validation import examples, plot_examples, plot_indenters
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter, export
from palpate_fem.validation.sources import measured_from, simulated_from
from palpate_fem.validation.validate import (
    INDENTER_HEADINGS,
    TRAJECTORY_HEADINGS,
    Validation,
    indenter_rows,
    summary_lines,
    trajectory_rows,
    validate,
    write_report,
)

sample: Any = importlib.import_module("stored_sample")
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

TOUCH_M = 1e-3
STIFFNESS = np.array([200.0, 0.0, 1000.0])


def way(samples: int = 41, length_m: float = 4e-3) -> Floats:
    path = np.zeros((samples, 7))
    path[:, 2], path[:, 3] = np.linspace(0.0, length_m, samples), 1.0
    return path


def ramp(stiffness: Floats = STIFFNESS, touch_m: float = TOUCH_M) -> Floats:
    return np.maximum(path_lengths(way()) - touch_m, 0.0)[:, None] * stiffness


def measured(name: str, indenter: str, sensor: str = "biotac1") -> MeasuredIndentation:
    return MeasuredIndentation(f"{name}/{sensor}", indenter, sensor, way(), ramp())


def run(
    force: Floats, outcome: IndentationOutcome = IndentationOutcome.COMPLETE, reason: str = ""
) -> SimulatedRun:
    return SimulatedRun(force, path_lengths(way())[: len(force)], 0.0151, 8e-7, outcome, reason)


@pytest.fixture
def validation() -> Validation:
    """Two sensors of a ring, a cube simulated too stiff and later, and four that fail."""
    items = [
        measured("ring/00/normal", "ring"),
        measured("ring/00/normal", "ring", "biotac2"),
        measured("cube/00/normal", "cube"),
        *(measured(f"texture/0{i}/normal", "texture") for i in range(4)),
    ]
    stiffer = ramp(STIFFNESS * 1.1, TOUCH_M + 0.3e-3)
    soft = replace(items[-1], force=ramp(STIFFNESS * 0.01))
    return validate(
        [*items[:-1], soft],
        {
            "ring/00/normal/biotac1": run(ramp()),
            "ring/00/normal/biotac2": run(ramp()),
            "cube/00/normal/biotac1": run(stiffer[:35], IndentationOutcome.FORCE_LIMIT, "32.1 N"),
            "texture/00/normal/biotac1": run(ramp()[:12], IndentationOutcome.DIVERGED, "at 1.1 mm"),
            "texture/01/normal/biotac1": run(
                np.empty((0, 3)), IndentationOutcome.DIVERGED, "refused"
            ),
            "texture/03/normal/biotac1": run(ramp()),
        },
    )


def test_numbers_are_the_papers_formula(validation: Validation) -> None:
    ring, _, cube = validation.compared
    assert ring.rms_n == pytest.approx(0.0, abs=1e-9)
    # by hand: both curves begin at 0.5 N in the same direction; slopes differ by a tenth
    start = 0.5 / np.linalg.norm(STIFFNESS)
    common = 3.4e-3 - TOUCH_M - 0.3e-3 - start / 1.1
    assert cube.displacement_m == pytest.approx(common)
    grid = common * np.arange(1, 21) / 20
    rms = np.sqrt(np.mean(grid**2)) * 0.1 * STIFFNESS
    np.testing.assert_allclose(cube.axis_rms_n, rms, rtol=1e-9)
    assert cube.rms_n == pytest.approx(rms.sum())
    assert cube.peak_n == pytest.approx(0.5 + common * np.linalg.norm(STIFFNESS))
    assert cube.relative == pytest.approx(cube.rms_n / cube.peak_n)
    assert cube.depth_offset_m == pytest.approx(0.3e-3 + start * (1 / 1.1 - 1))
    assert cube.coverage == pytest.approx(common / (4e-3 - TOUCH_M - start))
    assert (cube.outcome, cube.path_name) == (IndentationOutcome.FORCE_LIMIT, "cube/00/normal")


def test_table_has_means_and_the_median_of_indenters(validation: Validation) -> None:
    cube, ring = validation.by_indenter
    assert (cube.indenter, cube.trajectories) == ("cube", 1)
    assert (ring.indenter, ring.trajectories) == ("ring", 2)
    assert validation.median_n == pytest.approx(cube.rms_n / 2, rel=1e-6)
    rows = indenter_rows(validation)
    assert all(len(row) == len(INDENTER_HEADINGS) for row in rows)
    assert rows[1][0] == "ring"
    assert rows[1][3] == "0.486", "the paper's number beside ours"
    assert "0.260 (0.226-0.486)" in rows[-1]


def test_what_is_left_out_is_listed_with_its_reason(validation: Validation) -> None:
    reasons = {name.split("/")[1]: why for name, why in validation.excluded.items()}
    assert "simulation never reaches" in reasons["00"]
    assert "diverged: at 1.1 mm" in reasons["00"]
    assert "fewer than two" in reasons["01"]
    assert "refused" in reasons["01"]
    assert reasons["02"] == "not simulated"
    assert "measurement never reaches" in reasons["03"]
    assert validation.outcomes == {"complete": 3, "diverged": 2, "force limit": 1}
    text = "\n".join(summary_lines(validation))
    assert all(name in text and why in text for name, why in validation.excluded.items())
    assert "compared 3, left out 4" in text


def test_simulations_in_the_place_of_measurements_are_called_a_self_test(
    validation: Validation,
) -> None:
    assert not validation.self_test
    assert "SELF-TEST" not in validation.title
    twin = replace(measured("ring/00/normal", "ring"), origin=SIMULATED)
    both = [measured("ring/01/normal", "ring"), twin]
    found = validate(both, {item.name: run(ramp()) for item in both})
    assert found.self_test
    assert found.title.startswith("SELF-TEST")
    assert summary_lines(found)[0] == found.title


def test_report_files_hold_every_trajectory(validation: Validation, tmp_path: Path) -> None:
    files = write_report(tmp_path / "out", validation)
    with files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == TRAJECTORY_HEADINGS
    assert len(rows) == 7
    assert float(rows[2]["rms_n"]) == pytest.approx(validation.compared[2].rms_n, rel=1e-5)
    assert rows[-1]["excluded_because"]
    content = json.loads(files[2].read_text(), parse_constant=pytest.fail)
    assert content["self_test"] is False
    assert content["paper"]["median_n"] == 0.26
    assert len(content["trajectories"]) == 3
    assert len(content["excluded"]) == 4
    assert not list((tmp_path / "out").glob(".*")), "no partial file is left"
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DatasetError, match="cannot write"):
        write_report(tmp_path / "file", validation)


def test_nothing_compared_is_a_report_too(tmp_path: Path) -> None:
    found = validate([measured("ring/00/normal", "ring")], {})
    assert indenter_rows(found) == []
    assert len(trajectory_rows(found)) == 1
    content = json.loads(write_report(tmp_path, found)[2].read_text(), parse_constant=pytest.fail)
    assert content["median_n"] is None


def test_figures_are_drawn(validation: Validation, tmp_path: Path) -> None:
    assert examples(validation) == ["cube/00/normal", "ring/00/normal"]
    plot_examples(validation, tmp_path / "examples.png")
    plot_indenters(validation, tmp_path / "indenters.png")
    for file in tmp_path.iterdir():
        assert file.read_bytes().startswith(b"\x89PNG")


class Counting:
    """Counts its runs; refuses one indenter."""

    def __init__(self) -> None:
        self.runs = 0

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        self.runs += 1
        return run(ramp() * parameters.shear_modulus_pa / 2.8e5)


def test_sensors_pressed_alike_share_a_simulation() -> None:
    simulator, told = Counting(), list[tuple[int, int]]()
    items = [measured("ring/00/normal", "ring", f"biotac{i}") for i in (1, 2, 3)]
    items.append(measured("cube/00/normal", "cube"))
    runs = simulate_all(
        simulator,
        FingertipParameters(),
        items,
        on_run=lambda done, total: told.append((done, total)),
    )
    assert simulator.runs == 2
    assert told == [(1, 2), (2, 2)]
    assert set(runs) == {item.name for item in items}
    assert len(validate(items, runs).compared) == 4


LIGHT_N = 0.1
"""Threshold for the sample press, which ends at 0.5 N."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SimulationStore:
    path = tmp_path_factory.mktemp("store") / "sweep.sim"
    tip = sample_fingertip(divisions=4)
    with StoreWriter(path, tip, command="test") as writer:
        press = sample_trajectory(tip, steps=12)
        writer.write("sphere_medium/00/normal", press)
        short = replace(
            press, steps=press.steps[:1], outcome=IndentationOutcome.DIVERGED, reason="early"
        )
        writer.write("sphere_medium/01/normal", replace(short, steps=()))
    return SimulationStore.open(path)


def test_a_store_is_compared_with_itself_without_error(
    store: SimulationStore, tmp_path: Path
) -> None:
    items, left_out = measured_from(store.path)
    assert [item.name for item in items] == ["sphere_medium/00/normal"]
    assert items[0].origin == SIMULATED
    assert "sphere_medium/01/normal" in left_out
    runs, refused = simulated_from(store, items)
    assert not refused
    found = validate(items, runs, threshold_n=LIGHT_N)
    assert found.self_test
    assert [item.rms_n for item in found.compared] == [pytest.approx(0.0, abs=1e-12)]
    exported = tmp_path / "sweep.h5"
    export(store, exported)
    assert len(measured_from(exported)[0]) == 1


def test_a_path_that_comes_back_to_its_start_is_compared(tmp_path: Path) -> None:
    tip = sample_fingertip(divisions=4)
    press = sample_trajectory(tip, steps=12)
    clear = replace(press.steps[0], pose=press.path[0], force=np.zeros(3))
    back = replace(
        press,
        path=np.concatenate([press.path, press.path[-2::-1]]),
        steps=(*press.steps, *press.steps[-2::-1], clear),
    )
    with StoreWriter(tmp_path / "back.sim", tip, command="test") as writer:
        writer.write("sphere_medium/00/back", back)
    items, _ = measured_from(tmp_path / "back.sim")
    runs, refused = simulated_from(SimulationStore.open(tmp_path / "back.sim"), items)
    assert not refused
    found = validate(items, runs, threshold_n=LIGHT_N)
    assert not found.excluded
    assert [item.rms_n for item in found.compared] == [pytest.approx(0.0, abs=1e-12)]


def test_a_stored_simulation_serves_each_sensor_from_its_own_start(store: SimulationStore) -> None:
    """The measured path begins 2 mm further out; the depth offset is not touched by that."""
    (item,), _ = measured_from(store.path)
    trajectory = store.trajectory(item.name)
    direction = item.pose[-1, :3] - item.pose[0, :3]
    direction /= np.linalg.norm(direction)
    before = item.pose[:1].copy()
    before[0, :3] -= 2e-3 * direction
    pose = np.concatenate([before, item.pose])
    force = np.concatenate([np.zeros((1, 3)), item.force])
    sensors = [
        MeasuredIndentation(f"{item.name}/{sensor}", item.indenter, sensor, pose, force)
        for sensor in ("biotac1", "biotac2")
    ]
    runs, _ = simulated_from(store, sensors)
    assert set(runs) == {sensor.name for sensor in sensors}
    found = validate(sensors, runs, threshold_n=LIGHT_N)
    assert len(found.compared) == 2
    for compared in found.compared:
        assert compared.depth_offset_m == pytest.approx(0.0, abs=1e-9)
        assert compared.rms_n == pytest.approx(0.0, abs=1e-9)
        assert compared.outcome is trajectory.outcome


def test_a_stored_simulation_of_another_path_is_refused(store: SimulationStore) -> None:
    (item,), _ = measured_from(store.path)
    aside = item.pose.copy()
    aside[:, :3] += 1e-4 * np.cross(item.pose[-1, :3] - item.pose[0, :3], [1.0, 0.3, 0.2]) / 1e-3
    turned = item.pose.copy()
    turned[:, 0] += np.linspace(0.0, 1e-3, len(turned))
    changed = [
        replace(item, pose=aside, origin="measured"),
        replace(item, pose=turned, origin="measured"),
        replace(item, indenter="ring", origin="measured"),
    ]
    for other, why in zip(changed, ("beside", "direction", "simulated with"), strict=True):
        runs, refused = simulated_from(store, [other])
        assert not runs
        assert why in refused[item.name]
        assert validate([other], runs, refused).excluded == refused


def test_measurements_are_read_from_their_own_schema(tmp_path: Path) -> None:
    path = tmp_path / "measured.h5"
    write_indentations(path, [measured("ring/00/normal", "ring")], source="a test")
    items, left_out = measured_from(path)
    assert len(items) == 1
    assert not left_out
    with pytest.raises(DatasetError, match="no such"):
        measured_from(tmp_path / "nothing.h5")
