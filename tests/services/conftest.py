"""Small ONNX bundles, frames of an imagined finger, and a bus on loopback."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pytest

from palpate import clock
from palpate.files.bundle import Bundle, read_bundle, write_bundle
from palpate.files.manifest import Manifest
from palpate.files.tasks import TASKS, tensors_of
from palpate.messages import (
    ElectrodeFrame,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    Tare,
    WrenchFrame,
)

sys.path.append(str(Path(__file__).parent))  # tests import field_bundles by name

onnx = pytest.importorskip("onnx")
helper = onnx.helper

THRESHOLD_N = 0.2
BASELINE_COUNTS = 2000.0


NORMAL = "contact_normal"
DORSAL = np.array([0.0, 0.0, 1.0], np.float32)
EVERY_OUTPUT = tuple(
    tensor.name for tensor in (*TASKS["features"].outputs, *TASKS["features"].optional)
)


def width_of(name: str) -> int:
    """Values of an output of the features task."""
    return 1 if name == f"{NORMAL}_sd" else 3


def weights_of(at: int, name: str, inputs: int) -> Any:
    """Weights of the output with this number."""
    shape = (inputs, width_of(name))
    return np.random.default_rng(at).normal(0, 0.01, shape).astype(np.float32)


@dataclasses.dataclass
class Recipe:
    """What the graph of a test bundle looks like; the defaults make a good one."""

    inputs: tuple[str, ...] = ("electrodes",)
    width: int = 19
    outputs: tuple[str, ...] = ("force", "force_sd", "contact_location", "contact_location_sd")
    """Which outputs; ``EVERY_OUTPUT`` has those of a contact, too."""

    long_normal: bool = False
    """The contact normal is twice as long as it should be."""
    dtype: int = onnx.TensorProto.FLOAT
    poison: bool = False
    opset: int = 17

    def model(self) -> Any:
        """The graph: each output is ``electrodes @ W``; a deviation is its magnitude.

        A contact normal is divided by its length.
        """
        nodes, weights, source = [], [], self.inputs[0]
        if self.dtype != onnx.TensorProto.FLOAT:
            nodes.append(helper.make_node("Cast", [source], ["cast"], to=onnx.TensorProto.FLOAT))
            source = "cast"
        for at, name in enumerate(self.outputs):
            values = weights_of(at, name, self.width)
            weights.append(onnx.numpy_helper.from_array(values, f"w_{name}"))
            plain = not (name.endswith("_sd") or name == NORMAL or self.poison)
            raw = name if plain else f"raw_{name}"
            nodes.append(helper.make_node("MatMul", [source, f"w_{name}"], [raw]))
            if name == NORMAL:
                share = np.array([1.0 / (1 + self.long_normal)], np.float32)
                weights.append(onnx.numpy_helper.from_array(share, "share"))
                # An untouched sensor has a direction, too.
                weights.append(onnx.numpy_helper.from_array(DORSAL, "dorsal"))
                nodes.append(helper.make_node("Add", [raw, "dorsal"], ["shifted"]))
                nodes.append(helper.make_node("ReduceL2", ["shifted"], ["length"], axes=[1]))
                nodes.append(helper.make_node("Mul", ["length", "share"], ["divisor"]))
                nodes.append(helper.make_node("Div", ["shifted", "divisor"], [name]))
            elif name.endswith("_sd"):
                nodes.append(helper.make_node("Abs", [raw], [name]))
            elif self.poison:  # zero / zero on every input
                nodes.append(helper.make_node("Sub", [raw, raw], [f"zero_{name}"]))
                nodes.append(helper.make_node("Div", [f"zero_{name}", f"zero_{name}"], [name]))
        tensor = helper.make_tensor_value_info
        graph = helper.make_graph(
            nodes,
            "test",
            [tensor(name, self.dtype, ["N", self.width]) for name in self.inputs],
            [tensor(name, onnx.TensorProto.FLOAT, ["N", width_of(name)]) for name in self.outputs],
            weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", self.opset)])
        model.ir_version = 10
        return model


class MakeBundle(Protocol):
    """Writes a test bundle and returns its folder."""

    def __call__(
        self,
        recipe: Recipe | None = None,
        *,
        model: bytes | None = None,
        golden_shift: float = 0.0,
        **manifest: Any,
    ) -> Path: ...


@pytest.fixture
def recipe() -> type[Recipe]:
    return Recipe


@pytest.fixture
def make_bundle(tmp_path: Path) -> MakeBundle:
    """Factory of bundles whose model may be spoiled while the manifest still claims the best."""
    made: list[Path] = []

    def make(
        recipe: Recipe | None = None,
        *,
        model: bytes | None = None,
        golden_shift: float = 0.0,
        **changes: Any,
    ) -> Path:
        good = Recipe()
        made_of = recipe or good
        every = set(made_of.outputs) == set(EVERY_OUTPUT)
        names = EVERY_OUTPUT if every else good.outputs
        takes, gives = tensors_of("features", 0, optional=names)
        payload = made_of.model().SerializeToString() if model is None else model
        rng = np.random.default_rng(7)
        golden = {"electrodes": rng.normal(0, 100, (8, 19)).astype(np.float32)}
        for at, name in enumerate(names):
            values = golden["electrodes"] @ weights_of(at, name, 19) + np.float32(golden_shift)
            if name == NORMAL:
                values += DORSAL
                values /= np.linalg.norm(values, axis=1, keepdims=True) / (1 + made_of.long_normal)
            golden[name] = np.abs(values) if name.endswith("_sd") else values
        manifest = Manifest(
            name="test",
            version=1,
            task="features",
            inputs=takes,
            outputs=gives,
            sensor_type="BIOTAC",
            contact_threshold_n=THRESHOLD_N,
            training_data_sha256="0" * 64,
            trained_on="nothing",
            metrics={"force_median_error_n": 0.1},
            model_sha256="",
            golden_sha256="",
            created="2026-01-01T00:00:00Z",
            palpate_version="0",
            opset=17,
            sensor_serials=("*",),
        )
        folder = tmp_path / "bundles" / str(len(made))
        write_bundle(
            folder,
            model=payload,
            golden=golden,
            manifest=dataclasses.replace(manifest, **changes),
        )
        made.append(folder)
        return folder

    return make


@pytest.fixture
def bundle(make_bundle: MakeBundle) -> Bundle:
    return read_bundle(make_bundle())


@pytest.fixture
def make_frame() -> Callable[..., ElectrodeFrame]:
    """Factory of frames: the same sequence gives the same counts."""

    def make(
        sequence: int = 1,
        *,
        tare_id: int = 5,
        origin: Origin = Origin.SIMULATED,
        age_s: float = 0.0,
        monotonic_ns: int | None = None,
        validity: int | None = None,
        sensor_type: SensorType = SensorType.BIOTAC,
    ) -> ElectrodeFrame:
        now_ns, wall_ns = clock.now()
        taken_ns = now_ns - round(age_s * 1e9) if monotonic_ns is None else monotonic_ns
        rng = np.random.default_rng(sequence)
        press = 300 * np.sin(sequence / 40) ** 2
        shape = sensor_type.layout.electrodes
        counts = BASELINE_COUNTS - press * np.linspace(0, 1, shape) + rng.normal(0, 1, shape)
        everything = (1 << sensor_type.layout.slots) - 1
        return ElectrodeFrame(
            Stamp(sequence, sequence, taken_ns, wall_ns, clock.CLOCK_ID, origin),
            "BT-TEST",
            sensor_type,
            np.clip(counts, 0, 4095).astype(np.uint16),
            1500 + round(press / 4),
            (2000 + 50 * rng.normal(size=sensor_type.layout.pac_samples)).astype(np.uint16),
            2100,
            1900,
            everything if validity is None else validity,
            227_000,
            tare_id,
        )

    return make


@pytest.fixture
def make_tare(make_frame: Callable[..., ElectrodeFrame]) -> Callable[..., Tare]:
    def make(tare_id: int = 5, *, sensor_type: SensorType = SensorType.BIOTAC) -> Tare:
        count = sensor_type.layout.electrodes
        return Tare(
            tare_id,
            make_frame().stamp,
            "BT-TEST",
            np.full(count, BASELINE_COUNTS, np.float32),
            np.full(count, 1.5, np.float32),
            1500.0,
            2000.0,
            2100.0,
            1900.0,
            100,
        )

    return make


@pytest.fixture
def make_truth() -> Callable[[ElectrodeFrame], tuple[WrenchFrame, IndenterPoseFrame]]:
    """Force and indenter of a frame, as a force/torque sensor and a robot would tell them."""

    def make(frame: ElectrodeFrame) -> tuple[WrenchFrame, IndenterPoseFrame]:
        press = float(np.sin(frame.stamp.sequence / 40) ** 2)
        force: npt.NDArray[np.float32] = np.array([0.2, -0.1, 3.0], np.float32) * np.float32(press)
        position = np.array([-0.004 + 0.006 * np.sin(frame.stamp.sequence / 90), 0.0, -0.007])
        return (
            WrenchFrame(frame.stamp, "FT-TEST", force, np.zeros(3, np.float32)),
            IndenterPoseFrame(
                frame.stamp, "sphere", position, np.array([1.0, 0, 0, 0]), press > 0.05
            ),
        )

    return make


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    """Wait for a condition; fail after a long time."""

    def wait(condition: Callable[[], bool], *, timeout_s: float = 15.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "what was waited for did not happen"
            time.sleep(0.01)

    return wait


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a disk of a size, e.g. ``3m``, and gives its folder; skips without the right to."""
    disk, mounted = tmp_path / "disk", False

    def mount(size: str) -> Path:
        nonlocal mounted
        disk.mkdir()
        words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
        if shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode:
            pytest.skip("mounting a small disk needs root")
        mounted = True
        return disk

    yield mount
    if mounted:
        subprocess.run(["umount", "-l", str(disk)], check=True, capture_output=True)
