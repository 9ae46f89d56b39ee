"""Field and synthesis networks -> bundles with their mesh, written only if parity holds."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from palpate.errors import BundleError
from palpate.files.bundle import Manifest, write_bundle
from palpate.files.field_mesh import FieldMesh
from palpate.files.tasks import tensors_of
from palpate.messages import SensorType
from palpate_training.export import OPSET, onnx_bytes, run_onnx
from palpate_training.fields.networks import FieldGraph, SynthesisGraph
from palpate_training.schema import palpate_version
from palpate_training.twin.content import SkinMesh

FloatArray = npt.NDArray[np.float32]

PARITY_MAX = 1e-5
"""Largest difference between torch and ONNX Runtime, over the largest value that torch gives."""

GOLDEN_ROWS = 4
"""A row of a skin of 6870 nodes is 82 kB."""


def field_mesh(mesh: SkinMesh) -> FieldMesh:
    """The mesh as a bundle carries it."""
    return FieldMesh(
        nodes=mesh.nodes.astype(np.float32),
        outer_faces=mesh.outer_faces.astype(np.int32),
        inner_faces=mesh.inner_faces.astype(np.int32),
        sha256=bytes.fromhex(mesh.sha256),
    )


def export_bundle(
    folder: Path,
    graph: FieldGraph | SynthesisGraph,
    inputs: FloatArray,
    mesh: SkinMesh,
    *,
    name: str,
    version: int,
    training_data_sha256: str,
    trained_on: str,
    metrics: Mapping[str, float],
    normalisation: Mapping[str, Any],
) -> bytes:
    """Write a ``field`` or ``synthesis`` bundle, or nothing.

    Args:
        folder: Folder of the bundle; must not exist.
        graph: The trained network.
        inputs: Held-out inputs for the parity check, shape ``(N, 19)`` [counts] or ``(N, 3V)`` [m];
            the first four are shipped with their answers.
        mesh: Whose nodes move.
        name: Name of the bundle.
        version: Its version, from 1.
        training_data_sha256: Content of the data set, hex.
        trained_on: One line for people.
        metrics: Held-out results.
        normalisation: For people; the graph does it.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: Parity or contract fails; nothing is left on disk.
    """
    task: Literal["field", "synthesis"] = "field" if isinstance(graph, FieldGraph) else "synthesis"
    takes, gives = tensors_of(task, len(mesh.nodes), optional=True)
    inputs = np.ascontiguousarray(inputs, np.float32)
    names = [tensor.name for tensor in gives]
    model = onnx_bytes(graph, takes[0].name, torch.zeros(4, takes[0].shape[1]), names)
    worst = check_parity(graph, model, takes[0].name, names, inputs)
    golden = inputs[:GOLDEN_ROWS]
    with torch.inference_mode():
        answers = [answer.numpy() for answer in graph(torch.from_numpy(golden))]
    manifest = Manifest(
        name=name,
        version=version,
        task=task,
        inputs=takes,
        outputs=gives,
        sensor_type=SensorType.BIOTAC.name,
        contact_threshold_n=0.0,
        training_data_sha256=training_data_sha256,
        trained_on=trained_on,
        metrics=dict(metrics) | {"parity_max": worst},
        model_sha256="",
        golden_sha256="",
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        palpate_version=palpate_version(),
        opset=OPSET,
        normalisation=dict(normalisation),
    )
    return write_bundle(
        folder,
        model=model,
        golden={takes[0].name: golden} | dict(zip(names, answers, strict=True)),
        manifest=manifest,
        mesh=field_mesh(mesh),
    )


def check_parity(
    graph: FieldGraph | SynthesisGraph,
    model: bytes,
    input_name: str,
    output_names: list[str],
    inputs: FloatArray,
) -> float:
    """Compare ONNX Runtime with torch on rows together and one by one.

    Returns:
        The largest difference over the largest value of that output.

    Raises:
        BundleError: It is ``PARITY_MAX`` or more, not finite, or the file does not run.
    """
    together, single = run_onnx(model, input_name, inputs)
    with torch.inference_mode():
        truth = [output.numpy() for output in graph(torch.from_numpy(inputs))]
    worst = 0.0
    for name, right, *given in zip(output_names, truth, together, single, strict=True):
        scale = float(np.abs(right).max()) or 1.0
        for how, values in zip(("in one batch", "row by row"), given, strict=True):
            difference = float(np.max(np.abs(values - right))) / scale
            # Not finite fails too: a comparison with NaN is never true.
            if values.shape != right.shape or not difference < PARITY_MAX:
                raise BundleError(
                    f"ONNX Runtime differs from torch by {difference:.2g} of the largest value in"
                    f" {name} {how}, allowed is {PARITY_MAX:g}",
                    remedy="nothing was written; export with another opset or onnxruntime",
                )
            worst = max(worst, difference)
    return worst
