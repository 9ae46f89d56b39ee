"""A small skin, and bundles of fields on it whose models are matrices that the tests know."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import helper

from palpate.files.bundle import FieldMesh, write_bundle
from palpate.files.manifest import Manifest
from palpate.files.tasks import tensors_of
from palpate.messages import FieldEstimate, FieldFrame, FloatArray, Stamp

RINGS, AROUND = 5, 6
NODES = 2 * RINGS * AROUND


def skin(name: str = "skin") -> FieldMesh:
    """Two coaxial tubes, 60 nodes; the name is its content hash."""
    nodes: list[list[float]] = []
    faces = []
    for radius_m in (0.007, 0.0055):
        start, triangles = len(nodes), []
        for ring in range(RINGS):
            for at in range(AROUND):
                angle = 2 * np.pi * at / AROUND
                nodes.append([-0.002 * ring, radius_m * np.cos(angle), radius_m * np.sin(angle)])
        for ring in range(RINGS - 1):
            for at in range(AROUND):
                a, b = start + ring * AROUND + at, start + ring * AROUND + (at + 1) % AROUND
                triangles += [[a, b, a + AROUND], [b, b + AROUND, a + AROUND]]
        faces.append(np.array(triangles, np.int32))
    digest = hashlib.sha256(name.encode()).digest()
    return FieldMesh(np.array(nodes, np.float32), faces[0], faces[1], digest)


def weights(name: str, rows: int, columns: int, scale: float) -> FloatArray:
    """The matrix of an output, the same each time."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
    return np.random.default_rng(seed).normal(0, scale, (rows, columns)).astype(np.float32)


MODES = 7
WHOLE = ("contact_force", "coefficients")
"""Optional outputs of a field bundle that has all there is."""


def matrices(
    task: str, *, deviation: bool = True, more: Sequence[str] = ()
) -> dict[str, FloatArray]:
    """Output name -> matrix that the input is multiplied with."""
    if task == "field":
        found = {"displacement": weights("displacement", 19, 3 * NODES, 1e-6)}
        if "coefficients" in more:
            found["displacement"] = weights("coefficients", 19, MODES, 1e-6) @ modes()
        if deviation:
            found["displacement_sd"] = weights("displacement_sd", 19, NODES, 1e-7)
        if "contact_force" in more:
            found["contact_force"] = weights("contact_force", 19, 3 * NODES, 1e-3)
        if "coefficients" in more:
            found["coefficients"] = weights("coefficients", 19, MODES, 1e-6)
        return found
    return {name: weights(name, 3 * NODES, 19, 1e4) for name in ("tared_counts", "tared_counts_sd")}


def modes() -> FloatArray:
    """Modes of the coefficients, shape ``(K, 3V)``."""
    found = weights("modes", MODES, 3 * NODES, 0.3)
    return found.astype(np.float16).astype(np.float32)


def model(
    task: str,
    *,
    deviation: bool = True,
    signed: bool = False,
    extra: int = 0,
    more: Sequence[str] = (),
) -> bytes:
    """The graph: each output is ``input @ W``; a deviation is its magnitude.

    Args:
        task: ``field`` or ``synthesis``.
        deviation: Whether the optional deviation of a field is given.
        signed: Leave the sign of deviations as it comes.
        extra: Columns more than the mesh has.
        more: Further optional outputs of a field.
    """
    source = "electrodes" if task == "field" else "displacement"
    nodes, constants, outputs = [], [], []
    for name, matrix in matrices(task, deviation=deviation, more=more).items():
        wide = np.pad(matrix, ((0, 0), (0, extra)))
        constants.append(onnx.numpy_helper.from_array(wide, f"w_{name}"))
        raw = f"raw_{name}" if name.endswith("_sd") and not signed else name
        nodes.append(helper.make_node("MatMul", [source, f"w_{name}"], [raw]))
        if raw != name:
            nodes.append(helper.make_node("Abs", [raw], [name]))
        outputs.append(_value(name, wide.shape[1]))
    rows = matrix.shape[0]
    if "coefficients" in more:  # as the exporter leaves them: in half precision, by any name
        half = onnx.numpy_helper.from_array(modes().astype(np.float16), "some_modes")
        mean = onnx.numpy_helper.from_array(np.zeros(3 * NODES, np.float32), "some_mean")
        constants += [half, mean]
    graph = helper.make_graph(nodes, "test", [_value(source, rows)], outputs, constants)
    built = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    built.ir_version = 10
    payload: bytes = built.SerializeToString()
    return payload


def _value(name: str, width: int) -> Any:
    return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", width])


def manifest_of(
    task: str, *, deviation: bool = True, more: Sequence[str] = (), **changes: Any
) -> Manifest:
    """A good manifest; its digests come with writing."""
    optional = (*(("displacement_sd",) if deviation and task == "field" else ()), *more)
    inputs, outputs = tensors_of(task, NODES, optional=optional, modes=MODES)
    if "coefficients" in more:
        changes = {"basis": {"mean": "some_mean", "modes": "some_modes"}, **changes}
    manifest = Manifest(
        name=f"{task}-test",
        version=1,
        task=task,
        inputs=inputs,
        outputs=outputs,
        sensor_type="BIOTAC",
        contact_threshold_n=0.0,
        training_data_sha256="0" * 64,
        trained_on="nothing",
        metrics={},
        model_sha256="",
        golden_sha256="",
        created="2026-01-01T00:00:00Z",
        palpate_version="0",
        opset=17,
        sensor_serials=("*",),
    )
    return dataclasses.replace(manifest, **changes)


def write(
    folder: Path,
    task: str,
    *,
    mesh: FieldMesh | None = None,
    spoiled: bytes | None = None,
    manifest: Mapping[str, Any] | None = None,
    **more: Any,
) -> Path:
    """Write a bundle of fields.

    Args:
        folder: Made here.
        task: ``field`` or ``synthesis``.
        mesh: Of its fields; None = ``skin()``.
        spoiled: Another model than the manifest claims.
        manifest: Changes of the manifest.
        more: For ``model``.
    """
    deviation, outputs = more.get("deviation", True), more.get("more", ())
    source = "electrodes" if task == "field" else "displacement"
    found = matrices(task, deviation=deviation, more=outputs)
    rng = np.random.default_rng(7)
    scale = 100 if task == "field" else 1e-3
    rows = next(iter(found.values())).shape[0]
    golden = {source: rng.normal(0, scale, (4, rows)).astype(np.float32)}
    for name, matrix in found.items():
        values = golden[source] @ matrix
        keep = more.get("signed", False) or not name.endswith("_sd")
        golden[name] = values if keep else np.abs(values)
    write_bundle(
        folder,
        model=model(task, **more) if spoiled is None else spoiled,
        golden=golden,
        manifest=manifest_of(task, deviation=deviation, more=outputs, **(manifest or {})),
        mesh=skin() if mesh is None else mesh,
    )
    return folder


def pressed(depth_m: float) -> FloatArray:
    """A dent of this depth in the lower half of ``skin()``, shape ``(V, 3)``."""
    nodes = skin().nodes
    field = np.zeros_like(nodes)
    field[:, 2] = depth_m * np.clip(-nodes[:, 2] / 0.007, 0, 1)
    return field


def truth(stamp: Stamp, depth_m: float = 1e-3, *, mesh: str = "skin") -> FieldFrame:
    """A dent that is known."""
    return FieldFrame(stamp, "BT-TEST", skin(mesh).sha256, pressed(depth_m))


def guess(stamp: Stamp, depth_m: float = 1e-3, *, mesh: str = "skin") -> FieldEstimate:
    """The same as an estimate."""
    return FieldEstimate(stamp, "BT-TEST", bytes(32), 5, skin(mesh).sha256, pressed(depth_m))
