"""Cells: kept by what decides them, made once, never half."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.evaluation import cells
from palpate_training.evaluation.cells import (
    Cell,
    cell_key,
    cell_path,
    cells_of,
    make_cells,
    read_cell,
)
from palpate_training.experiment.generate.trials import TrialsDone, pack, read_trials
from palpate_training.learning.population_net import (
    PopulationConfig,
    PopulationNet,
    load_population_net,
    save_population_net,
)
from palpate_training.learning.splits import Fold, RowSplit
from palpate_training.systems.fields import FIELD_SYSTEMS
from palpate_training.systems.statistical import STATISTICAL

PATIENCE_S = 60.0
ROWS = RowSplit(*(np.arange(start, start + 4) for start in (0, 4, 8, 12)))
FOLD = Fold("trajectory", "all units", "", ROWS)


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes import this module for its tasks."""
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[3])


def noise(rows: RowSplit, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(len(rows.test), 3))


@dataclass(frozen=True)
class Sometimes:
    name: str
    seeded: bool
    source: str = "a test"
    fit: Callable[..., Any] = noise


@dataclass(frozen=True)
class NoiseTask:
    """Gives noise as estimates."""

    name: str = "noise"
    data_sha256: str = "00"
    systems: tuple[Sometimes, ...] = (Sometimes("drawn", True), Sometimes("still", False))

    def fit_and_test(self, system: Any, rows: RowSplit, seed: int) -> dict[str, Any]:
        if system.name == "broken":
            raise DatasetError("this one fails", remedy="leave it out")
        return {"estimate": system.fit(rows, seed)}


def test_only_what_is_random_is_made_for_each_seed() -> None:
    each = list(cells_of(NoiseTask(), [FOLD], [0, 1, 2]))
    assert [(cell.system, cell.seed) for cell in each] == [
        ("drawn", 0), ("drawn", 1), ("drawn", 2), ("still", 0)
    ]  # fmt: skip


def test_each_cell_is_made_once(tmp_path: Path) -> None:
    task = NoiseTask()
    each = list(cells_of(task, [FOLD], [0, 1]))
    told: list[bool] = []

    def on_cell(_: Cell, made: bool) -> None:
        told.append(made)

    for _ in range(2):
        make_cells([task], each, tmp_path, workers=0, on_cell=on_cell)
    assert told == [True] * 3 + [False] * 3
    for cell in each:
        found = read_cell(cell_path(tmp_path, task, cell))
        np.testing.assert_array_equal(found.arrays["estimate"], noise(ROWS, cell.seed))
        assert found.seconds >= 0.0


def test_what_decides_a_cell_is_in_its_name() -> None:
    task = NoiseTask()
    cell = Cell("noise", FOLD, "drawn", 0)
    fewer = replace(FOLD, rows=replace(ROWS, train=ROWS.train[1:]))
    keys = {
        cell_key(task, cell),
        cell_key(task, replace(cell, seed=1)),
        cell_key(task, replace(cell, system="still")),
        cell_key(task, replace(cell, fold=fewer)),
        cell_key(replace(task, data_sha256="01"), cell),
    }
    assert len(keys) == 5
    assert cell_key(task, cell) == cell_key(task, replace(cell))


RIDGE = next(system for system in STATISTICAL if "ridge" in system.name)


@pytest.mark.parametrize(
    ("system", "module"),
    [
        (FIELD_SYSTEMS[-1], "systems/latent"),
        (FIELD_SYSTEMS[-1], "tasks/fields"),
        (FIELD_SYSTEMS[-1], "learning/fit"),
        (RIDGE, "learning/baselines"),
    ],
)
def test_code_that_a_system_builds_on_is_in_its_name(
    monkeypatch: pytest.MonkeyPatch, system: cells.Tested, module: str
) -> None:
    before = cells.code_of(system)
    original = cells._file_sha256
    monkeypatch.setattr(
        cells, "_file_sha256", lambda path: "changed" if module in path else original(path)
    )
    assert cells.code_of(system) != before


@pytest.mark.usefixtures("importable")
@pytest.mark.parametrize("workers", [0, 2])
def test_the_others_are_made_where_one_fails(
    tmp_path: Path, workers: int, caplog: pytest.LogCaptureFixture
) -> None:
    task = replace(NoiseTask(), systems=(Sometimes("broken", False), Sometimes("drawn", True)))
    each = list(cells_of(task, [FOLD], [0, 1, 2]))
    with pytest.raises(DatasetError, match="this one fails"):
        make_cells([task], each, tmp_path, workers=workers, on_cell=lambda *_: None)
    made = [cell_path(tmp_path, task, cell).exists() for cell in each]
    assert made == [False, True, True, True]
    (told,) = caplog.messages
    assert told.startswith("noise: broken, trajectory all units, seed 0: this one fails")


@dataclass(frozen=True)
class SlowTask(NoiseTask):
    """Takes a while, leaves a file for each training that began, and gives what Ctrl-C does."""

    systems: tuple[Sometimes, ...] = (Sometimes("drawn", True),)
    begun: Path = Path()

    def fit_and_test(self, system: Any, rows: RowSplit, seed: int) -> dict[str, Any]:
        (self.begun / str(seed)).touch()
        time.sleep(0.2 + 0.3 * (seed % 2))
        return {"ignored": np.array(signal.getsignal(signal.SIGINT) == signal.SIG_IGN)}


@pytest.mark.usefixtures("importable")
def test_on_ctrl_c_nothing_begins_and_what_is_under_way_is_kept(tmp_path: Path) -> None:
    task = SlowTask(begun=tmp_path / "begun")
    task.begun.mkdir()
    each = list(cells_of(task, [FOLD], range(8)))
    kept: list[Cell] = []

    def on_cell(cell: Cell, _: bool) -> None:
        kept.append(cell)
        if len(kept) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_cells([task], each, tmp_path, workers=2, on_cell=on_cell)
    begun = {int(path.name) for path in task.begun.iterdir()}
    paths = {cell.seed: cell_path(tmp_path, task, cell) for cell in each}
    assert {seed for seed, path in paths.items() if path.exists()} == begun
    assert len(begun) <= 2
    assert all(read_cell(paths[seed]).arrays["ignored"] for seed in begun)


@dataclass(frozen=True)
class EndlessTask(SlowTask):
    """Its first training is done at once, the others never."""

    def fit_and_test(self, system: Any, rows: RowSplit, seed: int) -> dict[str, Any]:
        (self.begun / str(seed)).touch()
        time.sleep(3600 if seed else 0)
        return {}


ENDLESS = """
import sys
from pathlib import Path
from tests.training.evaluation.test_cells import FOLD, EndlessTask, cells_of, make_cells
task = EndlessTask(begun=Path(sys.argv[1]))
each = list(cells_of(task, [FOLD], range(8)))
make_cells([task], each, task.begun, workers=2, on_cell=lambda *_: None)
"""


def test_the_second_ctrl_c_leaves_what_is_under_way(root: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with log.open("wb") as stderr:
        program = subprocess.Popen(
            [sys.executable, "-c", ENDLESS, str(tmp_path)],
            cwd=root, stderr=stderr, start_new_session=True,
        )  # fmt: skip

    def interrupt_when(true: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        os.killpg(program.pid, signal.SIGINT)

    try:
        interrupt_when(lambda: all((tmp_path / str(seed)).exists() for seed in (1, 2)))
        interrupt_when(lambda: "waits for 2 trainings" in log.read_text())
        assert program.wait(PATIENCE_S) == -signal.SIGINT
    finally:
        program.kill()  # its workers end with it
        program.wait()
    task = EndlessTask(begun=tmp_path)
    kept = [cell_path(tmp_path, task, cell).exists() for cell in cells_of(task, [FOLD], range(8))]
    assert kept == [True] + 7 * [False]


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cell.npz"
    for content in (b"", b"PK\x03\x04 no archive"):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"cell\.npz: not a readable"):
            read_cell(path)
    np.savez(path, estimate=np.zeros(3))
    with pytest.raises(DatasetError, match="seconds"):
        read_cell(path)


def _cell(path: Path) -> None:
    np.savez_compressed(path, estimate=VALUES, seconds=np.array(1.0))


def _trials(path: Path) -> None:
    counts = {"biotac-1": VALUES}
    path.write_bytes(pack(TrialsDone("cell", (), (("biotac-2", "why"),), counts, 5)))


def _net(path: Path) -> None:
    save_population_net(path, PopulationNet(("force",), PopulationConfig(width=16, blocks=1)))


VALUES = np.round(np.random.default_rng(0).normal(size=(300, 19)), 2)


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (_cell, read_cell),
        (_trials, lambda path: read_trials(path.parent, "cell")),
        (_net, load_population_net),
    ],
)
def test_damaged_values_of_an_archive_are_told(
    tmp_path: Path, write: Callable[[Path], None], read: Callable[[Path], object]
) -> None:
    path = tmp_path / "cell.npz"
    write(path)
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda one: one.compress_size)
    whole, begin = path.read_bytes(), largest.header_offset
    for at in range(begin + 300, begin + largest.compress_size, largest.compress_size // 50):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        with pytest.raises(DatasetError, match=r"cell\.npz"):
            read(path)
