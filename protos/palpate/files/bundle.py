"""The bundle: a model as it is shipped, served and checked (docs/adr/0008-bundle.md).

A folder of three files. ``manifest.json`` says what the model is and holds the digests of
``model.onnx`` and ``golden.npz`` (inputs and the outputs they must give). A model of fields also
has ``mesh.npz``, and one that knows its training inputs ``range.npz``. The bundle's own digest is
the SHA-256 of the manifest's bytes and travels with each estimate.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.config import check_name
from palpate.errors import BundleError, ConfigError, printable
from palpate.files.bounded import arrays_of_npz, parse_json, read_regular
from palpate.files.intervals import Intervals, parse_intervals
from palpate.files.tasks import SENSOR_TYPE, TaskContract, check_tensors
from palpate.files.training_range import (
    RANGE_BYTES_MAX,
    KnownInputs,
    known_inputs_from_bytes,
    known_inputs_to_bytes,
    parse_training_range,
)
from palpate.messages import FloatArray, SensorType, TensorInfo, TrainingRange

BUNDLE_CONTRACT_VERSION = 1

VERSION_MAX = 999_999_999
THRESHOLD_MAX_N = 1000.0
"""Largest contact threshold [N]: twenty times what breaks a finger."""

_OPSET_MAX = 999
_METRICS_MAX = 1000
_METRIC_MAX = 1e30
_TEXT_MAX = 20_000
_DEPTH_MAX = 16
_TENSORS_MAX = 32
_RANK_MAX = 8
_WIDTH_MAX = 100_000_000
_SERIALS_MAX = 1000
_DIGEST = re.compile(r"(?:[0-9a-f]{64})?")


@dataclass(frozen=True, slots=True)
class Manifest:
    """Description of a bundle: what the model is, and digests of its files.

    Attributes:
        version: From 1.
        task: A key of ``TASKS``.
        sensor_type: Name of the sensor type it takes.
        contact_threshold_n: Below this estimated force [N] there is no contact.
        training_data_sha256: Digest of the data set, hex.
        trained_on: One line for people.
        metrics: Held-out results; names end in the unit.
        model_sha256: Digest of ``model.onnx``, hex.
        golden_sha256: Digest of ``golden.npz``, hex.
        created: UTC time, ISO 8601.
        palpate_version: What wrote it.
        opset: ONNX operator set.
        normalisation: For people; the graph does it.
        contract_version: Of the bundle contract.
        mesh_sha256: Content hash of the mesh of its fields, hex; empty = no fields.
        mesh_file_sha256: Digest of ``mesh.npz``, hex; empty = no fields.
        training_range: What it was trained on; None = not known.
        range_file_sha256: Digest of ``range.npz``, hex; empty = no such file.
        basis: Names of the constants ``mean`` (3V) [m] and ``modes`` (K, 3V) in the graph, so that
            displacement = mean + coefficients x modes; empty = no output ``coefficients``.
        sensor_serials: Serial numbers of the sensors that it was made for; one that ends in ``*``
            stands for all that begin so. Estimates of any other sensor are flagged.
        intervals: How far its estimates may be off; None = not known.
    """

    name: str
    version: int
    task: str
    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    sensor_type: str
    contact_threshold_n: float
    training_data_sha256: str
    trained_on: str
    metrics: Mapping[str, float]
    model_sha256: str
    golden_sha256: str
    created: str
    palpate_version: str
    opset: int
    normalisation: Mapping[str, Any] = field(default_factory=dict)
    contract_version: int = BUNDLE_CONTRACT_VERSION
    mesh_sha256: str = ""
    mesh_file_sha256: str = ""
    training_range: TrainingRange | None = None
    range_file_sha256: str = ""
    basis: Mapping[str, str] = field(default_factory=dict)
    sensor_serials: tuple[str, ...] = ()
    intervals: Intervals | None = None


_LATER_KEYS = (
    "mesh_sha256",
    "mesh_file_sha256",
    "training_range",
    "range_file_sha256",
    "basis",
    "sensor_serials",
    "intervals",
)
"""Manifests were written before these keys; one that says nothing of them must keep its bytes."""


def check_task(manifest: Manifest, where: str) -> TaskContract:
    """Check that inputs, outputs and mesh are those of the manifest's task.

    Raises:
        BundleError: An unknown task, tensors that differ from its contract, or a type of sensor
            that has other electrodes.
    """
    if manifest.sensor_type in SensorType.__members__ and manifest.sensor_type != SENSOR_TYPE.name:
        raise BundleError(
            f"{where}: a model for the sensor type {manifest.sensor_type} has "
            f"{SensorType[manifest.sensor_type].layout.electrodes} electrodes, the tasks of this "
            f"contract have {SENSOR_TYPE.layout.electrodes}, those of a {SENSOR_TYPE.name}",
            remedy=f"train a bundle for a {SENSOR_TYPE.name}; there is no contract for another yet",
        )
    contract, _ = check_tensors(manifest.task, manifest.inputs, manifest.outputs, where)
    return contract


def _tensors(values: object, key: str) -> tuple[TensorInfo, ...]:
    if not isinstance(values, list) or len(values) > _TENSORS_MAX:
        raise ValueError(f"{key} are no list of at most {_TENSORS_MAX} tensors")
    return tuple(_tensor_info(value) for value in values)


def _serials(values: object) -> tuple[str, ...]:
    if not isinstance(values, list) or len(values) > _SERIALS_MAX:
        raise ValueError(f"sensor_serials are no list of at most {_SERIALS_MAX} texts")
    if not all(isinstance(value, str) and value for value in values):
        raise ValueError("sensor_serials are not texts")
    return tuple(values)


def _tensor_info(values: Mapping[str, Any]) -> TensorInfo:
    shape = tuple(int(n) for n in values["shape"])
    if len(shape) > _RANK_MAX or any(not -1 <= size <= _WIDTH_MAX for size in shape):
        raise ValueError("a tensor's shape has too many or too large dimensions")
    return TensorInfo(str(values["name"]), str(values["dtype"]), shape, str(values["unit"]))


def parse_manifest(text: bytes, where: Path) -> Manifest:
    """Read the bytes of ``manifest.json``.

    Raises:
        BundleError: It is no manifest, or one of a future contract.
    """
    try:
        values = parse_json(text)
        if not isinstance(values, dict):
            raise ValueError("not an object")
        version = values.get("contract_version")
        if isinstance(version, int) and version > BUNDLE_CONTRACT_VERSION:
            raise BundleError(
                f"{where} is written for bundle contract v{version}, this palpate knows "
                f"v{BUNDLE_CONTRACT_VERSION}",
                remedy="upgrade palpate on this host: pip install --upgrade palpate",
            )
        known = {f.name for f in fields(Manifest)}
        if unknown := set(values) - known:
            raise ValueError(f"unknown keys {', '.join(sorted(unknown))}")
        _check_values(values)
        for key in ("inputs", "outputs"):
            values[key] = _tensors(values[key], key)
        if values.get("training_range") is not None:
            values["training_range"] = parse_training_range(
                values["training_range"], values["inputs"], values["outputs"]
            )
        if "sensor_serials" in values:
            values["sensor_serials"] = _serials(values["sensor_serials"])
        if values.get("intervals") is not None:
            values["intervals"] = parse_intervals(values["intervals"], values["task"])
        manifest = Manifest(**values)
        _check_later_keys(manifest)
        if manifest.contract_version != BUNDLE_CONTRACT_VERSION:
            raise ValueError(f"contract_version {manifest.contract_version!r} is not known")
        if manifest.sensor_type not in SensorType.__members__:
            raise ValueError(f"sensor_type {manifest.sensor_type!r} is not known")
    except BundleError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise BundleError(
            f"{where} is not a bundle manifest: {printable(str(error))}",
            remedy="export the bundle again",
        ) from error
    return manifest


def _check_later_keys(manifest: Manifest) -> None:
    """Check the keys that belong together.

    Raises:
        ValueError: One comes without the other.
    """
    known = manifest.training_range
    if bool(manifest.range_file_sha256) != (known is not None and known.combinations):
        raise ValueError("training_range.combinations and range_file_sha256 do not agree")
    if manifest.intervals is not None and not manifest.range_file_sha256:
        raise ValueError("intervals need the distance from the training rows, of range_file_sha256")
    outputs = {tensor.name for tensor in manifest.outputs}
    names = {"mean", "modes"} if "coefficients" in outputs else set()
    if set(manifest.basis) != names:
        raise ValueError(
            f"basis names {sorted(manifest.basis)}, with these outputs it has {sorted(names)}"
        )
    if not all(isinstance(name, str) and name for name in manifest.basis.values()):
        raise ValueError("basis does not name constants of the graph")


def _check_values(values: Mapping[str, Any]) -> None:
    """Check what a manifest says of itself before anything is named after it or computed with it.

    Raises:
        ValueError: A name that could be a path, a number out of range, a text with control
            characters; it names the key.
    """
    try:
        check_name(values["name"])
    except ConfigError as error:
        raise ValueError(error.problem) from error
    _check_number(values, "version", 1, VERSION_MAX, whole=True)
    _check_number(values, "opset", 1, _OPSET_MAX, whole=True)
    _check_number(values, "contact_threshold_n", 0.0, THRESHOLD_MAX_N)
    for key in ("training_data_sha256", "model_sha256", "golden_sha256"):
        _check_digest(values[key], key)
    for key in ("mesh_sha256", "mesh_file_sha256", "range_file_sha256"):
        _check_digest(values.get(key, ""), key)
    if not isinstance(values.get("basis", {}), dict):
        raise ValueError("basis is not an object")
    metrics = values["metrics"]
    if not isinstance(metrics, dict) or len(metrics) > _METRICS_MAX:
        raise ValueError(f"metrics are no object of at most {_METRICS_MAX} numbers")
    for key in metrics:
        _check_number(metrics, key, -_METRIC_MAX, _METRIC_MAX)
    if not isinstance(values.get("normalisation", {}), dict):
        raise ValueError("normalisation is not an object")
    for key in ("task", "sensor_type", "trained_on", "created", "palpate_version"):
        if not isinstance(values[key], str):
            raise ValueError(f"{key} is not a text")
    _check_texts(values)


def _check_number(
    values: Mapping[str, Any], key: str, least: float, most: float, *, whole: bool = False
) -> None:
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        raise ValueError(f"{key} is {value!r}, not a {'whole ' if whole else ''}number")
    if not least <= value <= most:
        raise ValueError(f"{key} is {value:g}, {least:g} to {most:g} is allowed")


def _check_digest(value: object, key: str) -> None:
    if not isinstance(value, str) or not _DIGEST.fullmatch(value):
        raise ValueError(f"{key} is no SHA-256 in hex")


def _check_texts(value: object, depth: int = 0) -> None:
    """Refuse control and direction characters, which would act on the terminal that shows them."""
    if depth > _DEPTH_MAX:
        raise ValueError(f"values are nested more than {_DEPTH_MAX} deep")
    if isinstance(value, str):
        if len(value) > _TEXT_MAX:
            raise ValueError(f"a text has {len(value):,} characters, {_TEXT_MAX:,} are allowed")
        if printable(value) != value:
            raise ValueError(f"a text holds control characters: {value!r}")
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_texts(key, depth + 1)
            _check_texts(item, depth + 1)
    elif isinstance(value, list):
        for item in value:
            _check_texts(item, depth + 1)


IndexArray = npt.NDArray[np.int32]

_MESH_REMEDY = "export the bundle again with the mesh that its fields were computed on"


@dataclass(frozen=True, slots=True)
class FieldMesh:
    """Nodes and surfaces of a skin; enough to draw a field, not to solve for one.

    Attributes:
        nodes: Positions in the pressurised, untouched state [m], sensor frame, float32, shape
            ``(V, 3)``.
        outer_faces: Triangles of the skin's outside, node ids, int32, shape ``(F, 3)``.
        inner_faces: Triangles of its inside, int32, shape ``(G, 3)``.
        sha256: Content hash of the mesh that the fields were computed on, 32 bytes. It covers more
            than stands here (elements, fixed nodes), so it names the mesh and cannot be recomputed.
    """

    nodes: FloatArray
    outer_faces: IndexArray
    inner_faces: IndexArray
    sha256: bytes


def check_mesh(mesh: FieldMesh, where: str) -> None:
    """Check shapes, types and ranges of a mesh.

    Raises:
        BundleError: Names ``where``, the array and what is wrong.
    """
    if problem := _mesh_problem(mesh):
        raise BundleError(f"{where}: {problem}", remedy=_MESH_REMEDY)


def _mesh_problem(mesh: FieldMesh) -> str:
    nodes = mesh.nodes
    if nodes.dtype != np.float32 or nodes.ndim != 2 or nodes.shape[1] != 3 or not len(nodes):
        return f"nodes are {nodes.dtype}{list(nodes.shape)}, not float32[V, 3]"
    if not np.isfinite(nodes).all():
        return "nodes hold NaN or infinity"
    for name, faces in (("outer_faces", mesh.outer_faces), ("inner_faces", mesh.inner_faces)):
        if faces.dtype != np.int32 or faces.ndim != 2 or faces.shape[1] != 3:
            return f"{name} are {faces.dtype}{list(faces.shape)}, not int32[F, 3]"
        if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < len(nodes):
            return f"{name} name nodes {faces.min()}..{faces.max()}, there are 0..{len(nodes) - 1}"
    if len(mesh.sha256) != 32:
        return f"sha256 has {len(mesh.sha256)} bytes, a SHA-256 has 32"
    return ""


def mesh_to_bytes(mesh: FieldMesh) -> bytes:
    """The file ``mesh.npz``."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        nodes=mesh.nodes,
        outer_faces=mesh.outer_faces,
        inner_faces=mesh.inner_faces,
        sha256=np.frombuffer(mesh.sha256, np.uint8),
    )
    return buffer.getvalue()


def mesh_from_bytes(data: bytes, where: str) -> FieldMesh:
    """Read and check ``mesh.npz``.

    Raises:
        BundleError: It is no NumPy archive, lacks an array, or an array is not what it must be.
    """
    try:
        arrays = arrays_of_npz(data, _MESH_BYTES_MAX)
        mesh = FieldMesh(
            arrays["nodes"],
            arrays["outer_faces"],
            arrays["inner_faces"],
            arrays["sha256"].astype(np.uint8).tobytes(),
        )
    except (ValueError, KeyError) as error:
        raise BundleError(
            f"{where} is not a mesh: {printable(str(error))}", remedy=_MESH_REMEDY
        ) from error
    check_mesh(mesh, where)
    return mesh


MODEL, MANIFEST, GOLDEN, MESH = "model.onnx", "manifest.json", "golden.npz", "mesh.npz"
RANGE = "range.npz"
SIGNATURE = "signature.txt"
_MODEL_BYTES_MAX = 256 << 20
_MANIFEST_BYTES_MAX = 1 << 20
_GOLDEN_BYTES_MAX = 64 << 20
_MESH_BYTES_MAX = 64 << 20
_BYTES_MAX = {
    MODEL: _MODEL_BYTES_MAX,
    MANIFEST: _MANIFEST_BYTES_MAX,
    GOLDEN: _GOLDEN_BYTES_MAX,
    MESH: _MESH_BYTES_MAX,
    RANGE: RANGE_BYTES_MAX,
    SIGNATURE: 1024,
}
"""Size of each file, and of what its arrays expand to; those that ship have 1 % of it [bytes]."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory, its digests checked.

    Attributes:
        model: ONNX bytes.
        golden: Inputs and expected outputs by name, batch first.
        sha256: Digest of the manifest, 32 bytes.
        folder: Where it came from.
        mesh: Mesh of its fields; None for a task without.
        known_inputs: Representatives of its training inputs; None = not known.
    """

    manifest: Manifest
    model: bytes
    golden: Mapping[str, npt.NDArray[np.float32]]
    sha256: bytes
    folder: Path
    mesh: FieldMesh | None = None
    known_inputs: KnownInputs | None = None


def sha256_hex(data: bytes) -> str:
    """SHA-256 as hex."""
    return hashlib.sha256(data).hexdigest()


def check_bundle_mesh(mesh: FieldMesh | None, manifest: Manifest, where: str) -> None:
    """Check that a task of fields has its mesh, and that others have none.

    Raises:
        BundleError: No mesh, one too many, or not the one that manifest and tensors mean.
    """
    _, nodes = check_tensors(manifest.task, manifest.inputs, manifest.outputs, where)
    if (mesh is None) != (nodes is None):
        what = "needs a mesh" if mesh is None else "has no mesh"
        raise BundleError(
            f"{where}: a bundle of task {manifest.task!r} {what}",
            remedy=f"{MESH} belongs to bundles of fields, and to no others",
        )
    if mesh is None:
        return
    problem = ""
    if len(mesh.nodes) != nodes:
        problem = f"the mesh has {len(mesh.nodes)} nodes, the tensors are for {nodes}"
    elif manifest.mesh_sha256 != mesh.sha256.hex():
        problem = (
            f"the manifest is for mesh {manifest.mesh_sha256[:12]!r}, {MESH} holds "
            f"{mesh.sha256.hex()[:12]!r}"
        )
    if problem:
        raise BundleError(
            f"{where}: {problem}",
            remedy="export the model again with the mesh it was trained on",
        )


def write_bundle(
    folder: Path,
    *,
    model: bytes,
    golden: Mapping[str, npt.NDArray[np.float32]],
    manifest: Manifest,
    mesh: FieldMesh | None = None,
    known_inputs: KnownInputs | None = None,
) -> bytes:
    """Write a bundle; the folder appears complete or not at all, and is never overwritten.

    ``golden`` holds an array for each input and output; digests of the manifest are filled in here.
    ``known_inputs`` belong to a manifest with a training range.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: It breaks the contract, or the folder exists.
    """
    if mesh is not None:
        check_mesh(mesh, f"{folder}: mesh")
        manifest = replace(manifest, mesh_sha256=mesh.sha256.hex())
    check_bundle_mesh(mesh, manifest, str(folder))
    missing = {t.name for t in manifest.inputs + manifest.outputs} - set(golden)
    if missing:
        raise BundleError(
            f"{folder}: golden vectors lack {', '.join(sorted(missing))}",
            remedy="give one golden array for each input and output",
        )
    if folder.exists():
        raise BundleError(
            f"{folder} exists and bundles are immutable", remedy="write the next version"
        )
    buffer = io.BytesIO()
    np.savez(buffer, **{name: np.asarray(value, np.float32) for name, value in golden.items()})  # type: ignore[arg-type]
    golden_bytes = buffer.getvalue()
    files = {MODEL: model, GOLDEN: golden_bytes}
    values = asdict(manifest) | {
        "model_sha256": sha256_hex(model),
        "golden_sha256": sha256_hex(golden_bytes),
    }
    if mesh is not None:
        files[MESH] = mesh_to_bytes(mesh)
        values["mesh_file_sha256"] = sha256_hex(files[MESH])
    if known_inputs is not None:
        files[RANGE] = known_inputs_to_bytes(known_inputs)
        values["range_file_sha256"] = sha256_hex(files[RANGE])
    values = {key: value for key, value in values.items() if value or key not in _LATER_KEYS}
    text = (json.dumps(values, indent=2, sort_keys=True) + "\n").encode()
    parse_manifest(text, folder / MANIFEST)  # what would be refused is not written
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name, data in (*files.items(), (MANIFEST, text)):
            (temporary / name).write_bytes(data)
        temporary.chmod(0o755)
        os.rename(temporary, folder)
    except OSError as error:
        raise BundleError(f"cannot write {folder}: {error}", remedy="check the disk") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return hashlib.sha256(text).digest()


def read_bundle(folder: Path) -> Bundle:
    """Read a bundle and check its digests, its contract version and its task.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    text = read_file(folder, MANIFEST)
    manifest = parse_manifest(text, folder / MANIFEST)
    check_task(manifest, str(folder))
    model = _read_checked(folder, MODEL, manifest.model_sha256)
    golden = _read_golden(_read_checked(folder, GOLDEN, manifest.golden_sha256), folder)
    mesh = _read_mesh(folder, manifest)
    known = _read_known_inputs(folder, manifest)
    return Bundle(manifest, model, golden, hashlib.sha256(text).digest(), folder, mesh, known)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a bundle and nothing else.

    Raises:
        BundleError: Names the file and what is wrong.
    """
    return parse_manifest(read_file(folder, MANIFEST), folder / MANIFEST)


def read_mesh(folder: Path) -> FieldMesh | None:
    """Read the mesh of a bundle and nothing else; None for a bundle without.

    Raises:
        BundleError: Names the folder and what is wrong.
    """
    return _read_mesh(folder, read_manifest(folder))


def _read_mesh(folder: Path, manifest: Manifest) -> FieldMesh | None:
    mesh = None
    if manifest.mesh_file_sha256:
        data = _read_checked(folder, MESH, manifest.mesh_file_sha256)
        mesh = mesh_from_bytes(data, str(folder / MESH))
    check_bundle_mesh(mesh, manifest, str(folder))
    return mesh


def _read_known_inputs(folder: Path, manifest: Manifest) -> KnownInputs | None:
    if not manifest.range_file_sha256:
        return None
    data = _read_checked(folder, RANGE, manifest.range_file_sha256)
    return known_inputs_from_bytes(data, manifest.inputs[0].shape[1], str(folder / RANGE))


def _read_checked(folder: Path, name: str, sha256: str) -> bytes:
    data = read_file(folder, name)
    if sha256_hex(data) != sha256:
        raise BundleError(
            f"{folder / name} is not the file its manifest was written for (digest differs)",
            remedy="restore the bundle from where it was made; do not edit bundles",
        )
    return data


def read_file(folder: Path, name: str) -> bytes:
    """Read one file of a bundle, by its name.

    Raises:
        BundleError: It is no regular file, is larger than it may be, or cannot be read.
    """
    path = folder / name
    try:
        return read_regular(path, _BYTES_MAX[name])
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise BundleError(
            f"{path} cannot be read: {why}",
            remedy="a bundle is a folder with the regular files model.onnx, manifest.json, "
            "golden.npz and, of fields, mesh.npz",
        ) from error


def _read_golden(data: bytes, folder: Path) -> dict[str, npt.NDArray[np.float32]]:
    try:
        arrays = arrays_of_npz(data, _GOLDEN_BYTES_MAX)
        return {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    except ValueError as error:
        raise BundleError(
            f"{folder / GOLDEN} is not a NumPy archive: {printable(str(error))}",
            remedy="export the bundle again",
        ) from error
