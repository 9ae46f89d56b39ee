"""One network for a population: invented specimens whose electrodes differ by their gain."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.training.invented_population import PRESSES, SMALL, population
from typer.testing import CliRunner

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import BundleError, ConfigError, DatasetError
from palpate_training.cli import train_app
from palpate_training.datasets.features import FeatureDataset, write_dataset
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.networks import predict
from palpate_training.learning.population_fit import fit_population
from palpate_training.learning.population_net import (
    WEIGHTS,
    CountsGraph,
    PopulationNet,
    inputs_of,
    load_population_net,
    save_population_net,
)
from palpate_training.learning.told_finger import REPORT
from palpate_training.tasks.population import (
    ONNX,
    fingertips_of,
    points_of,
    rows_of,
    split_population,
    stop_rows,
    train_population,
)


@pytest.fixture(scope="module")
def data() -> FeatureDataset:
    return population(gain_sd=0.05)


@pytest.fixture(scope="module")
def stored(data: FeatureDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("population") / "features.h5"
    write_dataset(path, data)
    return path


@pytest.fixture(scope="module")
def folder(stored: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    train_population(stored, out, config=SMALL, device="cpu")
    return out


def test_learns_presses_and_specimens_that_are_alike(folder: Path) -> None:
    cells = json.loads((folder / REPORT).read_text())["cells"]
    assert len(cells) == 4
    for name, cell in cells.items():
        mine = cell["network"]["force_magnitude_n"]
        assert 0.0 < cell["ridge"]["force_magnitude_n"]
        assert mine < 0.3 * cell["constant"]["force_magnitude_n"], name
        low, high = cell["network"]["ci95"]["force_magnitude_n"]
        assert low <= mine <= high


def test_without_the_common_mode_an_offset_of_all_electrodes_changes_nothing(
    data: FeatureDataset,
) -> None:
    inputs = inputs_of(data.electrodes, data.baseline)
    moved = inputs + np.float32(0.05)
    for common, alike in ((0.0, True), (1.0, False)):
        net = PopulationNet(("force",), replace(SMALL, common=common))
        same = np.allclose(predict(net, moved), predict(net, inputs), atol=1e-5)
        assert same is alike


def test_no_specimen_and_no_point_is_on_two_sides(data: FeatureDataset) -> None:
    twins = data.group // 2  # two presses of one point follow one another
    at = np.zeros((len(data), 3), np.float32)
    at[:, 0] = 0.01 * twins
    paired = replace(data, contact_location=at)
    split = split_population(paired, seed=3)
    cells = split.cells
    stopped = np.logical_or.reduce(split.validation)
    for one in (split.train, stopped):
        for other in ("seen_specimen_unseen_press", "unseen_specimen_unseen_press"):
            assert not set(twins[one]) & set(twins[cells[other]])
        for other in ("unseen_specimen_seen_press", "unseen_specimen_unseen_press"):
            assert not set(data.sensor[one]) & set(data.sensor[cells[other]])
    assert not set(twins[split.train]) & set(twins[stopped])
    unseen = set(data.sensor[cells["unseen_specimen_seen_press"]])
    assert {data.sensor_names[number] for number in unseen} <= set(split.specimens)


def test_presses_without_location_are_points_of_their_own(data: FeatureDataset) -> None:
    blind = replace(data, contact_location=None, in_contact=None)
    assert len(np.unique(points_of(blind))) == PRESSES


def test_a_mirrored_row_gets_the_mirrored_estimate(folder: Path, data: FeatureDataset) -> None:
    net = load_population_net(folder / WEIGHTS)
    rows = slice(0, 200)
    plain = inputs_of(data.electrodes[rows], data.baseline[rows])
    mirrored = inputs_of(
        data.electrodes[rows][:, ELECTRODE_MIRROR], data.baseline[rows][:, ELECTRODE_MIRROR]
    )
    signs = np.tile(MIRROR_AXES, len(net.quantities))
    np.testing.assert_allclose(predict(net, mirrored), predict(net, plain) * signs, atol=1e-5)


def test_saved_and_loaded_nets_agree(folder: Path, data: FeatureDataset, tmp_path: Path) -> None:
    net = load_population_net(folder / WEIGHTS)
    save_population_net(tmp_path / "again.npz", net)
    again = load_population_net(tmp_path / "again.npz")
    inputs = inputs_of(data.electrodes, data.baseline)
    np.testing.assert_array_equal(predict(again, inputs), predict(net, inputs))
    assert again.quantities == ("force", "contact_location")
    code = np.zeros((len(data), 2 * SMALL.code))
    counts = np.hstack([data.electrodes, data.baseline, code]).astype(np.float32)
    with torch.inference_mode():
        (shipped,) = (values.numpy() for values in CountsGraph(net)(torch.from_numpy(counts)))
    np.testing.assert_allclose(shipped, predict(net, inputs), rtol=1e-3, atol=1e-3)


def test_the_same_seed_gives_the_same_network(data: FeatureDataset) -> None:
    names, rows = rows_of(data)
    stop = [stop_rows(rows, np.ones(len(data), bool), seed=0)]
    first, second, other = (
        fit_population(rows, stop, names, config=replace(SMALL, epochs=1), seed=seed)
        for seed in (5, 5, 6)
    )
    for name, values in first.state_dict().items():
        assert torch.equal(values, second.state_dict()[name]), name
    assert not torch.equal(first.layers.head.weight, other.layers.head.weight)


def test_the_graph_is_as_exact_as_a_bundle(folder: Path) -> None:
    onnx = json.loads((folder / REPORT).read_text())["onnx"]
    assert onnx["parity_max"] < 1e-5
    assert onnx["milliseconds"] > 0.0
    assert (folder / ONNX).is_file()


def test_the_report_is_there_without_the_graph(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> float:
        raise BundleError("ONNX Runtime differs", remedy="none")

    monkeypatch.setattr("palpate_training.learning.export.check_parity", refuse)
    small = replace(SMALL, epochs=1, width=16)
    _, facts = train_population(stored, tmp_path, config=small, device="cpu")
    assert "ONNX Runtime differs" in facts["onnx"]["left out"]
    assert json.loads((tmp_path / REPORT).read_text()) == json.loads(json.dumps(facts))
    assert not (tmp_path / ONNX).exists()


def test_a_population_of_two_is_refused(data: FeatureDataset) -> None:
    few = replace(data, sensor=np.minimum(data.sensor, 1))
    with pytest.raises(DatasetError, match="2 specimens"):
        split_population(few, seed=0)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="palpate train population"):
        load_population_net(tmp_path / WEIGHTS)
    (tmp_path / WEIGHTS).write_bytes(b"no archive")
    with pytest.raises(DatasetError, match="not a readable NumPy archive"):
        load_population_net(tmp_path / WEIGHTS)
    save_population_net(tmp_path / WEIGHTS, PopulationNet(("force",), SMALL))
    with np.load(tmp_path / WEIGHTS) as file:
        arrays = {name: file[name] for name in file.files}
    arrays.pop("layers.head.weight")
    np.savez(tmp_path / WEIGHTS, **arrays)
    with pytest.raises(DatasetError, match="no network"):
        load_population_net(tmp_path / WEIGHTS)


def test_a_gpu_that_is_not_there_is_said(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="no GPU"):
        train_population(stored, tmp_path, config=SMALL, device="cuda")
    with pytest.raises(ConfigError, match="tpu"):
        train_population(stored, tmp_path, config=SMALL, device="tpu")


def test_targets_are_unknown_without_contact(data: FeatureDataset) -> None:
    names, rows = rows_of(data)
    assert names == ("force", "contact_location")
    assert data.in_contact is not None
    np.testing.assert_array_equal(np.isnan(rows.targets[:, 3]), ~data.in_contact)


def test_the_command_writes_report_and_weights(stored: Path, tmp_path: Path) -> None:
    arguments = ["population", str(stored), str(tmp_path), "--epochs", "1", "--width", "16"]
    result = CliRunner().invoke(train_app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "unseen specimen unseen press" in result.output
    assert load_population_net(tmp_path / WEIGHTS).config.width == 16


def test_where_fingertips_differ_some_are_never_met() -> None:
    """Ten skins of three specimens; each press is executed on two of one skin."""
    rng = np.random.default_rng(3)
    presses = [(skin, press) for skin in range(10) for press in range(8)]
    group = np.repeat(np.arange(len(presses)), 4)
    sensor = np.concatenate(
        [3 * skin + np.repeat(rng.choice(3, 2, replace=False), 2) for skin, _ in presses]
    )
    force = np.tile([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], (2 * len(presses), 1))
    one = replace(
        population(),
        electrodes=np.zeros((len(group), 19), np.uint16),
        baseline=np.full((len(group), 19), 2000.0, np.float32),
        force=force.astype(np.float32),
        group=group.astype(np.int32),
        block=group.astype(np.int32),
        sensor=sensor.astype(np.int32),
        sensor_names=tuple(f"unit-{number:03d}" for number in range(30)),
        contact_location=None,
        in_contact=None,
    )
    skin = fingertips_of(one)
    np.testing.assert_array_equal(np.unique(skin, return_inverse=True)[1], sensor // 3)
    split = split_population(one, seed=0)
    never = np.unique(skin[split.cells["unseen_specimen_unseen_press"]])
    assert len(never) == 2
    assert not np.isin(skin[~split.cells["unseen_specimen_unseen_press"]], never).any()
    # A specimen that is not met may have the skin of one that is.
    new = split.cells["unseen_specimen_seen_press"]
    assert not np.isin(one.sensor[split.train], one.sensor[new]).any()
    assert np.isin(skin[new], skin[split.train]).all()
    assert not np.isin(skin[split.train], skin[split.validation[1]]).any()
