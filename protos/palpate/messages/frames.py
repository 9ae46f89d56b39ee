"""Frames: one time-stamped reading of a sensor each, and what stands in them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """What one sampling round holds; every channel and every PAC sample has one validity bit.

    Bits: electrodes from 0, then PDC, TAC, TDC, then the PAC samples in order of sampling. PAC is
    sampled beside each of the others, so there are as many of it.

    Attributes:
        electrodes: Number of sensing electrodes.
    """

    electrodes: int

    @property
    def pdc_bit(self) -> int:
        """Validity bit of PDC."""
        return self.electrodes

    @property
    def tac_bit(self) -> int:
        """Validity bit of TAC."""
        return self.electrodes + 1

    @property
    def tdc_bit(self) -> int:
        """Validity bit of TDC."""
        return self.electrodes + 2

    @property
    def first_pac_bit(self) -> int:
        """Validity bit of the first PAC sample."""
        return self.electrodes + 3

    @property
    def pac_samples(self) -> int:
        """PAC samples in one frame."""
        return self.electrodes + 3

    @property
    def slots(self) -> int:
        """Samples in one frame, and validity bits."""
        return self.first_pac_bit + self.pac_samples

    @property
    def all_valid(self) -> int:
        """Validity of a frame whose channels are all good."""
        return (1 << self.slots) - 1

    @property
    def electrodes_valid(self) -> int:
        """Validity bits of all electrodes."""
        return (1 << self.electrodes) - 1

    def bit_name(self, bit: int) -> str:
        """Name of the channel at a validity bit, e.g. ``"E1"`` or ``"PAC[3]"``."""
        if bit < self.electrodes:
            return f"E{bit + 1}"
        if bit < self.first_pac_bit:
            return ("PDC", "TAC", "TDC")[bit - self.pdc_bit]
        return f"PAC[{bit - self.first_pac_bit}]"


BIOTAC_LAYOUT = FrameLayout(electrodes=19)
"""44 slots: E1..E19, PDC, TAC, TDC, 22 PAC."""

BIOTAC_SP_LAYOUT = FrameLayout(electrodes=24)
"""54 slots: E1..E24, PDC, TAC, TDC, 27 PAC."""


FloatArray = npt.NDArray[np.float32]
CountArray = npt.NDArray[np.uint16]
DoubleArray = npt.NDArray[np.float64]

COUNTS_MAX = 4095
"""Full scale of the 12-bit ADC [counts]."""

PAC_SAMPLES = BIOTAC_LAYOUT.pac_samples
"""PAC samples in one frame of a BioTac with 19 electrodes; of any sensor: ``SensorType.layout``."""

NO_TARE = 0
"""``tare_id`` of a frame that was taken before any tare."""


class Origin(IntEnum):
    """Where a reading comes from."""

    LIVE = 1
    SIMULATED = 2
    REPLAYED = 3


class SensorType(IntEnum):
    """The kind of tactile sensor."""

    BIOTAC = 1
    BIOTAC_SP = 2

    @property
    def layout(self) -> FrameLayout:
        """Electrodes, PAC samples and validity bits of its frames."""
        return BIOTAC_LAYOUT if self is SensorType.BIOTAC else BIOTAC_SP_LAYOUT


_ELECTRODES_VALID = {kind: kind.layout.electrodes_valid for kind in SensorType}


@dataclass(frozen=True, slots=True)
class Pose:
    """Position [m] and unit quaternion w x y z; sensor frame unless its name says another."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Stamp:
    """When and where one reading was taken.

    Attributes:
        sequence: Contiguous per sensor and gateway run, from 1; a hole = lost on the bus.
        device_tick: The device's own unwrapped counter.
        monotonic_ns: Host monotonic clock at the first slot of the frame [ns].
        wall_ns: Host wall clock at the same instant [ns since the Unix epoch].
        clock_id: Names the monotonic clock; one value per host and boot.
        origin: Live, simulated or replayed.
        missed_before: Frames the device is known to have lost directly before this one.
        session_id: Names the run of the gateway; 0 = unknown: an older gateway, or a log played as
            fast as possible. A replayed record keeps the value of the run that was recorded.
    """

    sequence: int
    device_tick: int
    monotonic_ns: int
    wall_ns: int
    clock_id: int
    origin: Origin
    missed_before: int = 0
    session_id: int = 0


@dataclass(frozen=True, slots=True)
class ElectrodeFrame:
    """One sampling round of a BioTac: raw 12-bit counts, nothing subtracted.

    Attributes:
        sensor_type: Fixes the numbers of electrodes and PAC samples.
        electrodes: Raw counts E1..E19, uint16, shape ``(19,)`` (SP: E1..E24, 24).
        pdc: Raw static pressure [counts].
        pac: Raw dynamic pressure in order of sampling [counts], uint16, shape ``(22,)`` (SP: 27).
            A sample that was lost leaves its place, invalid; the others keep theirs.
        tac: Raw dynamic temperature [counts].
        tdc: Raw static temperature [counts].
        validity: Bit set = channel good, as ``sensor_type.layout`` numbers them: electrodes from
            bit 0, then PDC, TAC, TDC, then PAC.
        slot_period_ns: Time between two slots [ns].
        tare_id: The tare in force; ``NO_TARE`` = none.
    """

    stamp: Stamp
    sensor_serial: str
    sensor_type: SensorType
    electrodes: CountArray
    pdc: int
    pac: CountArray
    tac: int
    tdc: int
    validity: int
    slot_period_ns: int
    tare_id: int = NO_TARE

    @property
    def electrodes_valid(self) -> bool:
        """Whether every electrode of this frame is good."""
        mask = _ELECTRODES_VALID[self.sensor_type]
        return self.validity & mask == mask


@dataclass(frozen=True, slots=True)
class WrenchFrame:
    """One reading of a force/torque sensor.

    Attributes:
        sensor_serial: Serial number of the force/torque sensor.
        force: Force on the BioTac [N], sensor frame, float32, shape ``(3,)``.
        torque: Torque on the BioTac about the sensor frame's origin [N m], shape ``(3,)``.
        overload: The device says its range is exceeded.
    """

    stamp: Stamp
    sensor_serial: str
    force: FloatArray
    torque: FloatArray
    overload: bool = False


@dataclass(frozen=True, slots=True)
class IndenterPoseFrame:
    """Where the indenter is.

    Attributes:
        indenter: Standard name, e.g. ``"sphere_3-5mm"``.
        position: Tip of the indenter [m], sensor frame, float64, shape ``(3,)``.
        orientation: Unit quaternion w x y z of the indenter in the sensor frame, shape ``(4,)``.
        in_contact: Whether it touches the skin; None = the source cannot know (a robot's pose).
    """

    stamp: Stamp
    indenter: str
    position: npt.NDArray[np.float64]
    orientation: npt.NDArray[np.float64]
    in_contact: bool | None = False


@dataclass(frozen=True, slots=True)
class FieldFrame:
    """A displacement field that is known, not estimated: of a simulation, or other ground truth.

    Attributes:
        sensor_serial: Serial number of the BioTac whose skin is meant.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], sensor frame, float32,
            shape ``(V, 3)``.
    """

    stamp: Stamp
    sensor_serial: str
    mesh_sha256: bytes
    displacement: FloatArray


@dataclass(frozen=True, slots=True)
class RobotPoseFrame:
    """Where the flange of a robot is, in the robot's base frame, by the robot's own clock.

    Attributes:
        robot: Name of the robot, as in the key.
        sequence: Contiguous in one run of the robot's program, from 1; a hole = a pose was lost.
        time_ns: When it was there, by a monotonic clock of the program's own [ns].
        pose_base_flange: Position [m] and unit quaternion w x y z of the flange in the base.
        run_id: Another one at each start of the program; 0 = unknown.
        wall_ns: Wall clock at the same instant [ns since the Unix epoch]; 0 = unknown.
    """

    robot: str
    sequence: int
    time_ns: int
    pose_base_flange: Pose
    run_id: int = 0
    wall_ns: int = 0
