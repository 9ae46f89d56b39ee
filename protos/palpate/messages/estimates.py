"""Estimates: pure functions of a frame, its tare and a bundle.

``source`` is the stamp of the frame that an estimate was made from, ``sensor_serial`` names that
frame's sensor, and ``bundle_sha256`` is the digest of the bundle's manifest, 32 bytes; name and
version of the bundle are for people. ``quality`` holds flags in ascending order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import hypot

from palpate.messages.frames import FieldFrame, FloatArray, Stamp


@dataclass(frozen=True, slots=True)
class ValueRange:
    """Values that one input or output of a model had in the training rows.

    Attributes:
        name: Name of the tensor, e.g. ``"electrodes"``.
        unit: Unit of the values below.
        low: Smallest of each value; empty = the values have no range of their own.
        high: Largest of each value, likewise.
        length_max: Longest vector: the largest force, or the farthest that any node moved;
            0 = not known.
    """

    name: str
    unit: str
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    length_max: float = 0.0


@dataclass(frozen=True, slots=True)
class TrainingRange:
    """What a bundle was trained on.

    Attributes:
        source: One line for people.
        data_sha256: Digest of the data set, hex.
        rows: Rows of it that were trained on.
        combinations: Whether the bundle also knows which inputs occur together.
    """

    source: str
    data_sha256: str
    rows: int
    inputs: Sequence[ValueRange]
    outputs: Sequence[ValueRange]
    combinations: bool = False


class QualityFlag(IntEnum):
    """What a consumer has to know of an estimate beside its uncertainty.

    docs/adr/0021-what-an-estimate-is-worth.md says how each is decided. An estimate without flags
    has none against it.
    """

    UNKNOWN = 0
    """A flag of a newer palpate."""

    STALE = 1
    """In replies only: the frame was older than the service's limit when the question came."""

    SATURATED = 2
    """An electrode stands at an end of the converter's range: the truth lies beyond it."""

    UNTARED = 3
    """The tare may not hold any more: the temperature has moved away from the tare's."""

    OUT_OF_RANGE = 4
    """The input is unlike every input that the model was trained on."""

    EXTRAPOLATING = 5
    """The output lies beyond all that the model was trained to give."""

    RANGE_UNKNOWN = 6
    """The bundle does not say what it was trained on, so the two above cannot be known."""

    UNCALIBRATED = 7
    """The bundle was not made for this sensor: its serial number is not among the bundle's."""


@dataclass(frozen=True, slots=True)
class ErrorBounds:
    """How far an estimate may be off: bounds of its errors (docs/adr/0031-intervals.md).

    Without a quality flag each holds in ``level`` of the frames of a press, on average over presses
    like those it was calibrated on; with one it is a hint.

    Attributes:
        level: Share of the frames of a press whose error is within a bound, on average over presses
            that no training saw.
        force_magnitude: Of the length of the force [N].
        force: Of the force [N]: the length of the error's vector.
        contact_location: Of the contact location [m], a distance; None without contact, and where
            it is not known.
        displacement: Of a field [m]: the error of a node's displacement, mean over all nodes.
        other_sensors: The bundle was not made for this sensor; the bounds are what real fingers
            needed that it was not made for either.
    """

    level: float
    force_magnitude: float | None = None
    force: float | None = None
    contact_location: float | None = None
    displacement: float | None = None
    other_sensors: bool = False


UNIT_TOLERANCE = 1e-3
"""How much the length of a contact normal may differ from one."""


@dataclass(frozen=True, slots=True)
class FeatureEstimate:
    """Electrodes -> features.

    Attributes:
        tare_id: Tare that was subtracted.
        in_contact: False below the bundle's contact threshold.
        force: Net force on the BioTac [N], shape ``(3,)``.
        force_sd: One standard deviation per axis [N], shape ``(3,)``.
        contact_location: Position of the indenter's tip [m], shape ``(3,)``; None without contact
            or where the bundle does not estimate it.
        contact_location_sd: One standard deviation per axis [m], shape ``(3,)``; None likewise.
        centre_of_pressure: Mean of the touched skin, weighted by the pressure [m], shape ``(3,)``;
            None likewise.
        centre_of_pressure_sd: One standard deviation per axis [m], shape ``(3,)``; None likewise.
        contact_normal: Unit vector out of the skin where it is touched, shape ``(3,)``; None
            likewise.
        contact_normal_sd: One standard deviation of its angle [rad]; None likewise.
        bounds: How far it may be off; None where the bundle cannot say.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    in_contact: bool
    force: FloatArray
    force_sd: FloatArray
    contact_location: FloatArray | None = None
    contact_location_sd: FloatArray | None = None
    quality: tuple[QualityFlag, ...] = ()
    bundle_name: str = ""
    bundle_version: int = 0
    centre_of_pressure: FloatArray | None = None
    centre_of_pressure_sd: FloatArray | None = None
    contact_normal: FloatArray | None = None
    contact_normal_sd: float | None = None
    bounds: ErrorBounds | None = None

    @property
    def force_interval(self) -> tuple[float, float] | None:
        """Ends between which the length of the true force lies [N], by ``bounds``."""
        if self.bounds is None or self.bounds.force_magnitude is None:
            return None
        length, half = hypot(*self.force.tolist()), self.bounds.force_magnitude
        return max(0.0, length - half), length + half


@dataclass(frozen=True, slots=True)
class FieldEstimate:
    """Electrodes -> fields.

    Attributes:
        tare_id: Tare that was subtracted.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], shape ``(V, 3)``; of a
            reduced reply ``(0, 3)``.
        displacement_sd: One standard deviation of its magnitude [m], shape ``(V,)``, or None.
        contact_force: Contact force on each node of the skin [N], shape ``(V, 3)``, or None. The
            bundles that ship spread it over 1.5 mm: sums over an area are forces, those of single
            nodes are not.
        coefficients: The same displacement in the bundle's basis [m], shape ``(K,)``, or None:
            see ``ModeBasis``.
        basis_sha256: Content hash of that basis, 32 bytes; empty without coefficients.
        bounds: How far it may be off; None where the bundle cannot say.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    mesh_sha256: bytes
    displacement: FloatArray
    displacement_sd: FloatArray | None = None
    contact_force: FloatArray | None = None
    quality: tuple[QualityFlag, ...] = ()
    bundle_name: str = ""
    bundle_version: int = 0
    coefficients: FloatArray | None = None
    basis_sha256: bytes = b""
    bounds: ErrorBounds | None = None


@dataclass(frozen=True, slots=True)
class SynthesisEstimate:
    """Fields -> electrodes.

    Attributes:
        source: Stamp of the field's source.
        sensor_serial: Serial number of the sensor that is imitated.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        tared_counts: E1..E19 minus baseline [counts], shape ``(19,)`` (SP: 24).
        tared_counts_sd: One standard deviation [counts], the same shape, or None.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    mesh_sha256: bytes
    tared_counts: FloatArray
    tared_counts_sd: FloatArray | None = None
    quality: tuple[QualityFlag, ...] = ()
    bundle_name: str = ""
    bundle_version: int = 0


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Where the time went between a reading and its estimate [s]; no part of the estimate.

    Attributes:
        age_at_arrival_s: From the reading to its arrival at the service; None where the stamp says
            nothing of it (a replay, another host's clock).
        waiting_s: Between arrival and the beginning of work.
        decode_s: Bytes to message.
        tare_s: Looking up the tare and subtracting it.
        infer_s: Running the model.
        encode_s: Message to bytes.
    """

    age_at_arrival_s: float | None
    waiting_s: float
    decode_s: float
    tare_s: float
    infer_s: float
    encode_s: float


def as_field_frame(field: FieldFrame | FieldEstimate) -> FieldFrame:
    """A field without saying whether it is known or estimated; same stamp, sensor and mesh."""
    if isinstance(field, FieldEstimate):
        return FieldFrame(field.source, field.sensor_serial, field.mesh_sha256, field.displacement)
    return field
