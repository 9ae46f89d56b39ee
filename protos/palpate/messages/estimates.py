"""Estimates: pure functions of a frame, its tare and a bundle.

``source`` is the stamp of the frame that an estimate was made from, ``sensor_serial`` names that
frame's sensor, and ``bundle_sha256`` is the digest of the bundle's manifest, 32 bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

from palpate.messages.frames import FieldFrame, FloatArray, Stamp


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


@dataclass(frozen=True, slots=True)
class FieldEstimate:
    """Electrodes -> fields.

    Attributes:
        tare_id: Tare that was subtracted.
        mesh_sha256: Content hash of the mesh, 32 bytes.
        displacement: Nodal displacement from the pressurised state [m], shape ``(V, 3)``.
        displacement_sd: One standard deviation of its magnitude [m], shape ``(V,)``, or None.
        contact_force: Nodal contact force on the skin [N], shape ``(V, 3)``, or None.
    """

    source: Stamp
    sensor_serial: str
    bundle_sha256: bytes
    tare_id: int
    mesh_sha256: bytes
    displacement: FloatArray
    displacement_sd: FloatArray | None = None
    contact_force: FloatArray | None = None


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


def as_field_frame(field: FieldFrame | FieldEstimate) -> FieldFrame:
    """A field without saying whether it is known or estimated; same stamp, sensor and mesh."""
    if isinstance(field, FieldFrame):
        return field
    return FieldFrame(field.source, field.sensor_serial, field.mesh_sha256, field.displacement)
