"""Messages as Python values: what the wire of ``palpate.v1`` means, with shapes and units.

SI units, sensor frame (docs/conventions.md) unless a name says otherwise. Values are frozen; arrays
are not copied on construction and must not be written to afterwards. The codec checks them.
"""

from palpate.protos.messages.estimates import (
    FeatureEstimate,
    FieldEstimate,
    SynthesisEstimate,
)
from palpate.protos.messages.frames import (
    COUNTS_MAX,
    NO_TARE,
    PAC_SAMPLES,
    CountArray,
    ElectrodeFrame,
    FloatArray,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    WrenchFrame,
)
from palpate.protos.messages.service import (
    ErrorReply,
    ModelMetadata,
    ServiceRequest,
    ServiceState,
    Status,
    Tare,
    TareRequest,
    TensorInfo,
)
from palpate.protos.messages.simulation import (
    DoubleArray,
    Pose,
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
)

__all__ = [
    "COUNTS_MAX",
    "NO_TARE",
    "PAC_SAMPLES",
    "CountArray",
    "DoubleArray",
    "ElectrodeFrame",
    "ErrorReply",
    "FeatureEstimate",
    "FieldEstimate",
    "FloatArray",
    "IndenterPoseFrame",
    "ModelMetadata",
    "Origin",
    "Pose",
    "SensorType",
    "ServiceRequest",
    "ServiceState",
    "SimulationCancelReply",
    "SimulationCancelRequest",
    "SimulationConvergence",
    "SimulationOutcome",
    "SimulationParameters",
    "SimulationPhase",
    "SimulationProgress",
    "SimulationReply",
    "SimulationRequest",
    "SimulationStep",
    "Stamp",
    "Status",
    "SynthesisEstimate",
    "Tare",
    "TareRequest",
    "TensorInfo",
    "WrenchFrame",
]
