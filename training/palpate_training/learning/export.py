"""Networks -> ONNX bundles, written only if ONNX Runtime gives the same answers as torch."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate import __version__
from palpate.config import check_name
from palpate.errors import BundleError, MissingExtraError
from palpate.files.bundle import FieldMesh, write_bundle
from palpate.files.intervals import Intervals
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS, tensors_of
from palpate.files.training_range import KnownInputs
from palpate.messages import SensorType, TensorInfo, TrainingRange
from palpate.process import require
from palpate_training.datasets.experiment import SkinMesh
from palpate_training.learning.graphs import FeaturesGraph, FieldGraph, SynthesisGraph

_log = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]
Allowed = Callable[[int, FloatArray], FloatArray | float]
"""Number of an output and torch's answer -> what a difference is divided by."""

OPSET = 18
PARITY_MAX = 1e-5
"""Largest difference between torch and ONNX Runtime, over what each task allows: see the two
functions that export."""

GOLDEN_ROWS = 4
"""Rows of a field that are shipped with their answers: one of 6870 nodes is 82 kB."""

_RANDOM_ROWS = 512

_LARGE = 1024
"""Values of a constant from which on half the bytes are worth a cast."""


def refuse_existing(folder: Path, name: str | None = None) -> None:
    """Refuse to train for a bundle that cannot be written; ``name`` = that of the bundle.

    Raises:
        BundleError: The folder exists.
        ConfigError: No bundle can have this name.
    """
    if name is not None:
        check_name(name, "--name")
    if folder.exists():  # refuse before minutes of training, not after
        raise BundleError(
            f"{folder} exists and bundles are immutable", remedy="write the next version"
        )


def version_of(folder: Path, otherwise: int) -> int:
    """Version of a bundle that is written to a folder: its name, if that is a number.

    A repository takes the folder's name for the version, so the manifest must say the same.
    """
    name = folder.name
    return int(name) if name.isdecimal() and int(name) > 0 else otherwise


def export_features(
    folder: Path,
    graph: FeaturesGraph,
    golden_inputs: FloatArray,
    *,
    contact_threshold_n: float,
    seed: int = 0,
    **described: Any,
) -> bytes:
    """Write a ``features`` bundle, or nothing.

    A force may differ by 1e-5 N, a normal by 1e-5 before it is made a unit vector, a location by
    1e-5 of the training targets' standard deviation (1e-5 m would be no demand), and an answer
    larger than one of these units relative to itself.

    Args:
        folder: Folder of the bundle; must not exist.
        graph: The trained networks.
        golden_inputs: Rows of tared counts to ship with their answers, shape ``(G, 19)``.
        contact_threshold_n: Below this estimated force there is no contact [N].
        seed: Seed of the random rows of the parity check.
        described: Name, version, metrics and so on for the manifest; see `_export`.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: Parity or contract fails; nothing is left on disk.
    """
    low, high = golden_inputs.min(axis=0), golden_inputs.max(axis=0)
    random = np.random.default_rng(seed).uniform(
        low - 0.2 * (high - low) - 1.0,
        high + 0.2 * (high - low) + 1.0,
        size=(_RANDOM_ROWS, golden_inputs.shape[1]),
    )
    golden_inputs = np.ascontiguousarray(golden_inputs, dtype=np.float32)
    inputs = np.vstack([golden_inputs, random.astype(np.float32)])
    return _export(
        folder,
        graph,
        "features",
        TASKS["features"].inputs,
        graph.outputs,
        inputs,
        golden_inputs,
        features_scale(graph, inputs),
        contact_threshold_n=contact_threshold_n,
        **described,
    )


def features_scale(graph: FeaturesGraph, inputs: FloatArray) -> Allowed:
    """What differences of the ``features`` task are divided by, for its answers to ``inputs``."""
    scales: list[FloatArray | float] = [1.0, 1.0]
    if graph.names:
        sd = graph.net.output_sd.reshape(-1, 3)  # type: ignore[operator]
        with torch.inference_mode():
            contact = graph.net(torch.from_numpy(inputs)).numpy()[:, 3:]
        for name, spread, estimate in zip(
            graph.names, sd[1:], np.split(contact, len(graph.names), axis=1), strict=True
        ):
            if name == "contact_normal":
                # Made a unit vector of a shorter one, whose rounding grows with it.
                length = np.linalg.norm(estimate, axis=1, keepdims=True)
                scales += [1.0 / np.clip(length, 1e-12, 1.0), 1.0]
            else:
                scales += 2 * [float(spread.max())]
    # float32 resolves relative to the value: 30 N cannot be as exact as 1 N.
    return lambda i, right: np.maximum(scales[i], np.linalg.norm(right, axis=1, keepdims=True))


def export_fields(
    folder: Path,
    graph: FieldGraph | SynthesisGraph,
    inputs: FloatArray,
    mesh: SkinMesh,
    **described: Any,
) -> bytes:
    """Write a ``field`` or ``synthesis`` bundle, or nothing.

    Any value may differ by 1e-5 of the largest value that torch gives for that output.

    Args:
        folder: Folder of the bundle; must not exist.
        graph: The trained network.
        inputs: Held-out inputs for the parity check, shape ``(N, 19)`` [counts] or ``(N, 3V)`` [m];
            the first four are shipped with their answers.
        mesh: Whose nodes move.
        described: Name, version, metrics and so on for the manifest; see `_export`.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: Parity or contract fails; nothing is left on disk.
    """
    task: Literal["field", "synthesis"] = "field" if isinstance(graph, FieldGraph) else "synthesis"
    takes, gives = tensors_of(
        task,
        len(mesh.nodes),
        optional=graph.optional,
        modes=graph.modes.shape[0],
    )
    inputs = np.ascontiguousarray(inputs, np.float32)
    return _export(
        folder,
        graph,
        task,
        takes,
        gives,
        inputs,
        inputs[:GOLDEN_ROWS],
        lambda i, right: np.float64(np.abs(right).max()) or 1.0,
        mesh=FieldMesh(
            nodes=mesh.nodes.astype(np.float32),
            outer_faces=mesh.outer_faces.astype(np.int32),
            inner_faces=mesh.inner_faces.astype(np.int32),
            sha256=bytes.fromhex(mesh.sha256),
        ),
        **described,
    )


def _export(
    folder: Path,
    graph: nn.Module,
    task: Literal["features", "field", "synthesis"],
    takes: tuple[TensorInfo, ...],
    gives: tuple[TensorInfo, ...],
    inputs: FloatArray,
    golden_inputs: FloatArray,
    allowed: Allowed,
    *,
    name: str,
    version: int,
    training_data_sha256: str,
    trained_on: str,
    metrics: Mapping[str, float],
    normalisation: Mapping[str, Any] | None = None,
    contact_threshold_n: float = 0.0,
    mesh: FieldMesh | None = None,
    training_range: TrainingRange | None = None,
    known_inputs: KnownInputs | None = None,
    sensor_serials: tuple[str, ...] = (),
    intervals: Intervals | None = None,
) -> bytes:
    """Export, compare, write."""
    names = [tensor.name for tensor in gives]
    input_name = takes[0].name
    model = onnx_bytes(graph, input_name, torch.zeros(4, takes[0].shape[1]), names)
    worst = check_parity(graph, model, input_name, names, inputs, allowed)
    with torch.inference_mode():
        answers = [answer.numpy() for answer in graph(torch.from_numpy(golden_inputs))]
    manifest = Manifest(
        name=name,
        version=version,
        task=task,
        inputs=takes,
        outputs=gives,
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
        training_range=training_range,
        sensor_serials=sensor_serials,
        intervals=intervals,
        basis=basis_of(model, dict(zip(names, gives, strict=True))),
    )
    golden = {input_name: golden_inputs} | dict(zip(names, answers, strict=True))
    digest = write_bundle(
        folder,
        model=model,
        golden=golden,
        manifest=manifest,
        mesh=mesh,
        known_inputs=known_inputs,
    )
    _log.info("wrote %s, parity %.1g", folder, worst)
    return digest


def basis_of(model: bytes, outputs: Mapping[str, TensorInfo]) -> dict[str, str]:
    """Names of the constants of the graph that are the basis of its coefficients, if it has some.

    They are found by their shapes: the exporter folds the cast of small modes and renames them.
    """
    if "coefficients" not in outputs:
        return {}
    onnx = require("onnx", extra="training")
    modes, width = outputs["coefficients"].shape[1], outputs["displacement"].shape[1]
    wanted = {"mean": (width,), "modes": (modes, width)}
    found: dict[str, str] = {}
    for constant in onnx.load_from_string(model).graph.initializer:
        for name, shape in wanted.items():
            if tuple(constant.dims) == shape:
                found.setdefault(name, constant.name)
    if len(found) < len(wanted):
        raise BundleError(
            f"the exported graph has no constants of the shapes {wanted}",
            remedy="nothing was written; report this with the torch version",
        )
    return found


def onnx_bytes(
    graph: nn.Module, input_name: str, example: Tensor, output_names: Sequence[str]
) -> bytes:
    """Export with a free batch axis, everything in one file, the same bytes each time.

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
    _halve(model.graph)
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


def _halve(graph: Any) -> None:
    """Store large constants in half precision where it holds their values exactly.

    ONNX Runtime casts them once, when it loads the model.
    """
    onnx = require("onnx", extra="training")
    casts = []
    for constant in graph.initializer:
        if constant.data_type != onnx.TensorProto.FLOAT or math.prod(constant.dims) < _LARGE:
            continue
        values = onnx.numpy_helper.to_array(constant)
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        if np.array_equal(half, values):
            name = constant.name
            constant.CopyFrom(onnx.numpy_helper.from_array(half, f"{name}.half"))
            casts.append(
                onnx.helper.make_node(
                    "Cast", [constant.name], [name], f"{name}.cast", to=onnx.TensorProto.FLOAT
                )
            )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def check_parity(
    graph: nn.Module,
    model: bytes,
    input_name: str,
    output_names: Sequence[str],
    inputs: FloatArray,
    allowed: Allowed,
) -> float:
    """Compare ONNX Runtime with torch on rows ``(N, I)``, together and one by one.

    Returns:
        The largest difference, divided by what is allowed.

    Raises:
        BundleError: It is ``PARITY_MAX`` or more, not finite, or the file does not run.
        MissingExtraError: onnxruntime is not installed.
    """
    together, one_by_one = run_onnx(model, input_name, inputs)
    with torch.inference_mode():
        truth = [output.numpy() for output in graph(torch.from_numpy(inputs))]
    worst = 0.0
    for i, (name, right, *given) in enumerate(
        zip(output_names, truth, together, one_by_one, strict=True)
    ):
        scale = allowed(i, right)
        for how, values in zip(("in one batch", "row by row"), given, strict=True):
            difference = float(np.max(np.abs(values - right) / scale))
            # Not finite fails too: a comparison with NaN is never true.
            if values.shape != right.shape or not difference < PARITY_MAX:
                raise BundleError(
                    f"ONNX Runtime differs from torch by {difference:.2g} in {name} {how}, relative"
                    f" to what is allowed; the limit is {PARITY_MAX:g}",
                    remedy="nothing was written; export with another opset or onnxruntime",
                )
            worst = max(worst, difference)
    return worst


def frame_s(model: bytes, input_name: str, frame: FloatArray, frames: int = 500) -> float:
    """Median time of one frame ``(1, I)`` on one thread [s].

    Raises:
        MissingExtraError: onnxruntime is not installed.
    """
    session = session_of(model)
    taken = []
    for _ in range(frames):
        begun = time.perf_counter()
        session.run(None, {input_name: frame})
        taken.append(time.perf_counter() - begun)
    return float(np.median(taken))


def run_onnx(
    model: bytes, input_name: str, inputs: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outputs of ONNX Runtime for rows together, and for the same rows one by one.

    Raises:
        BundleError: The file does not run.
        MissingExtraError: onnxruntime is not installed.
    """
    try:
        session = session_of(model)
        together = session.run(None, {input_name: inputs})
        single = [session.run(None, {input_name: inputs[i : i + 1]}) for i in range(len(inputs))]
    except MissingExtraError:
        raise
    except Exception as error:  # ONNX Runtime's errors share no public base class
        raise BundleError(
            f"ONNX Runtime refuses the exported model: {error}",
            remedy="check the operator set against the installed onnxruntime",
        ) from error
    return together, [np.concatenate(parts) for parts in zip(*single, strict=True)]


def session_of(model: bytes) -> Any:
    """A model in ONNX Runtime, on one thread."""
    runtime = require("onnxruntime", extra="training")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    return runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
