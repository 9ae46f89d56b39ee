"""The bundle: a model as it is shipped, served and checked (docs/adr/0008-bundle.md).

A folder of three files. ``manifest.json`` says what the model is and holds the digests of
``model.onnx`` and ``golden.npz`` (inputs and the outputs they must give). The bundle's own digest
is the SHA-256 of the manifest's bytes and travels with each estimate.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.protos.errors import BundleError
from palpate.protos.messages import SensorType, TensorInfo

BUNDLE_CONTRACT_VERSION = 1
MODEL, MANIFEST, GOLDEN = "model.onnx", "manifest.json", "golden.npz"
_FILE_BYTES_MAX = 256 << 20


@dataclass(frozen=True, slots=True)
class TaskContract:
    """What a model of this task takes and gives; ``optional`` outputs may be absent together."""

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    optional: tuple[TensorInfo, ...] = ()


def _tensor(name: str, width: int, unit: str) -> TensorInfo:
    return TensorInfo(name, "float32", (-1, width), unit)


TASKS: dict[str, TaskContract] = {
    "features": TaskContract(
        inputs=(_tensor("electrodes", 19, "tared counts"),),
        outputs=(_tensor("force", 3, "N"), _tensor("force_sd", 3, "N")),
        optional=(
            _tensor("contact_location", 3, "m"),
            _tensor("contact_location_sd", 3, "m"),
        ),
    ),
}
"""What each task's model takes and gives. Normalisation is inside the graph."""


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a bundle says of itself.

    Attributes:
        name: Name of the bundle.
        version: Its version, from 1.
        task: A key of ``TASKS``.
        inputs: Inputs of the model.
        outputs: Outputs of the model.
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


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory, its digests checked.

    Attributes:
        manifest: What it says of itself.
        model: ONNX bytes.
        golden: Inputs and expected outputs by name, batch first.
        sha256: Digest of the manifest, 32 bytes.
        folder: Where it came from.
    """

    manifest: Manifest
    model: bytes
    golden: Mapping[str, npt.NDArray[np.float32]]
    sha256: bytes
    folder: Path


def sha256_hex(data: bytes) -> str:
    """SHA-256 as hex."""
    return hashlib.sha256(data).hexdigest()


def check_task(manifest: Manifest, where: str) -> TaskContract:
    """Check that inputs and outputs are those of the manifest's task.

    Raises:
        BundleError: An unknown task, or tensors that differ from its contract.
    """
    contract = TASKS.get(manifest.task)
    if contract is None:
        raise BundleError(
            f"{where}: task {manifest.task!r} is not one of {', '.join(sorted(TASKS))}",
            remedy="upgrade palpate, or train a bundle for one of these tasks",
        )
    allowed = [contract.outputs, contract.outputs + contract.optional]
    if manifest.inputs != contract.inputs or tuple(manifest.outputs) not in allowed:
        raise BundleError(
            f"{where}: inputs {_names(manifest.inputs)} and outputs {_names(manifest.outputs)} "
            f"are not those of task {manifest.task!r}: {_names(contract.inputs)} -> "
            f"{_names(contract.outputs + contract.optional)}",
            remedy="export the model again with palpate train",
        )
    return contract


def _names(tensors: tuple[TensorInfo, ...]) -> str:
    return ", ".join(f"{t.name} {t.dtype}{list(t.shape)} [{t.unit}]" for t in tensors)


def write_bundle(
    folder: Path,
    *,
    model: bytes,
    golden: Mapping[str, npt.NDArray[np.float32]],
    manifest: Manifest,
) -> bytes:
    """Write a bundle as a whole or not at all.

    Args:
        folder: Created; a bundle already there is refused, bundles are immutable.
        model: ONNX bytes.
        golden: Inputs and outputs by name.
        manifest: Its digests are filled in here.

    Returns:
        The bundle's digest, 32 bytes.

    Raises:
        BundleError: It breaks the contract, or the folder exists.
    """
    check_task(manifest, str(folder))
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
    values = asdict(manifest) | {
        "model_sha256": sha256_hex(model),
        "golden_sha256": sha256_hex(golden_bytes),
    }
    text = (json.dumps(values, indent=2, sort_keys=True) + "\n").encode()
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name, data in ((MODEL, model), (GOLDEN, golden_bytes), (MANIFEST, text)):
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
    text = _read(folder, MANIFEST)
    manifest = _parse_manifest(text, folder)
    check_task(manifest, str(folder))
    model, golden_bytes = _read(folder, MODEL), _read(folder, GOLDEN)
    for name, data, wanted in (
        (MODEL, model, manifest.model_sha256),
        (GOLDEN, golden_bytes, manifest.golden_sha256),
    ):
        if sha256_hex(data) != wanted:
            raise BundleError(
                f"{folder / name} is not the file its manifest was written for (digest differs)",
                remedy="restore the bundle from where it was made; do not edit bundles",
            )
    return Bundle(
        manifest, model, _read_golden(golden_bytes, folder), hashlib.sha256(text).digest(), folder
    )


def _read(folder: Path, name: str) -> bytes:
    path = folder / name
    try:
        if path.stat().st_size > _FILE_BYTES_MAX:
            raise BundleError(
                f"{path} exceeds {_FILE_BYTES_MAX >> 20} MiB", remedy="ship a smaller model"
            )
        return path.read_bytes()
    except OSError as error:
        raise BundleError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="a bundle is a folder with model.onnx, manifest.json and golden.npz",
        ) from error


def _read_golden(data: bytes, folder: Path) -> dict[str, npt.NDArray[np.float32]]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: np.asarray(archive[name], np.float32) for name in archive.files}
    except (ValueError, OSError, KeyError, zipfile.BadZipFile) as error:
        raise BundleError(
            f"{folder / GOLDEN} is not a NumPy archive: {error}", remedy="export the bundle again"
        ) from error


def _tensor_info(values: Mapping[str, Any]) -> TensorInfo:
    shape = tuple(int(n) for n in values["shape"])
    return TensorInfo(str(values["name"]), str(values["dtype"]), shape, str(values["unit"]))


def _parse_manifest(text: bytes, folder: Path) -> Manifest:
    where = folder / MANIFEST
    try:
        values = json.loads(text)
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
        for key in ("inputs", "outputs"):
            values[key] = tuple(_tensor_info(t) for t in values[key])
        manifest = Manifest(**values)
        if not np.isfinite(float(manifest.contact_threshold_n)):
            raise ValueError("contact_threshold_n is not finite")
        if manifest.contract_version != BUNDLE_CONTRACT_VERSION:
            raise ValueError(f"contract_version {manifest.contract_version!r} is not known")
        if manifest.sensor_type not in SensorType.__members__:
            raise ValueError(f"sensor_type {manifest.sensor_type!r} is not known")
    except BundleError:
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise BundleError(
            f"{where} is not a bundle manifest: {error}", remedy="export the bundle again"
        ) from error
    return manifest
