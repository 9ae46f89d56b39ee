"""What a device yields: readings with the device's own count and time.

Sequence numbers, the host's clocks and tares are added later, by the gateway.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.messages import CountArray, FloatArray


class ClockObservation(NamedTuple):
    """One observation of a device's clock: what it showed when something of the device arrived.

    A reading may be older than what arrived with it: a BioTac's frame begins 10 ms before its last
    slot arrives, so the driver hands over the newest observation beside the reading.

    Attributes:
        device_s: Time that the device's clock showed [s].
        arrival_ns: Host monotonic clock when it arrived [ns].
    """

    device_s: float
    arrival_ns: int


@dataclass(frozen=True, slots=True)
class DeviceReading:
    """What all readings of a device have.

    Attributes:
        tick: The device's own unwrapped counter.
        time_s: The device's time [s]; the origin is the device's own.
        observed: The newest observation of the device's clock; None = this reading's own time and
            arrival.
    """

    tick: int
    time_s: float
    observed: ClockObservation | None = field(default=None, kw_only=True)


@dataclass(frozen=True, slots=True)
class ElectrodeReading(DeviceReading):
    """One sampling round of a BioTac, raw; its time is that of its first slot.

    Attributes:
        missed_before: Frames that the device lost directly before this one, as far as is known.
        electrodes: Raw counts E1..E19, uint16, shape ``(19,)`` (SP: 24).
        pdc: Raw static pressure [counts].
        pac: Raw dynamic pressure in order of sampling [counts], uint16, shape ``(22,)`` (SP: 27);
            the place of a lost sample stays, with its validity bit clear.
        tac: Raw dynamic temperature [counts].
        tdc: Raw static temperature [counts].
        validity: Bit set = channel good; the order is that of ``ElectrodeFrame.validity``.
    """

    missed_before: int
    electrodes: CountArray
    pdc: int
    pac: CountArray
    tac: int
    tdc: int
    validity: int


@dataclass(frozen=True, slots=True)
class WrenchReading(DeviceReading):
    """One reading of a force/torque sensor.

    Attributes:
        force: Force on the BioTac [N], sensor frame, float32, shape ``(3,)``.
        torque: Torque on the BioTac about the sensor frame's origin [N m], shape ``(3,)``.
        serial: Serial number of the force/torque sensor.
        overload: The device reports that its range is exceeded.
    """

    force: FloatArray
    torque: FloatArray
    serial: str
    overload: bool = False


@dataclass(frozen=True, slots=True)
class PoseReading(DeviceReading):
    """Position and orientation of the indenter.

    Attributes:
        indenter: Standard name, e.g. ``"sphere_14mm"``.
        position: Tip of the indenter [m], sensor frame, float64, shape ``(3,)``.
        orientation: Unit quaternion w x y z of the indenter in the sensor frame, shape ``(4,)``.
        in_contact: Whether it touches the skin; None = the source does not measure that.
        missed_before: Poses lost directly before this one, as far as is known.
    """

    indenter: str
    position: npt.NDArray[np.float64]
    orientation: npt.NDArray[np.float64]
    in_contact: bool | None
    missed_before: int = 0


@dataclass(frozen=True, slots=True)
class FieldReading(DeviceReading):
    """The displacement of the skin, from a source that computes it.

    Attributes:
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], sensor frame, float32,
            shape ``(V, 3)``.
    """

    mesh_sha256: bytes
    displacement: FloatArray


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message of a palpate record, to be published again byte for byte.

    Attributes:
        topic: Stream name, e.g. ``"electrodes"``.
        payload: The encoded message as it was recorded.
        time_s: When it was recorded, by a wall clock that was not set meanwhile [s since the Unix
            epoch].
    """

    topic: str
    payload: bytes
    time_s: float


Reading = ElectrodeReading | WrenchReading | PoseReading | FieldReading | RecordedMessage
