"""What a device yields: readings in the device's own time, before the gateway adds its facts.

A device knows its tick and its time; sequence numbers, host clocks and tares are the gateway's.
What a driver knows of when things arrived it tells by ``heard``; see ``timing.clock_map``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import CountArray, FloatArray
from palpate_gateway.timing.clock_map import Heard


@dataclass(frozen=True, slots=True)
class ElectrodeReading:
    """One sampling round of a BioTac, raw.

    Attributes:
        tick: The device's own unwrapped frame counter.
        time_s: The device's time at the first slot [s], from an origin of its own.
        missed_before: Frames the device is known to have lost directly before this one.
        electrodes: Raw counts E1..E19, uint16, shape ``(19,)`` (SP: 24).
        pdc: Raw static pressure [counts].
        pac: Raw dynamic pressure in order of sampling [counts], uint16, shape ``(22,)`` (SP: 27);
            a sample that was lost leaves its place, invalid.
        tac: Raw dynamic temperature [counts].
        tdc: Raw static temperature [counts].
        validity: Bit set = channel good; the order is that of ``ElectrodeFrame.validity``.
        heard: What arrived last of the device; None = this reading.
    """

    tick: int
    time_s: float
    missed_before: int
    electrodes: CountArray
    pdc: int
    pac: CountArray
    tac: int
    tdc: int
    validity: int
    heard: Heard | None = None


@dataclass(frozen=True, slots=True)
class WrenchReading:
    """One reading of a force/torque sensor.

    Attributes:
        tick: The device's own unwrapped counter.
        time_s: The device's time [s].
        force: Force on the BioTac [N], sensor frame, float32, shape ``(3,)``.
        torque: Torque on the BioTac about the sensor frame's origin [N m], shape ``(3,)``.
        serial: Serial number of the force/torque sensor.
        overload: The device says its range is exceeded.
        heard: What arrived last of the device; None = this reading.
    """

    tick: int
    time_s: float
    force: FloatArray
    torque: FloatArray
    serial: str
    overload: bool = False
    heard: Heard | None = None


@dataclass(frozen=True, slots=True)
class PoseReading:
    """Where the indenter is.

    Attributes:
        tick: The device's own unwrapped counter.
        time_s: The device's time [s].
        indenter: Standard name, e.g. ``"sphere_14mm"``.
        position: Tip of the indenter [m], sensor frame, float64, shape ``(3,)``.
        orientation: Unit quaternion w x y z of the indenter in the sensor frame, shape ``(4,)``.
        in_contact: Whether it touches the skin; None = the source cannot know.
        missed_before: Poses known to have been lost directly before this one.
        heard: What arrived last of the device; None = this reading.
    """

    tick: int
    time_s: float
    indenter: str
    position: npt.NDArray[np.float64]
    orientation: npt.NDArray[np.float64]
    in_contact: bool | None
    missed_before: int = 0
    heard: Heard | None = None


@dataclass(frozen=True, slots=True)
class FieldReading:
    """The displacement of the skin, where the source knows it.

    Attributes:
        tick: The device's own unwrapped counter.
        time_s: The device's time [s].
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], sensor frame, float32,
            shape ``(V, 3)``.
        heard: What arrived last of the device; None = this reading.
    """

    tick: int
    time_s: float
    mesh_sha256: bytes
    displacement: FloatArray
    heard: Heard | None = None


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message of a palpate record, to be published again byte for byte.

    Attributes:
        topic: Stream name, e.g. ``"electrodes"``.
        payload: The encoded message as it was recorded.
        time_s: When it was recorded [s since the Unix epoch].
    """

    topic: str
    payload: bytes
    time_s: float


Reading = ElectrodeReading | WrenchReading | PoseReading | FieldReading | RecordedMessage
