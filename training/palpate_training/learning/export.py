"""Networks -> ONNX bundles, written only if ONNX Runtime gives the same answers as torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate import __version__
from palpate.errors import BundleError
from palpate.extras import require
from palpate.files.bundle import TASKS, Manifest, write_bundle
from palpate.files.field_mesh import FieldMesh
from palpate.files.tasks import tensors_of
from palpate.messages import SensorType, TensorInfo
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.learning.networks import FieldGraph, Mlp, SynthesisGraph

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]

OPSET = 18
PARITY_MAX = 1e-5
"""Largest difference between torch and ONNX Runtime: forces in N, locations in units of the
training targets' standard deviation (1e-5 m would be no demand on a location), and for answers
larger than one of these units relative to the answer."""

_RANDOM_ROWS = 512


class FeaturesGraph(nn.Module):
    """The ``features`` task: one network for each quantity, and constant standard deviations.

    Args:
        force: Tared counts -> force [N].
        force_sd: Residual standard deviation per axis on validation rows [N], shape ``(3,)``.
        location: Tared counts -> contact location [m], or None.
        location_sd: Likewise [m], shape ``(3,)``, or None.
    """

    # Not named as the outputs are: ONNX wants every name once.
    force_spread: Tensor
    location_spread: Tensor

    def __init__(
        self,
        force: Mlp,
        force_sd: FloatArray,
        location: Mlp | None = None,
        location_sd: FloatArray | None = None,
    ) -> None:
        super().__init__()
        self.force = force
        self.location = location
        self.register_buffer("force_spread", torch.from_numpy(force_sd.astype(np.float32)))
        if (location is None) != (location_sd is None):
            raise ValueError("give location and location_sd, or neither")
        if location_sd is not None:
            self.register_buffer(
                "location_spread", torch.from_numpy(location_sd.astype(np.float32))
            )

    def forward(self, electrodes: Tensor) -> tuple[Tensor, ...]:
        """Tared counts ``(N, 19)`` -> the task's outputs in order, each ``(N, 3)``."""
        rows = electrodes.shape[0]
        outputs = [self.force(electrodes), self.force_spread.expand(rows, 3)]
        if self.location is not None:
            outputs += [self.location(electrodes), self.location_spread.expand(rows, 3)]
        return tuple(outputs)

    @property
    def outputs(self) -> tuple[TensorInfo, ...]:
        """What it gives, as the contract names it."""
        contract = TASKS["features"]
        return contract.outputs + (contract.optional if self.location is not None else ())


def to_onnx(graph: FeaturesGraph) -> bytes:
    """Export the ``features`` graph; see ``onnx_bytes``."""
    names = [tensor.name for tensor in graph.outputs]
    return onnx_bytes(graph, "electrodes", torch.zeros(4, 19), names)


def onnx_bytes(
    graph: nn.Module, input_name: str, example: Tensor, output_names: Sequence[str]
) -> bytes:
    """Export with a free batch axis, everything in one file, the same bytes each time.

    Args:
        graph: Takes one tensor, batch first.
        input_name: Name of the input.
        example: An input of more than one row.
        output_names: Names of the outputs, in order.

    Raises:
        MissingExtraError: onnx or onnxscript is not installed.
    """
    onnx = require("onnx", extra="training")
    require("onnxscript", extra="training")
    graph.eval()
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    with warnings.catch_warnings():
        # It warns about its own internals and about torchvision; parity is what we check.
        warnings.simplefilter("ignore")
        exporter.setLevel(logging.ERROR)
        program = torch.onnx.export(
            graph,
            (example,),
            input_names=[input_name],
            output_names=list(output_names),
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    exporter.setLevel(level)
    if program is None:
        raise BundleError("torch exported nothing", remedy="report this with the torch version")
    model = program.model_proto
    _strip(model)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def _strip(model: Any) -> None:
    """Drop stack traces and paths of the exporting machine, so that equal nets are equal bytes."""
    model.producer_version = ""
    model.doc_string = ""
    del model.metadata_props[:]
    graph = model.graph
    graph.doc_string = ""
    del graph.metadata_props[:]
    del graph.value_info[:]
    for item in (*graph.node, *graph.input, *graph.output, *graph.initializer):
        item.doc_string = ""
        del item.metadata_props[:]


def check_parity(graph: FeaturesGraph, model: bytes, inputs: FloatArray) -> float:
    """Compare ONNX Runtime with torch on rows together and one by one.

    Args:
        graph: The truth.
        model: ONNX bytes.
        inputs: Tared counts [counts], shape ``(N, 19)``.

    Returns:
        The largest difference, scaled as ``PARITY_MAX`` says.

    Raises:
        BundleError: It is ``PARITY_MAX`` or more, or the file does not run.
        MissingExtraError: onnxruntime is not installed.
    """
    together, one_by_one = run_onnx(model, "electrodes", inputs)
    with torch.inference_mode():
        truth = [output.numpy() for output in graph(torch.from_numpy(inputs))]
    scales = [1.0, 1.0]
    if graph.location is not None:
        scale = float(graph.location.output_sd.max())
        scales += [scale, scale]
    worst = 0.0
    for info, right, *given, scale in zip(
        graph.outputs, truth, together, one_by_one, scales, strict=True
    ):
        for how, values in zip(("in one batch", "row by row"), given, strict=True):
            # float32 resolves relative to the value: 30 N cannot be as exact as 1 N.
            allowed = np.maximum(scale, np.linalg.norm(right, axis=1, keepdims=True))
            difference = float(np.max(np.abs(values - right) / allowed))
            # Not finite fails too: a comparison with NaN is never true.
            if not difference < PARITY_MAX:
                raise BundleError(
                    f"ONNX Runtime differs from torch by {difference:.2g} in {info.name} {how},"
                    f" allowed is {PARITY_MAX:g}",
                    remedy="nothing was written; export with another opset or onnxruntime",
                )
            worst = max(worst, difference)
    return worst


def run_onnx(
    model: bytes, input_name: str, inputs: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outputs of ONNX Runtime for rows together, and for the same rows one by one.

    Raises:
        BundleError: The file does not run.
        MissingExtraError: onnxruntime is not installed.
    """
    runtime = require("onnxruntime", extra="training")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        together = session.run(None, {input_name: inputs})
        single = [session.run(None, {input_name: inputs[i : i + 1]}) for i in range(len(inputs))]
    except Exception as error:  # ONNX Runtime's errors share no public base class
        raise BundleError(
            f"ONNX Runtime refuses the exported model: {error}",
            remedy="check the operator set against the installed onnxruntime",
        ) from error
    return together, [np.concatenate(parts) for parts in zip(*single, strict=True)]


def export_features(
    folder: Path,
    graph: FeaturesGraph,
    golden_inputs: FloatArray,
    *,
    name: str,
    version: int,
    contact_threshold_n: float,
    training_data_sha256: str,
    trained_on: str,
    metrics: Mapping[str, float],
    normalisation: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> bytes:
    """Write a ``features`` bundle, or nothing.

    Args:
        folder: Folder of the bundle; must not exist.
        graph: The trained networks.
        golden_inputs: Rows of tared counts to ship with their answers, shape ``(G, 19)``.
        name: Name of the bundle.
        version: Its version, from 1.
        contact_threshold_n: Below this estimated force there is no contact [N].
        training_data_sha256: Content of the data set, hex.
        trained_on: One line for people.
        metrics: Held-out results.
        normalisation: For people; the graph does it.
        seed: Seed of the random rows of the parity check.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: Parity or contract fails; nothing is left on disk.
    """
    model = to_onnx(graph)
    low, high = golden_inputs.min(axis=0), golden_inputs.max(axis=0)
    random = np.random.default_rng(seed).uniform(
        low - 0.2 * (high - low) - 1.0,
        high + 0.2 * (high - low) + 1.0,
        size=(_RANDOM_ROWS, golden_inputs.shape[1]),
    )
    golden_inputs = np.ascontiguousarray(golden_inputs, dtype=np.float32)
    worst = check_parity(graph, model, np.vstack([golden_inputs, random.astype(np.float32)]))
    with torch.inference_mode():
        answers = graph(torch.from_numpy(golden_inputs))
    golden = {"electrodes": golden_inputs} | {
        info.name: answer.numpy() for info, answer in zip(graph.outputs, answers, strict=True)
    }
    manifest = Manifest(
        name=name,
        version=version,
        task="features",
        inputs=TASKS["features"].inputs,
        outputs=graph.outputs,
        sensor_type=SensorType.BIOTAC.name,
        contact_threshold_n=contact_threshold_n,
        training_data_sha256=training_data_sha256,
        trained_on=trained_on,
        metrics=dict(metrics) | {"parity_max": worst},
        model_sha256="",
        golden_sha256="",
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        palpate_version=__version__,
        opset=OPSET,
        normalisation=dict(normalisation or {}),
    )
    digest = write_bundle(folder, model=model, golden=golden, manifest=manifest)
    logger.info("wrote %s, parity %.1g", folder, worst)
    return digest


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
    worst = check_field_parity(graph, model, takes[0].name, names, inputs)
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
        palpate_version=__version__,
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


def check_field_parity(
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
