"""Bundles of fields: the width of their tensors, and the mesh that the width belongs to."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import BundleError
from palpate.files.bundle import (
    FieldMesh,
    mesh_from_bytes,
    mesh_to_bytes,
    read_bundle,
    read_mesh,
    write_bundle,
)
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS, check_tensors, tensors_of
from palpate.messages import TensorInfo

NODES = 5


@pytest.fixture
def mesh() -> FieldMesh:
    nodes = np.linspace(-0.01, 0.01, 3 * NODES, dtype=np.float32).reshape(NODES, 3)
    outer, inner = np.array([[0, 1, 2]], np.int32), np.array([[2, 3, 4]], np.int32)
    return FieldMesh(nodes, outer, inner, bytes(range(32)))


def _manifest(task: str, nodes: int = NODES) -> Manifest:
    inputs, outputs = tensors_of(task, nodes)
    return Manifest(
        "test", 1, task, inputs, outputs, "BIOTAC", 0.0, "00" * 32, "nothing", {}, "", "", "now",
        "0.1.0", 18,
    )  # fmt: skip


def _write(folder: Path, mesh: FieldMesh | None, manifest: Manifest) -> Path:
    tensors = manifest.inputs + manifest.outputs
    golden = {tensor.name: np.zeros((2, tensor.shape[1]), np.float32) for tensor in tensors}
    write_bundle(folder, model=b"onnx", golden=golden, manifest=manifest, mesh=mesh)
    return folder


@pytest.mark.parametrize("task", ["field", "synthesis"])
def test_round_trip(tmp_path: Path, mesh: FieldMesh, task: str) -> None:
    folder = _write(tmp_path / "1", mesh, _manifest(task))
    bundle = read_bundle(folder)
    assert bundle.manifest.mesh_sha256 == mesh.sha256.hex()
    assert (
        bundle.manifest.mesh_file_sha256
        == hashlib.sha256((folder / "mesh.npz").read_bytes()).hexdigest()
    )
    for found in (bundle.mesh, read_mesh(folder)):
        assert found is not None
        assert found.sha256 == mesh.sha256
        for name in ("nodes", "outer_faces", "inner_faces"):
            assert getattr(found, name).dtype == getattr(mesh, name).dtype
            np.testing.assert_array_equal(getattr(found, name), getattr(mesh, name))


def test_manifest_of_features_is_written_as_before_there_were_meshes(tmp_path: Path) -> None:
    folder = _write(tmp_path / "1", None, _manifest("features"))
    assert not {"mesh_sha256", "mesh_file_sha256"} & set(
        json.loads((folder / "manifest.json").read_text())
    )
    assert not (folder / "mesh.npz").exists()
    assert read_bundle(folder).mesh is None
    assert read_mesh(folder) is None


def test_a_task_of_fields_needs_a_mesh_and_others_have_none(
    tmp_path: Path, mesh: FieldMesh
) -> None:
    with pytest.raises(BundleError, match=r"'field' needs a mesh"):
        _write(tmp_path / "1", None, _manifest("field"))
    with pytest.raises(BundleError, match=r"'features' has no mesh"):
        _write(tmp_path / "1", mesh, _manifest("features"))
    with pytest.raises(BundleError, match=r"mesh has 5 nodes, the tensors are for 6"):
        _write(tmp_path / "1", mesh, _manifest("field", 6))
    assert not (tmp_path / "1").exists()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"outer_faces": np.array([[0, 1, 5]], np.int32)}, r"outer_faces name nodes 0\.\.5"),
        ({"inner_faces": np.array([[-1, 1, 2]], np.int32)}, r"inner_faces name nodes -1"),
        ({"inner_faces": np.zeros((1, 4), np.int32)}, r"inner_faces are int32\[1, 4\]"),
        ({"outer_faces": np.zeros((1, 3), np.int64)}, r"outer_faces are int64"),
        ({"nodes": np.zeros((5, 3))}, r"nodes are float64\[5, 3\]"),
        ({"nodes": np.zeros((5, 2), np.float32)}, r"nodes are float32\[5, 2\]"),
        ({"nodes": np.full((5, 3), np.nan, np.float32)}, "NaN"),
        ({"sha256": b"short"}, "5 bytes"),
    ],
)
def test_a_mesh_that_breaks_the_contract(
    tmp_path: Path, mesh: FieldMesh, change: dict[str, Any], complaint: str
) -> None:
    bad = dataclasses.replace(mesh, **change)
    with pytest.raises(BundleError, match=complaint):
        _write(tmp_path / "1", bad, _manifest("field"))
    with pytest.raises(BundleError, match=complaint):
        mesh_from_bytes(mesh_to_bytes(bad), "mesh.npz")
    assert not (tmp_path / "1").exists()


def test_a_mesh_file_that_is_not_the_bundles(tmp_path: Path, mesh: FieldMesh) -> None:
    folder = _write(tmp_path / "1", mesh, _manifest("field"))
    path = folder / "mesh.npz"
    whole = path.read_bytes()
    path.write_bytes(whole + b"\0")
    with pytest.raises(BundleError, match=r"mesh\.npz is not the file.*restore"):
        read_bundle(folder)
    path.unlink()
    with pytest.raises(BundleError, match=r"mesh\.npz cannot be read"):
        read_bundle(folder)
    # Another mesh, with the digest of its file put right: its content hash tells.
    other = mesh_to_bytes(dataclasses.replace(mesh, sha256=bytes(32)))
    path.write_bytes(other)
    values = json.loads((folder / "manifest.json").read_text())
    values["mesh_file_sha256"] = hashlib.sha256(other).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(values))
    with pytest.raises(BundleError, match=r"manifest is for mesh '000102.*holds '000000"):
        read_bundle(folder)
    with pytest.raises(BundleError, match="manifest is for mesh"):
        read_mesh(folder)


@pytest.mark.parametrize("data", [b"", b"no archive", b"PK\x03\x04broken"])
def test_bytes_that_are_no_mesh(data: bytes) -> None:
    with pytest.raises(BundleError, match=r"mesh\.npz is not a mesh"):
        mesh_from_bytes(data, "mesh.npz")


OPTIONAL = ("displacement_sd", "contact_force", "coefficients")


@given(st.integers(1, 10_000), st.sets(st.sampled_from(OPTIONAL)), st.integers(1, 200))
def test_any_number_of_nodes_and_modes_is_a_width(
    nodes: int, optional: set[str], modes: int
) -> None:
    for task in ("field", "synthesis"):
        inputs, outputs = tensors_of(task, nodes, optional=optional, modes=modes)
        contract, found = check_tensors(task, inputs, outputs, "test")
        assert contract is TASKS[task]
        assert found == nodes


@given(st.integers(-5, 100))
def test_a_width_that_is_no_field_is_refused(width: int) -> None:
    bad = (TensorInfo("displacement", "float32", (-1, width), "m"),)
    inputs = TASKS["field"].inputs
    if width > 0 and width % 3 == 0:
        check_tensors("field", inputs, bad, "test")
        return
    with pytest.raises(BundleError, match="task 'field'"):
        check_tensors("field", inputs, bad, "test")


def test_deviations_must_be_for_the_same_nodes() -> None:
    inputs, outputs = tensors_of("field", 5, optional=("displacement_sd",))
    wrong = (outputs[0], dataclasses.replace(outputs[1], shape=(-1, 6)))
    with pytest.raises(BundleError, match=r"displacement_sd float32\[-1, 6\]"):
        check_tensors("field", inputs, wrong, "test")


@pytest.mark.parametrize("width", [-2, -1, 0])
def test_coefficients_have_a_number_of_modes(width: int) -> None:
    inputs, outputs = tensors_of("field", 5, optional=("coefficients",), modes=7)
    wrong = (outputs[0], dataclasses.replace(outputs[1], shape=(-1, width)))
    with pytest.raises(BundleError, match="task 'field'"):
        check_tensors("field", inputs, wrong, "test")


def test_optional_outputs_keep_their_order_and_their_company() -> None:
    inputs, outputs = tensors_of("field", 5, optional=OPTIONAL, modes=7)
    with pytest.raises(BundleError, match="task 'field'"):
        check_tensors("field", inputs, outputs[::-1], "test")
    features = TASKS["features"]
    with pytest.raises(BundleError, match="task 'features'"):
        check_tensors("features", features.inputs, features.outputs + features.optional[:1], "test")
