"""What a bundle says of itself: ``manifest.json`` (docs/adr/0008-bundle.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from palpate.config import check_name
from palpate.errors import BundleError, ConfigError, printable
from palpate.files.bounded import parse_json
from palpate.files.intervals import Intervals, parse_intervals
from palpate.files.tasks import SENSOR_TYPE, TaskContract, check_tensors
from palpate.files.training_range import parse_training_range
from palpate.messages import SensorType, TensorInfo, TrainingRange

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


def manifest_to_bytes(manifest: Manifest, where: Path) -> bytes:
    """The file ``manifest.json``.

    Raises:
        BundleError: What `parse_manifest` would refuse.
    """
    values = {
        key: value for key, value in asdict(manifest).items() if value or key not in _LATER_KEYS
    }
    text = (json.dumps(values, indent=2, sort_keys=True) + "\n").encode()
    parse_manifest(text, where)
    return text


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
