"""The networks learn what they are shown, stay silent untouched, and ship as checked bundles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import read_bundle
from palpate_training.cli.train import BLOCKS, EPOCHS, GAIN_SPREAD, WIDTH
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning import export
from palpate_training.learning.export import onnx_bytes, run_onnx
from palpate_training.learning.graphs import FieldGraph, SynthesisGraph
from palpate_training.learning.splits import RowSplit, by_trajectory, of_units
from palpate_training.tasks.features import FEATURES_CONFIG
from palpate_training.tasks.fields import (
    FieldFitConfig,
    FieldModel,
    field_bundle,
    fit_field,
    tared_counts,
)
from palpate_training.tasks.synthesis import (
    SynthesisModel,
    fit_synthesis,
    synthesis_bundle,
    synthesis_features,
)


@pytest.fixture(scope="module")
def held(mixed: MixedDataset) -> RowSplit:
    return of_units(mixed.experiment, by_trajectory(mixed.experiment), ["biotac-1"])


@pytest.fixture(scope="module")
def model(mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig) -> FieldModel:
    return fit_field(mixed, held, config=quick)


@pytest.fixture(scope="module")
def synthesis(mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig) -> SynthesisModel:
    return fit_synthesis(mixed, held, config=quick)


@dataclass(frozen=True)
class Bundled:
    """A bundle of fields: its folder, the metrics, and how many epochs were told."""

    folder: Path
    metrics: dict[str, float]
    epochs: int


@pytest.fixture(scope="module")
def bundled(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path_factory: pytest.TempPathFactory
) -> Bundled:
    folder, epochs = tmp_path_factory.mktemp("fields") / "f", []
    metrics = field_bundle(
        mixed, folder, name="field-test", config=quick, on_epoch=lambda: epochs.append(1)
    )
    return Bundled(folder, metrics, len(epochs))


def test_field_network_beats_the_mean_and_repeats(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig, model: FieldModel
) -> None:
    counts, test = tared_counts(mixed), held.test
    truth = mixed.displacement(test)
    error = np.linalg.norm(model.code.decode(model.coefficients(counts[test])) - truth, axis=2)
    mean = np.linalg.norm(mixed.displacement(held.train).mean(axis=0) - truth, axis=2)
    assert error.mean() < 0.6 * mean.mean()
    again = fit_field(mixed, held, config=quick)
    np.testing.assert_array_equal(again.coefficients(counts), model.coefficients(counts))
    other = fit_field(mixed, held, config=quick, seed=1)
    assert not np.array_equal(other.coefficients(counts), model.coefficients(counts))


def test_untouched_electrodes_give_no_field(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig, model: FieldModel
) -> None:
    def untouched(fitted: FieldModel) -> float:
        field = fitted.code.decode(fitted.coefficients(np.zeros((1, 19), np.float32)))
        return float(np.linalg.norm(field, axis=2).mean())

    moved = np.linalg.norm(mixed.displacement(held.test), axis=2).mean()
    without = fit_field(mixed, held, config=replace(quick, rest_share=0.0))
    assert untouched(model) < 0.1 * moved
    assert untouched(model) < untouched(without)


def test_standardisation_comes_from_the_training_rows(
    mixed: MixedDataset, held: RowSplit, model: FieldModel
) -> None:
    counts = tared_counts(mixed)[held.train]
    assert np.abs(counts).max() > 500, "counts, not parts of full scale"
    inputs = model.net.inputs.of(np.vstack([counts, counts[:, ELECTRODE_MIRROR]]))
    for member in model.net.nets:
        mean = member.get_buffer("input_mean").numpy()
        np.testing.assert_allclose(mean, inputs.mean(axis=0), rtol=1e-4)


def test_synthesis_follows_the_film(
    mixed: MixedDataset, held: RowSplit, synthesis: SynthesisModel
) -> None:
    fitted = synthesis
    x, y = synthesis_features(mixed, fitted.code, fitted.pooling), tared_counts(mixed)
    test, train = held.test, held.train
    residual = fitted.counts(x[test]) - y[test]
    rival = y[train].mean(axis=0) - y[test]
    assert np.sqrt(np.mean(residual**2)) < 0.5 * np.sqrt(np.mean(rival**2))


def test_small_modes_are_not_blown_up(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig
) -> None:
    net = fit_synthesis(mixed, held, config=replace(quick, epochs=1)).net
    sd = net.nets[0].get_buffer("input_sd").numpy()
    modes, film = sd[: net.modes], sd[net.modes :]
    assert modes.min() == pytest.approx(0.1 * modes.max())
    assert film.min() < 0.1 * modes.max()


def test_graphs_compute_what_the_models_do(
    mixed: MixedDataset, held: RowSplit, model: FieldModel, synthesis: SynthesisModel
) -> None:
    counts, rows = tared_counts(mixed), held.test[:5]
    sd = np.arange(len(mixed.mesh.nodes), dtype=np.float32)
    with torch.inference_mode():
        field, spread, coefficients = FieldGraph(model.net, model.code, sd)(
            torch.from_numpy(counts[rows])
        )
    wanted = model.code.decode(model.coefficients(counts[rows])).reshape(5, -1)
    np.testing.assert_allclose(field.numpy(), wanted, atol=1e-6 * np.abs(wanted).max())
    np.testing.assert_array_equal(spread.numpy(), np.tile(sd, (5, 1)))
    modes = model.code.modes.astype(np.float32)
    decoded = coefficients.numpy() @ modes + model.code.mean
    np.testing.assert_allclose(decoded, wanted, atol=1e-6 * np.abs(wanted).max())

    fitted = synthesis
    graph = SynthesisGraph(fitted.net, fitted.code, fitted.pooling, np.ones(19, np.float32))
    flat = torch.from_numpy(mixed.displacement(rows).reshape(5, -1))
    with torch.inference_mode():
        answer = graph(flat)[0].numpy()
    features = synthesis_features(mixed, fitted.code, fitted.pooling)[rows]
    np.testing.assert_allclose(answer, fitted.counts(features), atol=0.5)


def test_field_bundle(mixed: MixedDataset, quick: FieldFitConfig, bundled: Bundled) -> None:
    metrics, bundle = bundled.metrics, read_bundle(bundled.folder)
    assert bundled.epochs == quick.members * quick.epochs
    assert bundle.manifest.task == "field"
    assert "biotac-1, biotac-2" in bundle.manifest.trained_on
    assert metrics["skill_subset"] > 0.3
    assert metrics["nodal_subset_m"] < metrics["zero_nodal_subset_m"]
    assert bundle.manifest.metrics["parity_max"] < export.PARITY_MAX
    assert bundle.mesh is not None
    np.testing.assert_allclose(bundle.mesh.nodes, mixed.mesh.nodes, atol=1e-9)
    assert bundle.mesh.sha256.hex() == mixed.mesh.sha256
    nodes = len(mixed.mesh.nodes)
    assert bundle.golden["displacement"].shape == (4, 3 * nodes)
    assert bundle.golden["displacement_sd"].shape == (4, nodes)
    assert (bundle.golden["displacement_sd"] > 0).all()
    session = onnxruntime.InferenceSession(bundle.model, providers=["CPUExecutionProvider"])
    (field,) = session.run(["displacement"], {"electrodes": bundle.golden["electrodes"][:1]})
    scale = np.abs(field).max()
    np.testing.assert_allclose(field, bundle.golden["displacement"][:1], atol=1e-5 * scale)
    with pytest.raises(BundleError, match="immutable"):
        field_bundle(mixed, bundled.folder, config=quick)


def test_field_bundle_has_its_basis_and_knows_its_rows(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig, bundled: Bundled
) -> None:
    bundle = read_bundle(bundled.folder)
    constants = {
        one.name: onnx.numpy_helper.to_array(one).astype(np.float32)
        for one in onnx.load_from_string(bundle.model).graph.initializer
    }
    basis = {name: constants[where] for name, where in bundle.manifest.basis.items()}
    decoded = basis["mean"] + bundle.golden["coefficients"] @ basis["modes"]
    wanted = bundle.golden["displacement"]
    np.testing.assert_allclose(decoded, wanted, atol=1e-5 * np.abs(wanted).max())

    known, rows = bundle.known_inputs, bundle.manifest.training_range
    assert known is not None
    assert rows is not None
    units = of_units(mixed.experiment, by_trajectory(mixed.experiment), ["biotac-1", "biotac-2"])
    seen = tared_counts(mixed)[units.train]
    compressed = np.arcsinh(seen / known.scale)
    nearest = np.linalg.norm(compressed[:, None] - known.prototypes[None], axis=2).min(axis=1)
    assert nearest.max() <= known.distance_max  # no training row is unlike the training rows
    (electrodes,) = rows.inputs
    assert (seen >= np.array(electrodes.low) - 0.01).all()
    assert (seen <= np.array(electrodes.high) + 0.01).all()
    (displacement,) = rows.outputs
    longest = np.linalg.norm(mixed.displacement(units.train), axis=2).max()
    assert displacement.length_max == pytest.approx(longest, rel=1e-5)
    assert rows.rows == len(units.train) + quick.rest_rows(len(units.train))


def test_synthesis_bundle_is_of_one_unit(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    metrics = synthesis_bundle(mixed, tmp_path / "s", unit="biotac-2", config=quick)
    bundle = read_bundle(tmp_path / "s")
    assert bundle.manifest.task == "synthesis"
    assert ": biotac-2;" in bundle.manifest.trained_on
    assert metrics["skill_rmse"] > 0.5
    known = bundle.manifest.training_range
    assert known is not None
    assert [one.name for one in (*known.inputs, *known.outputs)] == ["displacement", "tared_counts"]
    assert not known.combinations
    assert metrics["untouched_max_counts"] < 100
    split = by_trajectory(mixed.experiment)
    rows = of_units(mixed.experiment, split, ["biotac-2"])
    session = onnxruntime.InferenceSession(bundle.model, providers=["CPUExecutionProvider"])
    residual = {}
    for side, chosen in (("test", rows.test), ("validation", rows.validation)):
        flat = mixed.displacement(chosen).reshape(len(chosen), -1)
        counts, sd = session.run(["tared_counts", "tared_counts_sd"], {"displacement": flat})
        residual[side] = counts - tared_counts(mixed)[chosen]
    rmse = float(np.sqrt(np.mean(residual["test"] ** 2)))
    assert metrics["electrode_rmse_counts"] == pytest.approx(rmse, rel=0.01)
    wanted = np.sqrt(np.mean(residual["validation"] ** 2, axis=0))
    np.testing.assert_allclose(sd, np.tile(wanted, (len(sd), 1)), rtol=0.02)
    with pytest.raises(DatasetError, match="no unit biotac-5"):
        synthesis_bundle(mixed, tmp_path / "t", unit="biotac-5", config=quick)


def test_modes_are_stored_in_half_precision(model: FieldModel, mixed: MixedDataset) -> None:
    wide = 4000  # below some size the exporter folds constants; real skins are above it
    code = replace(
        model.code,
        modes=np.resize(model.code.modes, (model.code.size, wide * 3)),
        mean=np.resize(model.code.mean, wide * 3),
    )
    graph = FieldGraph(model.net, code, np.ones(wide, np.float32))
    data = onnx_bytes(graph, "electrodes", torch.zeros(4, 19), ["displacement", "sd", "k"])
    stored = {
        tuple(one.dims): one.data_type for one in onnx.load_from_string(data).graph.initializer
    }
    assert stored[code.size, wide * 3] == onnx.TensorProto.FLOAT16
    assert len(data) < 2.5 * code.modes.size + 16 * wide + 400_000


def test_a_model_that_differs_is_refused(
    model: FieldModel, mixed: MixedDataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sd = np.ones(len(mixed.mesh.nodes), np.float32)
    scaled = replace(model.code, scale=model.code.scale * np.float32(1.001))
    names = ["displacement", "displacement_sd", "coefficients"]
    wrong = onnx_bytes(FieldGraph(model.net, scaled, sd), "electrodes", torch.zeros(4, 19), names)
    monkeypatch.setattr(export, "onnx_bytes", lambda *_: wrong)
    with pytest.raises(BundleError, match=r"differs from torch by .* in displacement"):
        export.export_fields(
            tmp_path / "b",
            FieldGraph(model.net, model.code, sd),
            tared_counts(mixed)[:6],
            mixed.mesh,
            name="wrong",
            version=1,
            training_data_sha256="0" * 64,
            trained_on="a test",
            metrics={},
            normalisation={},
        )
    assert not list(tmp_path.iterdir())


def test_a_test_row_is_never_trained_on(
    make_mixed: Callable[..., MixedDataset], quick: FieldFitConfig
) -> None:
    data = make_mixed(units=1, trajectories=10, steps=5)
    held = of_units(data.experiment, by_trajectory(data.experiment), ["biotac-1"])
    tared = data.experiment.tared.copy()
    tared[held.test] *= -3
    coefficients = data.coefficients.copy()
    coefficients[held.test] += 1
    changed = replace(
        data, experiment=replace(data.experiment, tared=tared), coefficients=coefficients
    )
    config = replace(quick, epochs=3)
    for fit in (fit_field, fit_synthesis):
        first, second = fit(data, held, config=config), fit(changed, held, config=config)
        for one, two in zip(first.net.parameters(), second.net.parameters(), strict=True):
            assert torch.equal(one, two)


def test_mirrored_electrodes_give_the_mirrored_field(
    mixed: MixedDataset, held: RowSplit, model: FieldModel
) -> None:
    counts = tared_counts(mixed)[held.test]
    even = model.net.inputs.rest
    assert torch.equal(even, even[torch.from_numpy(ELECTRODE_MIRROR).long()])
    estimate = model.coefficients(counts)
    image = model.coefficients(np.ascontiguousarray(counts[:, ELECTRODE_MIRROR]))
    signs = model.code.signs
    assert signs is not None
    np.testing.assert_allclose(image, estimate * signs, atol=1e-4 * np.abs(estimate).max())


def test_unknown_untouched_counts_are_assumed(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig
) -> None:
    """The published files do not hold them."""
    unknown = np.full_like(mixed.experiment.trial_rest, np.nan)
    data = replace(mixed, experiment=replace(mixed.experiment, trial_rest=unknown))
    config = replace(quick, members=1, epochs=2)
    assert np.isfinite(fit_field(data, held, config=config).coefficients(tared_counts(data))).all()
    fitted = fit_synthesis(data, held, config=config)
    features = synthesis_features(data, fitted.code, fitted.pooling)
    assert np.isfinite(fitted.counts(features)).all()


def test_the_command_has_the_defaults_of_the_configuration() -> None:
    assert FieldFitConfig().epochs == EPOCHS
    assert FEATURES_CONFIG.epochs == EPOCHS
    assert FieldFitConfig().gain_spread == GAIN_SPREAD
    assert FEATURES_CONFIG.gain_spread == GAIN_SPREAD
    assert (FEATURES_CONFIG.width, FEATURES_CONFIG.blocks) == (WIDTH, BLOCKS)


def test_synthesis_in_a_batch_has_the_bits_of_single_rows(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig
) -> None:
    """Exponentials of rows of 19 would not have them."""
    fitted = fit_synthesis(mixed, held, config=replace(quick, epochs=1))
    graph = SynthesisGraph(fitted.net, fitted.code, fitted.pooling, np.ones(19, np.float32))
    width = 3 * fitted.code.nodes
    model = onnx_bytes(graph, "displacement", torch.zeros(4, width), ["tared_counts", "sd"])
    rows = mixed.displacement(np.arange(200)).reshape(200, -1)
    together, alone = run_onnx(model, "displacement", rows)
    assert together[0].tobytes() == alone[0].tobytes()
