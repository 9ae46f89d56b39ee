"""The manifest of a bundle: what a model says of itself (docs/adr/0008-bundle.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import BundleError
from palpate.files.tasks import SENSOR_TYPE, TaskContract, check_tensors
from palpate.messages import SensorType, TensorInfo

BUNDLE_CONTRACT_VERSION = 1


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
        mesh_sha256: Content hash of the mesh of its fields, hex; empty = no fields.
        mesh_file_sha256: Digest of ``mesh.npz``, hex; empty = no fields.
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


def _tensor_info(values: Mapping[str, Any]) -> TensorInfo:
    shape = tuple(int(n) for n in values["shape"])
    return TensorInfo(str(values["name"]), str(values["dtype"]), shape, str(values["unit"]))


def parse_manifest(text: bytes, where: Path) -> Manifest:
    """Read a manifest.

    Args:
        text: Bytes of ``manifest.json``.
        where: Its path, for the error.

    Raises:
        BundleError: It is no manifest, or one of a future contract.
    """
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
