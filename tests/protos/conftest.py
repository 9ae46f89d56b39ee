"""One valid example of every message of the contract."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from tests.protos.robot_client import Finger, FrameOf

from palpate import clock
from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.errors import ErrorCode
from palpate.messages import (
    BasisRequest,
    ContactDescription,
    ElectrodeFrame,
    ErrorReply,
    FeatureEstimate,
    FeatureRequest,
    FieldEstimate,
    FieldFrame,
    FieldRequest,
    IndenterPoseFrame,
    ModeBasis,
    ModelAction,
    ModelCommand,
    ModelInventory,
    ModelMetadata,
    ModelRequest,
    Origin,
    Pose,
    QualityFlag,
    RobotPoseFrame,
    SensorType,
    ServedModel,
    ServiceRequest,
    ServiceState,
    SimulationCancelReply,
    SimulationCancelRequest,
    SimulationConvergence,
    SimulationOutcome,
    SimulationParameters,
    SimulationPhase,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
    StageTimings,
    Stamp,
    Status,
    SynthesisEstimate,
    SynthesisReply,
    SynthesisRequest,
    Tare,
    TareRequest,
    TensorInfo,
    WrenchFrame,
    WrenchZero,
    WrenchZeroRequest,
)


def _floats(*values: float) -> Any:
    return np.array(values, np.float32)


@pytest.fixture(scope="session")
def examples() -> dict[str, Any]:
    """Message name -> a valid value, the same on every machine."""
    stamp = Stamp(
        sequence=41,
        device_tick=1042,
        monotonic_ns=9_876_543_210,
        wall_ns=1_763_719_200_123_456_789,
        clock_id=0xC10C1D,
        origin=Origin.SIMULATED,
        missed_before=2,
    )
    digest, mesh = bytes(range(32)), bytes(range(32, 64))
    nodes = np.linspace(-0.001, 0.002, 12, dtype=np.float32).reshape(4, 3)
    pose = Pose((0.001, -0.002, -0.0093), (1.0, 0.0, 0.0, 0.0))
    step = SimulationStep(
        pose,
        np.array([0.1, -0.2, 3.0]),
        np.array([0.01, 0.02, 0.03]),
        1750.5,
        nodes,
        nodes * 10,
        4.5e-6,
        np.array([0.001, -0.002, -0.0093]),
        SimulationConvergence(2, 9, 11, 1e-9, 2e-12, 3e-6, 0.25),
    )
    progress = SimulationProgress("r-1", 3, 20, 1.25, SimulationPhase.INDENTING, 2)
    frame = ElectrodeFrame(
        stamp,
        "BT000123",
        SensorType.BIOTAC,
        np.arange(19, dtype=np.uint16) * 100 + 2000,
        1297,
        np.arange(22, dtype=np.uint16) + 2030,
        2050,
        1912,
        (1 << 44) - 2,
        227_273,
        0xFEED,
    )
    return {
        "ElectrodeFrame": frame,
        "WrenchFrame": WrenchFrame(
            stamp, "FT-7", _floats(0.5, -0.25, 4.0), _floats(0.01, -0.02, 0.0), True
        ),
        "IndenterPoseFrame": IndenterPoseFrame(
            stamp,
            "sphere_3-5mm",
            np.array([0.001, -0.002, -0.0093]),
            np.array([0.5, 0.5, -0.5, 0.5]),
            True,
        ),
        "RobotPoseFrame": RobotPoseFrame(
            "left_arm", 41, 9_876_543_210, pose, 0xFACE, 1_763_719_200_123_456_789
        ),
        "FieldFrame": FieldFrame(stamp, "BT000123", mesh, nodes),
        "FeatureEstimate": FeatureEstimate(
            stamp,
            "BT000123",
            digest,
            0xFEED,
            True,
            _floats(0.5, -0.25, 4.0),
            _floats(0.1, 0.1, 0.2),
            _floats(0.001, -0.002, -0.009),
            _floats(0.0005, 0.0006, 0.0007),
        ),
        "FieldEstimate": FieldEstimate(
            stamp,
            "BT000123",
            digest,
            0xFEED,
            mesh,
            nodes,
            _floats(1e-5, 2e-5, 3e-5, 4e-5),
            nodes * 100,
        ),
        "SynthesisEstimate": SynthesisEstimate(
            stamp,
            "BT000123",
            digest,
            mesh,
            np.linspace(-400, 50, 19, dtype=np.float32),
            np.full(19, 3, np.float32),
        ),
        "Tare": Tare(
            0xFEED,
            stamp,
            "BT000123",
            np.linspace(2900, 3400, 19, dtype=np.float32),
            np.full(19, 0.5, np.float32),
            1297.5,
            2040.25,
            2050.0,
            1912.0,
            50,
        ),
        "TareRequest": TareRequest(0xFEED, 50, "asked by one", anyway=True),
        "WrenchZeroRequest": WrenchZeroRequest(100),
        "WrenchZero": WrenchZero(
            "FT-7",
            "Weiss KMS 40 at 192.168.1.30",
            9_876_543_210,
            1_763_719_200_123_456_789,
            _floats(0.5, -0.25, 4.0),
            _floats(0.01, -0.02, 0.0),
            _floats(0.0, 0.001, -0.002),
            _floats(0.0, 0.0, 0.0001),
            100,
        ),
        "FieldRequest": FieldRequest("finger", frame),
        "ServiceRequest": ServiceRequest(),
        "Status": Status(
            "features",
            "features",
            ServiceState.DEGRADED,
            9_876_543_210,
            1_763_719_200_123_456_789,
            12.5,
            "0.1.0",
            {"frames_received": 100},
            {"latency_p50_s": 0.0009},
            ("finger",),
            "1 frame dropped",
            ErrorReply(ErrorCode.DISK, "disk full", "free space", 0.5),
        ),
        "ModelMetadata": ModelMetadata(
            "features-virtual",
            1,
            "features",
            digest,
            1,
            (TensorInfo("electrodes", "float32", (-1, 19), "tared counts"),),
            (TensorInfo("force", "float32", (-1, 3), "N"),),
            "ab" * 32,
            {"force_magnitude_median_n": 0.1},
            "the virtual finger",
        ),
        "ModelCommand": ModelCommand(
            ModelAction.LOAD,
            "lab",
            "features",
            bytes(range(16)),
            1_763_719_200_123_456_789,
            bundle="features-twin:2",
            sensor="finger",
        ),
        "ModelRequest": ModelRequest(b"the bytes of a command", bytes(range(32))),
        "ModelInventory": ModelInventory(
            "features",
            (
                ServedModel("", "", 0, b"", 1_763_719_200_123_456_789, "features-twin:1"),
                ServedModel("finger", "features-twin", 2, digest, 1_763_719_200_123_456_789),
            ),
            ("features-twin:1", "features-twin:2"),
            0.25,
        ),
        "Error": ErrorReply(ErrorCode.RESOURCE_EXHAUSTED, "queue full", "ask later", 0.25),
        "SimulationRequest": SimulationRequest(
            "r-1",
            "sphere_3-5mm",
            (pose, Pose((0.0, 0.0, -0.007), (0.0, 1.0, 0.0, 0.0))),
            SimulationParameters(skin_thickness_m=0.00157, friction_coefficient=0.186),
            8.0,
            True,
            False,
        ),
        "SimulationProgress": progress,
        "SimulationReply": SimulationReply(
            "r-1",
            mesh,
            (step, step),
            "diverged at step 3",
            4.5,
            True,
            1,
            progress,
            SimulationOutcome.DIVERGED,
            0.00125,
        ),
        "SimulationCancelRequest": SimulationCancelRequest("r-1"),
        "SimulationCancelReply": SimulationCancelReply(True),
        "StageTimings": StageTimings(2**-9, 2**-14, 2**-15, 2**-16, 2**-12, 2**-13),
        "FeatureRequest": FeatureRequest("finger", frame),
        "SynthesisRequest": SynthesisRequest(
            ContactDescription("sphere_3-5mm", (0.001, -0.002, -0.0093), None, force_n=2.5),
            "twin",
            30.0,
            True,
        ),
        "SynthesisReply": SynthesisReply(
            SynthesisEstimate(
                stamp,
                "SIMULATED",
                digest,
                mesh,
                np.linspace(-400, 50, 19, dtype=np.float32),
                np.full(19, 3, np.float32),
                (QualityFlag.OUT_OF_RANGE, QualityFlag.EXTRAPOLATING),
                "synthesis-twin",
                1,
            ),
            dataclasses.replace(step, displacement=None, contact_force=None),
            7,
            SimulationOutcome.COMPLETE,
            "",
            True,
        ),
        "BasisRequest": BasisRequest(digest),
        "FieldBasis": ModeBasis(digest, mesh, nodes, np.stack([nodes, -nodes]), 3, 0, True),
    }


@pytest.fixture
def frame_of(examples: dict[str, Any]) -> Callable[..., ElectrodeFrame]:
    def make(sequence: int, **stamp: Any) -> ElectrodeFrame:
        monotonic_ns, wall_ns = clock.now()
        facts = {
            "sequence": sequence,
            "monotonic_ns": monotonic_ns,
            "wall_ns": wall_ns,
            "clock_id": clock.CLOCK_ID,
        }
        frame: ElectrodeFrame = examples["ElectrodeFrame"]
        return dataclasses.replace(
            frame, stamp=dataclasses.replace(frame.stamp, **{**facts, **stamp})
        )

    return make


@pytest.fixture
def wait_until() -> Callable[..., None]:
    def wait(condition: Callable[[], object], timeout_s: float = 20.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "did not happen in time"
            time.sleep(0.01)

    return wait


@pytest.fixture
def pair(link: LinkConfig) -> Iterator[tuple[Session, Session]]:
    """Two sessions on one bus, linked directly, so that no message changes its way meanwhile."""
    with Session.open(link) as a, Session.open(link) as b:
        deadline = time.monotonic() + 2.0
        while b._raw.info.zid() not in a._raw.info.peers_zid() and time.monotonic() < deadline:
            time.sleep(0.01)
        yield a, b


@pytest.fixture
def finger(link: LinkConfig, frame_of: FrameOf, examples: dict[str, Any]) -> Iterator[Finger]:
    with Session.open(link) as session:
        finger = Finger(session, frame_of, examples["FeatureEstimate"])
        yield finger
        finger.close()
