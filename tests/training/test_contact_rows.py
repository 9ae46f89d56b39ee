"""How the indenter bears on the skin: centre of pressure, normal, nodal forces in a mixed set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate_training.datasets.assembly import assemble_mixed, contact_of, mix
from palpate_training.datasets.basis import fit_basis, subset
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    MixedDataset,
    SkinMesh,
    content_sha256,
    read_mixed,
    write_mixed,
)
from palpate_training.datasets.export import features
from palpate_training.datasets.trials import MixedRows, SimulatedTrial, TrialRows


def plane(count: int = 5) -> SkinMesh:
    """A flat skin of count x count nodes, 1 mm apart, whose outside is -z."""
    x, y = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    nodes = np.column_stack([1e-3 * x.ravel(), 1e-3 * y.ravel(), np.zeros(count**2)])
    number = np.arange(count**2).reshape(count, count)
    a, b, c, d = (
        number[i : count - 1 + i, j : count - 1 + j].ravel()
        for i, j in ((0, 0), (0, 1), (1, 1), (1, 0))
    )
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return SkinMesh(nodes, faces.astype(np.int32), faces[:1].astype(np.int32),
                    np.arange(4, dtype=np.int32), "plane")  # fmt: skip


def test_centre_and_normal_of_a_flat_press() -> None:
    mesh = plane()
    force = np.zeros((1, 25, 3), np.float32)
    force[0, 6] = (0.4, 0.0, 1.0)  # with friction, which moves neither
    force[0, 18] = (0.0, -0.7, 3.0)
    moved = np.zeros((1, 25, 3), np.float32)
    moved[0, :, 2] = 1e-3
    centre, normal = contact_of(mesh, moved, force)
    wanted = 0.25 * mesh.nodes[6] + 0.75 * mesh.nodes[18] + (0.0, 0.0, 1e-3)
    np.testing.assert_allclose(centre[0], wanted, atol=1e-9)
    np.testing.assert_allclose(normal[0], (0.0, 0.0, -1.0), atol=1e-6)


def test_normal_follows_the_deformed_skin() -> None:
    mesh = plane()
    moved = np.zeros((1, 25, 3), np.float32)
    moved[0, :, 2] = np.tan(np.deg2rad(30.0)) * mesh.nodes[:, 0]
    way = np.array([np.sin(np.deg2rad(30.0)), 0.0, -np.cos(np.deg2rad(30.0))])
    force = np.zeros((1, 25, 3), np.float32)
    force[0, 12] = -2.0 * way
    _, normal = contact_of(mesh, moved, force)
    np.testing.assert_allclose(normal[0], way, atol=1e-6)


def test_centre_and_normal_are_the_sums_over_the_whole_skin() -> None:
    """Beside plain loops over rows and triangles, on a bent skin that is touched in places."""
    rng = np.random.default_rng(3)
    mesh = plane(9)
    moved = (1e-4 * rng.normal(size=(6, 81, 3))).astype(np.float32)
    force = np.zeros((6, 81, 3), np.float32)
    for row in range(6):
        force[row, rng.choice(81, 7, replace=False)] = rng.normal((0.0, 0.0, 2.0), 0.5, (7, 3))
    centre, normal = contact_of(mesh, moved, force)
    for row in range(6):
        points = mesh.nodes + moved[row]
        normals = np.zeros((81, 3))
        for face in mesh.outer_faces:
            a, b, c = points[face]
            normals[face] += np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        weight = np.maximum(0.0, -(force[row] * normals).sum(axis=1))
        mean = weight @ normals
        np.testing.assert_allclose(centre[row], weight @ points / weight.sum(), rtol=1e-6)
        np.testing.assert_allclose(normal[row], mean / np.linalg.norm(mean), rtol=1e-5, atol=1e-7)


@pytest.fixture
def touched_rows(mixed_rows: list[MixedRows], skin: SkinMesh) -> list[MixedRows]:
    """The mixed rows with a force on two of the six outer nodes, along their normals."""
    found = []
    for one in mixed_rows:
        force = np.zeros((len(one.rows.travel_m), len(skin.outer_nodes), 3), np.float32)
        for row, moved in enumerate(one.displacement):
            a, b, c = (skin.nodes + moved)[skin.outer_faces[0]]
            normal = np.cross(b - a, c - a)
            force[row, :2] = -(1.0 + row) * normal / np.linalg.norm(normal)
        found.append(replace(one, contact_force=force))
    return found


@pytest.fixture
def touched(touched_rows: list[MixedRows], skin: SkinMesh, provenance: Provenance) -> MixedDataset:
    basis = fit_basis(lambda: (one.displacement for one in touched_rows))
    forces = fit_basis(
        lambda: (one.contact_force for one in touched_rows if one.contact_force is not None),
        loss_mean=1e-5,
    )
    return assemble_mixed(touched_rows, basis, skin, provenance, contact_basis=forces)


def test_nodal_forces_are_kept(touched: MixedDataset, touched_rows: list[MixedRows]) -> None:
    assert touched.contact is not None
    forces = touched.contact.basis.decode(touched.contact.coefficients)
    given = np.concatenate([one.contact_force for one in touched_rows])
    np.testing.assert_allclose(np.sort(forces.ravel()), np.sort(given.ravel()), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(touched.contact.normal, axis=1), 1.0, atol=1e-6)


def test_contact_comes_back_from_a_file(touched: MixedDataset, tmp_path: Path) -> None:
    digest = write_mixed(tmp_path / "mixed.h5", touched)
    read = read_mixed(tmp_path / "mixed.h5")
    assert digest == content_sha256(read) == content_sha256(touched)
    assert read.contact is not None
    assert touched.contact is not None
    for name in ("centre", "normal", "coefficients"):
        np.testing.assert_array_equal(getattr(read.contact, name), getattr(touched.contact, name))
    assert read.contact.basis.loss_max == touched.contact.basis.loss_max


def test_a_file_that_lacks_a_part_of_it_is_refused(touched: MixedDataset, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    write_mixed(tmp_path / "mixed.h5", touched)
    with h5py.File(tmp_path / "mixed.h5", "a") as file:
        del file["contact/normal"]
    with pytest.raises(DatasetError, match="contact/normal"):
        read_mixed(tmp_path / "mixed.h5")


def test_a_subset_keeps_its_contact(touched: MixedDataset) -> None:
    part = subset(touched, [1, 3])
    assert part.contact is not None
    assert touched.contact is not None
    rows = np.isin(touched.experiment.trial, [1, 3])
    np.testing.assert_array_equal(part.contact.centre, touched.contact.centre[rows])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda force: None, "does not say how the indenter bears"),
        (lambda force: force[:, :3], "contact force has shape"),
        (lambda force: force * np.nan, "contact force is not finite"),
        (lambda force: force * 0.0, "no node is touched"),
    ],
)
def test_a_trial_without_its_contact_is_refused(
    touched_rows: list[MixedRows],
    touched: MixedDataset,
    skin: SkinMesh,
    provenance: Provenance,
    change: Callable[..., Any],
    words: str,
) -> None:
    assert touched.contact is not None
    wrong = replace(touched_rows[1], contact_force=change(touched_rows[1].contact_force))
    with pytest.raises(DatasetError, match=words):
        assemble_mixed(
            [touched_rows[0], wrong],
            touched.basis,
            skin,
            provenance,
            contact_basis=touched.contact.basis,
        )


def test_forces_are_brought_to_the_same_displacements(make_rows: Callable[..., TrialRows]) -> None:
    rows = make_rows("biotac-1", "cube/00/normal")
    travel = np.linspace(0.0, 1e-3, 11)
    force = np.outer(np.linspace(0.0, 5.0, 11), rows.force[0] / np.linalg.norm(rows.force[0]))
    nodal = np.repeat(force[:, None].astype(np.float32), 3, axis=1)
    simulated = SimulatedTrial(
        rows.header.trajectory, travel, force, np.zeros((11, 4, 3), np.float32), 11, nodal
    )
    mixed = mix(rows, simulated)
    assert mixed.contact_force is not None
    np.testing.assert_allclose(mixed.contact_force[:, 1], mixed.simulated_force, atol=1e-5)


def test_features_of_a_mixed_data_set_know_centre_and_normal(touched: MixedDataset) -> None:
    contact = touched.contact
    assert contact is not None
    rows = features(touched, untouched_rows=1)
    assert rows.in_contact is not None
    assert rows.centre_of_pressure is not None
    assert rows.contact_normal is not None
    np.testing.assert_array_equal(rows.centre_of_pressure[rows.in_contact], contact.centre)
    np.testing.assert_array_equal(rows.contact_normal[rows.in_contact], contact.normal)
    assert np.isnan(rows.contact_normal[~rows.in_contact]).all()
    assert features(touched.experiment).contact_normal is None
    with pytest.raises(DatasetError, match="contact_normal has length 2"):
        replace(rows, contact_normal=2 * rows.contact_normal)
