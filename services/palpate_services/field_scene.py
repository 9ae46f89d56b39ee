"""Which fields are drawn: few enough for a file of moderate size, none that the eye would miss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.messages import FieldFrame, FloatArray

DRAW_PERIOD_NS = 200_000_000
"""Fields are drawn five times a second at most, by the clock of their stamps: 16 bytes a vertex."""

VISIBLE_M = 2e-5
"""A field that differs less than this from the one drawn last is not drawn again: a hundredth of
the colour scale."""


@dataclass(frozen=True, slots=True)
class FieldRow:
    """One field to draw.

    Attributes:
        time_ns: Wall clock [ns since the Unix epoch].
        sequence: Sequence number of the reading.
        mesh_sha256: Content hash of its mesh.
        displacement: Nodal displacement [m], shape ``(V, 3)``.
    """

    time_ns: int
    sequence: int
    mesh_sha256: bytes
    displacement: FloatArray


class FieldThinner:
    """Chooses, of one stream of fields, those to draw."""

    def __init__(self) -> None:
        self._period: int | None = None
        self._drawn: FieldRow | None = None

    def row(self, field: FieldFrame) -> FieldRow | None:
        """The field as a row; None if it need not be drawn."""
        stamp = field.stamp
        period = stamp.wall_ns // DRAW_PERIOD_NS
        if period == self._period:
            return None
        self._period = period
        row = FieldRow(stamp.wall_ns, stamp.sequence, field.mesh_sha256, field.displacement)
        if self._drawn is not None and _alike(row, self._drawn):
            return None
        self._drawn = row
        return row


def _alike(one: FieldRow, other: FieldRow) -> bool:
    return (
        one.mesh_sha256 == other.mesh_sha256
        and one.displacement.shape == other.displacement.shape
        and float(np.abs(one.displacement - other.displacement).max()) < VISIBLE_M
    )
