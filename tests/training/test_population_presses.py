"""Presses as input of a population's network: a gain that nothing but a press can tell."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.training.invented_population import SMALL, population
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate_training.cli import train_app
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.learning import population_fit
from palpate_training.learning.intervals import Floats, Labels
from palpate_training.learning.networks import predict
from palpate_training.learning.population_fit import PopulationRows
from palpate_training.learning.population_net import (
    WEIGHTS,
    PopulationNet,
    load_population_net,
)
from palpate_training.learning.press_set import CalibrationPresses
from palpate_training.learning.told_finger import REPORT, read_told_network
from palpate_training.tasks.population import (
    fingertips_of,
    rows_of,
    train_population,
)
from palpate_training.tasks.population_bounds import held_bounds, told_errors
from palpate_training.tasks.population_errors import SHOTS, draw_shots, shots_table

UNSEEN = "unseen_specimen_unseen_press"


@pytest.fixture(scope="module")
def data() -> FeatureDataset:
    return population(specimens=24, presses=120, each=12)


@pytest.fixture(scope="module")
def rows(data: FeatureDataset) -> PopulationRows:
    return rows_of(data)[1]


@pytest.fixture(scope="module")
def stored(data: FeatureDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("population") / "features.h5"
    write_dataset(path, data)
    return path


@pytest.fixture(scope="module")
def folder(stored: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    config = replace(SMALL, epochs=40, batch_rows=512)
    train_population(stored, out, config=config, device="cpu")
    return out


def test_bounds_hold_on_specimens_that_neither_network_nor_bound_has_met(
    folder: Path, data: FeatureDataset, rows: PopulationRows, net: PopulationNet
) -> None:
    tested = np.flatnonzero(rows.touched)
    estimate = predict(net, rows.inputs)[tested]
    found = held_bounds(net.quantities, estimate, rows, tested, fingertips_of(data))
    assert set(found) == {"force_magnitude", "contact_location"}
    for one in found.values():
        assert one["specimens"] == 24
        assert one["worst"] < one["held"]
        assert one["ci95"][0] <= one["held"] <= one["ci95"][1]
        assert one["error"] < one["bound"]
        assert 0.8 < one["held"] < 0.99
    # Half of them ten times as badly estimated, of which the others' bounds know nothing.
    worse = estimate.copy()
    badly = rows.specimen[tested] >= 12
    worse[badly] += 9.0 * (worse[badly] - rows.targets[tested][badly])
    assert (
        held_bounds(net.quantities, worse, rows, tested, rows.specimen)["force_magnitude"]["worst"]
        < 0.5
    )
    one = tested[rows.specimen[tested] == 3]
    assert (
        held_bounds(net.quantities, predict(net, rows.inputs)[one], rows, one, rows.specimen) == {}
    )


def test_pressed_rows_whose_location_is_unknown_do_not_count() -> None:
    """A simulation may find no contact in a row that has a force."""
    rng = np.random.default_rng(0)
    specimen, press = np.repeat(np.arange(4), 100), np.repeat(np.arange(40), 10)
    truth = np.hstack([np.tile([0.0, 0.0, 1.0], (400, 1)), rng.normal(0.0, 1e-3, (400, 3))])
    estimate = truth + rng.normal(0.0, 1e-2, (400, 6))
    quantities = ("force", "contact_location")

    def known(targets: Floats, tested: Labels) -> tuple[dict[str, Any], dict[str, Any]]:
        nothing = np.zeros((400, 19), np.float32)
        rows = PopulationRows(nothing, nothing, targets.astype(np.float32), specimen, press)
        given = (quantities, estimate[tested], rows, tested)
        return told_errors(*given)["bounds"], held_bounds(*given, specimen)

    unknown = (np.arange(400) % 7 == 0) | (specimen == 3)
    holes = truth.copy()
    holes[unknown, 3:] = np.nan
    told, held = known(holes, np.arange(400))
    same_told, same_held = known(truth, np.flatnonzero(~unknown))
    assert told["contact_location"] == same_told["contact_location"]
    assert held["contact_location"] == same_held["contact_location"]
    assert held["contact_location"]["specimens"] == 3
    assert held["force_magnitude"]["specimens"] == 4


def test_a_network_is_measured_again_without_a_training(
    folder: Path, stored: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "again")
    weights = (folder / WEIGHTS).read_bytes()
    arguments = ["population", str(stored), str(tmp_path / "again"), "--measure"]
    result = CliRunner().invoke(train_app, arguments, env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    assert "bound of force_magnitude holds" in result.output
    assert (tmp_path / "again" / WEIGHTS).read_bytes() == weights
    before, after = (json.loads((one / REPORT).read_text()) for one in (folder, tmp_path / "again"))
    before["onnx"].pop("milliseconds"), after["onnx"].pop("milliseconds")
    assert after == before
    (tmp_path / "again" / WEIGHTS).unlink()
    assert isinstance(CliRunner().invoke(train_app, arguments).exception, DatasetError)


def test_a_network_is_measured_with_the_seed_and_on_the_data_of_its_training(
    stored: Path, tmp_path: Path
) -> None:
    """Else presses that it has learned from would count as unseen."""
    out = tmp_path / "trained"
    small = replace(SMALL, epochs=1, width=16)
    _, facts = train_population(stored, out, config=small, device="cpu", seed=2)
    for seed in (None, 2):
        _, again = train_population(stored, out, config=small, seed=seed, measure=True)
        assert again["seed"] == 2
        assert again["unseen_specimens"] == facts["unseen_specimens"]
    report = (out / REPORT).read_text()
    with pytest.raises(ConfigError, match=r"--seed 1 is not that of .*, 2"):
        train_population(stored, out, config=small, seed=1, measure=True)
    write_dataset(tmp_path / "other.h5", population(specimens=24, presses=60, each=12))
    with pytest.raises(DatasetError, match=r"other\.h5 is not the data set of .*learned"):
        train_population(tmp_path / "other.h5", out, config=small, measure=True)
    assert (out / REPORT).read_text() == report
    (out / REPORT).unlink()  # a training that was ended before its report
    with pytest.raises(DatasetError, match="does not say what the network was trained with"):
        train_population(stored, out, config=small, measure=True)
    _, again = train_population(stored, out, config=small, seed=2, measure=True)
    assert again["unseen_specimens"] == facts["unseen_specimens"]


def test_a_network_is_not_replaced(folder: Path, stored: Path) -> None:
    weights = (folder / WEIGHTS).read_bytes()
    with pytest.raises(DatasetError, match="holds a network that is trained"):
        train_population(stored, folder, config=replace(SMALL, epochs=1), device="cpu")
    assert (folder / WEIGHTS).read_bytes() == weights


def test_a_trained_folder_tells_a_finger_and_a_damaged_one_is_named(
    folder: Path, tmp_path: Path
) -> None:
    told = read_told_network(folder)
    assert set(told.contact_sd) == set(told.net.quantities[1:])
    assert {"force_magnitude", "contact_location"} <= set(told.bounds)
    shutil.copytree(folder, tmp_path / "damaged")
    report = json.loads((folder / REPORT).read_text())
    for broken in ("", "[]", json.dumps(report | {"told": {"shots": 10}})):
        (tmp_path / "damaged" / REPORT).write_text(broken)
        with pytest.raises(DatasetError, match="does not say how far"):
            read_told_network(tmp_path / "damaged")


@pytest.fixture
def net(folder: Path) -> PopulationNet:
    return load_population_net(folder / WEIGHTS)


@pytest.fixture
def presses(rows: PopulationRows) -> CalibrationPresses:
    (draw, *_) = draw_shots(rows, rows.specimen == 3, most=3, draws=1, seed=0)
    return rows.calibration(draw.known(3))


def mirrored(net: PopulationNet, presses: CalibrationPresses) -> CalibrationPresses:
    image = net.mirrored_presses(presses.tensor()).numpy()
    return CalibrationPresses(image[:, :19], image[:, 19:22], presses.press)


def test_a_press_tells_what_electrodes_do_not(folder: Path) -> None:
    shots = json.loads((folder / REPORT).read_text())["cells"][UNSEEN]["shots"]
    none, one, five = (shots[key]["network"]["force_magnitude_n"] for key in ("0", "1", "5"))
    assert one < 0.6 * none
    assert five < 0.5 * none
    assert one < 1.2 * shots["1"]["one factor"]["force_magnitude_n"]
    for offset in ("+0.05", "-0.05"):
        assert shots["1"][f"network, all {offset}"]["force_magnitude_n"] < 0.9 * none


def test_the_order_of_rows_and_presses_means_nothing(
    net: PopulationNet, presses: CalibrationPresses, rows: PopulationRows
) -> None:
    order = np.random.default_rng(0).permutation(len(presses.press))
    shuffled = CalibrationPresses(
        presses.inputs[order], presses.force[order], 7 - presses.press[order]
    )
    first, second = (predict(net, net.told(rows.inputs[:50], one)) for one in (presses, shuffled))
    np.testing.assert_allclose(first, second, atol=1e-5)
    none = predict(net, rows.inputs[:50])
    assert np.abs(first - none).max() > 0.05


def test_a_press_is_no_surer_for_being_sampled_fast(
    net: PopulationNet, presses: CalibrationPresses, rows: PopulationRows
) -> None:
    twice = CalibrationPresses(
        np.repeat(presses.inputs, 2, axis=0),
        np.repeat(presses.force, 2, axis=0),
        np.repeat(presses.press, 2),
    )
    first, second = (predict(net, net.told(rows.inputs[:50], one)) for one in (presses, twice))
    np.testing.assert_allclose(first, second, atol=1e-5)


def test_mirrored_presses_and_rows_get_the_mirrored_estimate(
    net: PopulationNet, presses: CalibrationPresses, rows: PopulationRows
) -> None:
    plain = rows.inputs[:80]
    image = plain[:, net.order[:19].numpy()]
    here = predict(net, net.told(plain, presses))
    there = predict(net, net.told(image, mirrored(net, presses)))
    np.testing.assert_allclose(there, here * net.signs.numpy(), atol=1e-5)


def test_no_press_is_the_network_that_knows_none(net: PopulationNet, rows: PopulationRows) -> None:
    nothing = rows.calibration(np.zeros(0, np.int64))
    told = net.told(rows.inputs[:40], nothing)
    assert not told[:, 19:].any()
    np.testing.assert_array_equal(predict(net, told), predict(net, rows.inputs[:40]))


def test_presses_of_another_shape_are_refused(presses: CalibrationPresses) -> None:
    with pytest.raises(DatasetError, match=r"inputs .* has shape .*, 18\), not .*, 19\)"):
        replace(presses, inputs=presses.inputs[:, 1:])
    with pytest.raises(DatasetError, match=r"force .* has shape"):
        replace(presses, force=presses.force[:-1])
    with pytest.raises(DatasetError, match=r"press .* has shape"):
        replace(presses, press=presses.press[:, None])
    broken = presses.force.copy()
    broken[0, 0] = np.nan
    with pytest.raises(DatasetError, match="not finite"):
        replace(presses, force=broken)


def test_tested_rows_are_of_no_known_press_and_specimen(rows: PopulationRows) -> None:
    chosen = rows.press % 2 == 0
    drawn = draw_shots(rows, chosen, most=10, draws=2, seed=1)
    assert len(drawn) == 2 * 24
    assert rows.point is not None
    for draw in drawn:
        known = draw.known(10)
        assert len(draw.presses) == 10
        assert len(draw.known(0)) == 0
        assert len(np.unique(rows.press[known])) == 10
        assert not set(rows.point[known]) & set(rows.point[draw.tested])
        both = np.concatenate([known, draw.tested])
        assert len(np.unique(rows.specimen[both])) == 1
        assert chosen[both].all()
        assert rows.touched[both].all()


def test_training_tells_no_row_its_own_press(
    rows: PopulationRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one press for each specimen there is nothing else to tell, so nothing is told."""
    few = rows.where(rows.press == 5)
    torch.manual_seed(0)
    net = PopulationNet(("force", "contact_location"), replace(SMALL, stiffness_sd=0.5))
    net.normalise_from(rows.inputs, rows.targets)
    episodes = population_fit._Episodes(net, few, np.random.default_rng(0))
    seen: list[torch.Tensor] = []
    one_sided = net.one_sided

    def watched(inputs: torch.Tensor) -> torch.Tensor:
        seen.append(inputs)
        return one_sided(inputs)

    monkeypatch.setattr(net, "one_sided", watched)
    numbers = torch.arange(len(episodes.rows)).float()[:, None]
    episodes(numbers)
    assert not seen[-1][..., 19:].any()
    monkeypatch.undo()
    several = population_fit._Episodes(net, rows, np.random.default_rng(0))
    monkeypatch.setattr(net, "one_sided", watched)
    several(torch.arange(32).float()[:, None])
    assert seen[-1][..., 19:].any()


def test_a_set_with_few_presses_has_a_table_as_far_as_they_go(
    rows: PopulationRows, net: PopulationNet
) -> None:
    few = np.isin(rows.press, np.unique(rows.press)[:9])
    table = shots_table(rows, few, net, rows.specimen, seed=0)
    assert {int(key) for key in table if key.isdigit()} == {0, 1, 5} < set(SHOTS)
    assert shots_table(rows, rows.press == 5, net, rows.specimen, seed=0) == {}


def test_turns_are_rotations() -> None:
    vectors = 0.5 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    turns = population_fit._turns(vectors)
    expected = Rotation.from_rotvec(vectors.numpy()).as_matrix()
    np.testing.assert_allclose(turns.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(population_fit._turns(torch.zeros(1, 3))[0].numpy(), np.eye(3))


def test_an_estimate_of_a_stiffer_turned_specimen_is_taken_back(
    rows: PopulationRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that told the stiffness and the turn right would have no error."""
    config = replace(SMALL, stiffness_sd=0.5, turn_sd=0.3, common_sd=0.0, offset_sd=0.0)
    net = PopulationNet(("force",), config)
    episodes = population_fit._Episodes(net, rows, np.random.default_rng(0))
    truth = episodes.force[episodes.rows]  # (N, 32, 3)
    drawn: dict[str, torch.Tensor] = {}

    def code_of(presses: torch.Tensor) -> torch.Tensor:
        drawn["force"] = presses[..., 19:22]
        return torch.ones(len(presses), config.code)

    def taken(specimen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        few = episodes.rows[numbers[:, 0].long(), :30].reshape(-1, 10, 3)
        return few, torch.ones(len(few), 10, dtype=torch.bool)

    def perfect(inputs: torch.Tensor) -> torch.Tensor:
        plain = truth[numbers[:, 0].long()]
        given, seen = plain[:, :30], drawn["force"]
        # What the presses were turned into tells the map, a mirror image and all.
        estimate: torch.Tensor = plain @ torch.linalg.lstsq(given, seen).solution
        return estimate

    numbers = torch.arange(40).float()[:, None]
    monkeypatch.setattr(net, "code_of", code_of)
    monkeypatch.setattr(net, "one_sided", perfect)
    monkeypatch.setattr(episodes, "_presses", taken)
    # Presses are at other points than the last two rows of a block, which so are told them.
    episodes.point = torch.arange(len(episodes.point)) + 10**6
    episodes.point[episodes.rows[:40, :30].flatten()] *= -1
    back = episodes(numbers).reshape(40, 32, 3)
    np.testing.assert_allclose(back[:, 30:].numpy(), truth[:40, 30:].numpy(), atol=2e-3)
