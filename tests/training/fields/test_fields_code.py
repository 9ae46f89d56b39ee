"""Modes of the training rows, and the film that is pooled near the electrodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.anatomy import CORE_RADIUS_M, core_normal
from palpate.errors import DatasetError
from palpate_training.datasets.experiment import MixedDataset
from palpate_training.learning.field_code import FieldCode, fit_code, mirror_nodes, mirrored
from palpate_training.learning.film import MIRRORED_FILM, RADII_M, SITES, pooling
from palpate_training.learning.splits import RowSplit, by_trajectory
from palpate_training.tasks.synthesis import synthesis_features


@pytest.fixture(scope="module")
def split(mixed: MixedDataset) -> RowSplit:
    return by_trajectory(mixed.experiment)


@pytest.fixture(scope="module")
def code(mixed: MixedDataset, split: RowSplit) -> FieldCode:
    return fit_code(mixed, split.train, split.validation, limit_m=2e-6)


def test_modes_are_orthonormal_and_carry_the_nodal_norm(
    mixed: MixedDataset, split: RowSplit, code: FieldCode
) -> None:
    modes = code.modes.astype(float) * code.scale[:, None]
    np.testing.assert_allclose(modes @ modes.T, np.eye(code.size), atol=2e-3)  # half precision
    assert np.abs(code.modes.astype(float)).max(axis=1) == pytest.approx(1, abs=1e-3)
    rows = split.test[::7]
    difference = np.random.default_rng(0).normal(0, 1e-3, (len(rows), code.size))
    base = code.encode(mixed.coefficients[rows])
    moved = code.decode(base + difference) - code.decode(base)
    nodal = np.sqrt(np.mean(np.sum(np.square(moved, dtype=float), axis=2), axis=1))
    wanted = np.linalg.norm(difference, axis=1) / np.sqrt(code.nodes)
    np.testing.assert_allclose(nodal, wanted, rtol=3e-3)


def test_projection_of_a_field_is_its_code(
    mixed: MixedDataset, split: RowSplit, code: FieldCode
) -> None:
    rows = split.test[::5]
    known = code.encode(mixed.coefficients[rows])
    flat = mixed.displacement(rows).reshape(len(rows), -1)
    np.testing.assert_allclose(code.project(flat), known, atol=2e-3 * np.abs(known).max())


def test_truncation_falls_and_the_fewest_modes_are_taken(
    mixed: MixedDataset, split: RowSplit, code: FieldCode
) -> None:
    lost = code.truncation_m
    assert list(lost) == sorted(lost)
    assert list(lost.values()) == sorted(lost.values(), reverse=True)
    assert code.size == max(lost)
    assert all(value > 2e-6 for count, value in lost.items() if count < code.size)
    few = fit_code(mixed, split.train, split.validation, mode_counts=(4,))
    rows = split.validation
    decoded = few.decode(few.encode(mixed.coefficients[rows]))
    distance = np.linalg.norm(decoded - mixed.displacement(rows), axis=2).mean()
    assert few.truncation_m == pytest.approx({4: distance}, rel=0.1)


def test_held_out_rows_shape_no_mode(mixed: MixedDataset, split: RowSplit, code: FieldCode) -> None:
    changed = mixed.coefficients.copy()
    changed[split.test] *= 5
    changed[split.validation[1:]] += 1
    other = fit_code(
        replace(mixed, coefficients=changed), split.train, split.validation[:1], limit_m=2e-6
    )
    shared = min(code.size, other.size)
    np.testing.assert_array_equal(other.modes[:shared], code.modes[:shared])
    np.testing.assert_array_equal(other.mean, code.mean)


def test_a_skin_that_never_moves_is_refused(mixed: MixedDataset, split: RowSplit) -> None:
    still = replace(mixed, coefficients=np.zeros_like(mixed.coefficients))
    with pytest.raises(DatasetError, match="are the same"):
        fit_code(still, split.train, split.validation)


def test_core_normal_is_radial() -> None:
    points = np.array([[-5e-3, 3e-3, -4e-3], [3e-3, 0.0, -4e-3]])
    np.testing.assert_allclose(core_normal(points), [[0, 0.6, -0.8], [0.6, 0, -0.8]])


def test_every_site_lies_on_the_core() -> None:
    assert SITES.shape == (23, 3)
    feet = CORE_RADIUS_M * core_normal(SITES)
    feet[:, 0] += np.minimum(SITES[:, 0], 0)
    above = np.linalg.norm(SITES - feet, axis=1)
    tip = [6, 7, 8, 9]
    assert np.delete(above, tip).max() < 1e-6
    assert above[tip].max() < 0.57e-3


def test_pooling_tells_the_film_below_an_even_press(mixed: MixedDataset) -> None:
    film = pooling(mixed.mesh)
    np.testing.assert_allclose(film.weights.sum(axis=0), 1, rtol=1e-5)
    np.testing.assert_allclose(film.rest_m, 6.4e-3 - CORE_RADIUS_M, rtol=1e-3)
    even = -0.5e-3 * core_normal(mixed.mesh.nodes)[None]
    np.testing.assert_allclose(film.pool(even), -0.5e-3, rtol=1e-4)
    sideways = np.cross(core_normal(mixed.mesh.nodes), [1.0, 0.0, 0.0])[None]
    assert np.abs(film.pool(sideways)).max() < 1e-5, "sliding along the core opens no gap"


def test_pooling_looks_near_its_own_electrode(mixed: MixedDataset) -> None:
    film = pooling(mixed.mesh)
    e18 = np.array([-9.8e-3, 0, -6.4e-3])
    near = np.linalg.norm(mixed.mesh.nodes - e18, axis=1) < 2.5e-3
    dented = np.zeros((1, len(near), 3))
    dented[0, near, 2] = 1e-3  # dorsal: towards the core
    change = film.pool(dented).reshape(23, len(RADII_M))
    assert (change <= 0).all()
    assert change[:, 1].argmin() == 17
    assert change[6].max() == 0, "E7 at the tip is far away"


def test_features_are_what_the_fields_give(
    mixed: MixedDataset, split: RowSplit, code: FieldCode
) -> None:
    film = pooling(mixed.mesh)
    rows = split.test[::9]
    field = mixed.displacement(rows)
    direct = np.hstack([code.project(field.reshape(len(rows), -1)), film.pool(field)])
    np.testing.assert_allclose(
        synthesis_features(mixed, code, film)[rows], direct, atol=1e-5 * np.abs(direct).max()
    )


def test_a_mesh_without_inside_is_refused(mixed: MixedDataset) -> None:
    with pytest.raises(DatasetError, match="no inner faces"):
        pooling(replace(mixed.mesh, inner_faces=np.zeros((0, 3), np.int32)))


def test_a_mirrored_field_has_the_same_coefficients_but_for_signs(
    mixed: MixedDataset, split: RowSplit, code: FieldCode
) -> None:
    order, signs = mirror_nodes(mixed.mesh), code.signs
    assert order is not None
    assert signs is not None
    assert set(signs.tolist()) == {1.0, -1.0}
    rows = split.train[::9]
    flat = mixed.displacement(rows).reshape(len(rows), -1)
    image = mirrored(flat.astype(float), order)
    np.testing.assert_allclose(mirrored(image, order), flat, atol=1e-12)
    wanted = code.project(flat) * signs
    error = np.abs(code.project(image.astype(np.float32)) - wanted).max()
    assert error < 0.03 * np.abs(wanted).max()


def test_a_lopsided_mesh_has_no_mirror_image(mixed: MixedDataset, split: RowSplit) -> None:
    nodes = mixed.mesh.nodes.copy()
    nodes[5, 1] += 1e-4
    lopsided = replace(mixed, mesh=replace(mixed.mesh, nodes=nodes))
    assert mirror_nodes(lopsided.mesh) is None
    code = fit_code(lopsided, split.train, split.validation, mode_counts=(4,))
    assert code.signs is None
    known = mixed.coefficients[split.train].astype(float)
    np.testing.assert_allclose(code.centre, known.mean(axis=0), atol=1e-9)


def test_the_film_of_a_mirrored_field_is_the_mirrored_film(
    mixed: MixedDataset, split: RowSplit
) -> None:
    film, order = pooling(mixed.mesh), mirror_nodes(mixed.mesh)
    assert order is not None
    field = mixed.displacement(split.test[:5]).astype(float)
    image = mirrored(field.reshape(5, -1), order).reshape(field.shape)
    np.testing.assert_allclose(film.pool(image), film.pool(field)[:, MIRRORED_FILM], atol=2e-7)
