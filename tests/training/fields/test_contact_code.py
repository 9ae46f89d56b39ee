"""Contact forces: spread over the skin without being lost or moved, learned, and shipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.errors import DatasetError
from palpate.files.bundle import read_bundle
from palpate_services.inference.model import load
from palpate_training.datasets.experiment import FieldBasis, MixedDataset, SimulatedContact
from palpate_training.learning.contact_code import (
    ContactCode,
    contact_coefficients,
    fit_contact_code,
    spread_forces,
    spreading,
)
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.field_code import mirror_nodes
from palpate_training.learning.graphs import FieldGraph
from palpate_training.learning.splits import RowSplit, by_trajectory, of_units
from palpate_training.tasks.fields import (
    FieldFitConfig,
    FieldModel,
    field_bundle,
    fit_field,
    tared_counts,
)


@pytest.fixture(scope="module")
def pressed(mixed: MixedDataset) -> MixedDataset:
    """The invented presses, with the force of each on the few nodes next to its centre."""
    outer = mixed.mesh.outer_nodes
    place = mixed.mesh.nodes[outer]
    data = mixed.experiment
    away = np.square(place[None] - data.location[:, None]).sum(axis=2)
    share = np.exp(-0.5 * away / 0.8e-3**2)
    share /= share.sum(axis=1, keepdims=True)
    flat = (share[:, :, None] * data.force[:, None].astype(np.float64)).reshape(len(data), -1)
    mean = flat.mean(axis=0)
    modes = np.linalg.svd(flat - mean, full_matrices=False)[2][:25]
    contact = SimulatedContact(
        centre=data.location,
        normal=np.tile(np.array([[0, 0, -1]], np.float32), (len(data), 1)),
        coefficients=((flat - mean) @ modes.T).astype(np.float32),
        basis=FieldBasis(
            mean.reshape(-1, 3).astype(np.float32),
            modes.reshape(len(modes), -1, 3).astype(np.float32),
            1e-4,
            1e-3,
        ),
    )
    return replace(mixed, contact=contact)


@pytest.fixture(scope="module")
def held(pressed: MixedDataset) -> RowSplit:
    return of_units(pressed.experiment, by_trajectory(pressed.experiment), ["biotac-1"])


@pytest.fixture(scope="module")
def code(pressed: MixedDataset, held: RowSplit) -> ContactCode:
    return fit_contact_code(pressed, held.train)


@pytest.fixture(scope="module")
def model(pressed: MixedDataset, held: RowSplit, quick: FieldFitConfig) -> FieldModel:
    return fit_field(pressed, held, config=replace(quick, epochs=60))


def _centre(forces: npt.NDArray[np.floating], data: MixedDataset) -> npt.NDArray[np.float64]:
    """Where the forces are, by their size, shape (N, 3)."""
    size = np.linalg.norm(forces, axis=2)
    place = data.mesh.nodes[data.mesh.outer_nodes]
    return np.asarray(size @ place / size.sum(axis=1, keepdims=True), np.float64)


def test_spreading_keeps_the_net_force_and_the_place(pressed: MixedDataset) -> None:
    """Also the part of the net force that the data set's own modes have lost."""
    rows = np.arange(0, len(pressed), 7)
    spread = spread_forces(pressed, rows)
    np.testing.assert_allclose(spread.sum(axis=1), pressed.simulated_force[rows], atol=1e-5)
    assert pressed.contact is not None
    stored = pressed.contact.basis.decode(pressed.contact.coefficients[rows])
    lost = np.linalg.norm(stored.sum(axis=1) - pressed.simulated_force[rows], axis=1)
    assert lost.max() > 1e-3
    moved = np.linalg.norm(_centre(spread, pressed) - pressed.experiment.location[rows], axis=1)
    assert np.median(moved) < 0.7e-3
    # It is flatter: no node bears as much as before.
    assert np.all(np.abs(spread).max(axis=(1, 2)) < np.abs(stored).max(axis=(1, 2)))


def test_each_force_goes_to_its_neighbourhood_by_area(pressed: MixedDataset) -> None:
    weights = spreading(pressed.mesh)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0)
    assert weights.min() >= 0.0
    place = pressed.mesh.nodes[pressed.mesh.outer_nodes]
    far = np.linalg.norm(place[:, None] - place[None], axis=2) > 8e-3
    assert weights[far].max() < 1e-4


def test_modes_keep_the_forces_of_training_rows(
    pressed: MixedDataset, held: RowSplit, code: ContactCode
) -> None:
    truth = spread_forces(pressed, held.train)
    left = code.decode(contact_coefficients(pressed, code)[held.train]) - truth
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(truth)
    assert code.modes.dtype == np.float16
    assert float(np.abs(code.modes).max()) == 1.0


def test_a_mirrored_force_has_the_same_coefficients_but_for_signs(
    pressed: MixedDataset, held: RowSplit, code: ContactCode
) -> None:
    image = mirror_nodes(pressed.mesh)
    assert image is not None
    assert code.signs is not None
    forces = spread_forces(pressed, held.test)
    mirrored = forces[:, np.searchsorted(code.outer, image[code.outer])] * MIRROR_AXES
    wanted = code.encode(forces) * code.signs
    np.testing.assert_allclose(code.encode(mirrored), wanted, atol=2e-3 * np.abs(wanted).max())


def test_forces_of_unseen_presses_are_learned(
    pressed: MixedDataset, held: RowSplit, model: FieldModel
) -> None:
    counts = tared_counts(pressed)
    truth = spread_forces(pressed, held.test)
    estimate = model.contact_forces(counts[held.test])
    mean = spread_forces(pressed, held.train).mean(axis=0)
    error = np.linalg.norm(estimate - truth, axis=2).sum(axis=1)
    assert error.mean() < 0.6 * np.linalg.norm(mean - truth, axis=2).sum(axis=1).mean()
    # Untouched electrodes: nothing touches.
    still = model.contact_forces(np.zeros((1, 19), np.float32))
    largest = np.linalg.norm(truth.sum(axis=1), axis=1).max()
    assert np.linalg.norm(still.sum(axis=1)) < 0.1 * largest
    mirrored = model.contact_forces(np.ascontiguousarray(counts[held.test][:, ELECTRODE_MIRROR]))
    net = estimate.sum(axis=1) * MIRROR_AXES
    np.testing.assert_allclose(mirrored.sum(axis=1), net, atol=0.01 * np.abs(net).max())


def test_the_graph_puts_forces_on_the_outer_nodes_alone(
    pressed: MixedDataset, held: RowSplit, model: FieldModel
) -> None:
    assert model.contact is not None
    counts = tared_counts(pressed)[held.test[:5]]
    sd = np.ones(len(pressed.mesh.nodes), np.float32)
    graph = FieldGraph(model.net, model.code, sd, model.contact).eval()
    with torch.inference_mode():
        field, _, force, coefficients = graph(torch.from_numpy(counts))
    whole = force.numpy().reshape(len(counts), -1, 3)
    outer = pressed.mesh.outer_nodes
    np.testing.assert_allclose(whole[:, outer], model.contact_forces(counts), atol=1e-5)
    assert not np.delete(whole, outer, axis=1).any()
    assert field.shape == force.shape
    assert coefficients.shape[1] == model.code.size


def test_a_bundle_carries_them_and_says_how_good_they_are(
    pressed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    short = replace(quick, epochs=10)
    metrics = field_bundle(pressed, tmp_path / "b", units=["biotac-1"], config=short)
    bundle = read_bundle(tmp_path / "b")
    names = [one.name for one in bundle.manifest.outputs]
    assert names == ["displacement", "displacement_sd", "contact_force", "coefficients"]
    assert 0.0 < metrics["contact_misplaced"] < 1.0
    assert metrics["contact_misplaced_2_to_8n"] <= 1.0
    assert bundle.manifest.training_range is not None
    displacement, contact = bundle.manifest.training_range.outputs
    assert (displacement.name, contact.name, contact.unit) == ("displacement", "contact_force", "N")
    rows = of_units(pressed.experiment, by_trajectory(pressed.experiment), ["biotac-1"]).train
    longest = np.linalg.norm(spread_forces(pressed, rows), axis=2).max()
    assert contact.length_max == pytest.approx(longest, rel=1e-5)
    outputs = load(bundle, "field").run(tared_counts(pressed)[0])
    assert outputs is not None
    assert outputs["contact_force"].shape[-1] == 3 * len(pressed.mesh.nodes)


def test_a_data_set_without_contacts_is_refused_or_left_without(
    mixed: MixedDataset, held: RowSplit, quick: FieldFitConfig
) -> None:
    with pytest.raises(DatasetError, match="no contact forces"):
        fit_contact_code(mixed, held.train)
    without = fit_field(mixed, held, config=replace(quick, epochs=1))
    assert without.contact is None
    assert without.net.signs.shape[1] == without.code.size


def test_a_data_set_in_which_nothing_touches_is_refused(
    pressed: MixedDataset, held: RowSplit
) -> None:
    assert pressed.contact is not None
    basis = replace(pressed.contact.basis, mean=np.zeros_like(pressed.contact.basis.mean))
    silent = replace(
        pressed,
        contact=replace(
            pressed.contact, coefficients=0 * pressed.contact.coefficients, basis=basis
        ),
    )
    with pytest.raises(DatasetError, match="no training row has a contact force"):
        fit_contact_code(silent, held.train)
