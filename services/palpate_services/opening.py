"""Opening a model: ONNX Runtime's session for a bundle's bytes, checked against its manifest."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from palpate.errors import BundleError
from palpate.extras import require
from palpate.files.bundle import Manifest
from palpate_services.external_data import has_external_data

REMEDY = "export the bundle again with palpate_training, or serve another one"

_DTYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(int64)": "int64"}


def open_model(model: bytes, manifest: Manifest, label: str) -> Any:
    """Open a model.

    Args:
        model: Bytes of ``model.onnx``.
        manifest: What its bundle says of it.
        label: Names the bundle, for the error.

    Returns:
        ONNX Runtime's session.

    Raises:
        BundleError: The model does not load, keeps weights elsewhere, or differs from its manifest.
        MissingExtraError: ONNX Runtime is not installed.
    """
    _check_self_contained(model, label)
    session = _open_session(model, label)
    _check_model(manifest, session, label)
    return session


def _check_self_contained(model: bytes, label: str) -> None:
    try:
        external = has_external_data(model)
    except ValueError as error:
        raise BundleError(
            f"{label}: model.onnx does not load: {error}, so it is no ONNX file", remedy=REMEDY
        ) from error
    if external:
        raise BundleError(
            f"{label}: model.onnx keeps weights in another file, which no digest covers",
            remedy="export it with all weights inside model.onnx",
        )


def _open_session(model: bytes, label: str) -> Any:
    ort: ModuleType = require("onnxruntime", extra="services")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # Spinning threads burn a core between two frames and buy nothing at 100 Hz.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # its errors come as exceptions; stderr is not a log
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors share no base of their own
        text = str(error)
        if "opset" in text.lower():
            problem = f"{label}: ONNX Runtime {ort.__version__} does not know its opset"
            remedy = "export for an older opset, or upgrade onnxruntime"
        else:
            problem = f"{label}: model.onnx does not load: {first_line(error)}"
            remedy = REMEDY
        raise BundleError(problem, remedy=remedy) from error


def _check_model(manifest: Manifest, session: Any, label: str) -> None:
    """The graph must have the tensors that its manifest names; those are the task's already."""
    for side, declared, nodes in (
        ("input", manifest.inputs, session.get_inputs()),
        ("output", manifest.outputs, session.get_outputs()),
    ):
        wanted = {tensor.name: (tensor.dtype, tuple(tensor.shape)) for tensor in declared}
        found = {node.name: _signature(node) for node in nodes}
        if found != wanted:
            raise BundleError(
                f"{label}: model.onnx has {side}s {_describe(found)}; manifest.json says "
                f"{_describe(wanted)}",
                remedy=f"export it to the contract of the task {manifest.task!r}",
            )


def _signature(node: Any) -> tuple[str, tuple[int, ...]]:
    # ONNX Runtime gives a name or None for a free batch size.
    shape = tuple(size if isinstance(size, int) else -1 for size in node.shape)
    return _DTYPES.get(node.type, node.type), shape


def _describe(tensors: dict[str, tuple[str, tuple[int, ...]]]) -> str:
    return ", ".join(
        f"{name} {dtype}{list(shape)}" for name, (dtype, shape) in sorted(tensors.items())
    )


def first_line(error: Exception) -> str:
    """First line of a foreign message, without the source paths of whoever built it."""
    return str(error).splitlines()[0].split(" : ")[-1][:200]
