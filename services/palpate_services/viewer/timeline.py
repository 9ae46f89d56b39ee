"""What is drawn of one sensor: messages sorted into rows, estimates matched with their truth.

Free of any drawing library, so that ``record_view`` and ``plot`` remain thin.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from palpate.bus.topics import TOPICS
from palpate.errors import WireError
from palpate.files.record import RecordItem
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    FloatArray,
    IndenterPoseFrame,
    SensorType,
    Stamp,
    SynthesisEstimate,
    Tare,
    WrenchFrame,
    as_field_frame,
)
from palpate_services.viewer.truth import LEAST_N, MatchedMessages, TruthMatcher, Values

_log = logging.getLogger(__name__)

_LEFT_OUT = {
    "view_no_mesh": "fields are not shown, as no bundle has their mesh",
    "view_wrong_mesh": "fields are not shown, as they have other nodes than their mesh",
    "view_rejected": "messages break the contract and are left out",
}


def message_of(item: RecordItem, counts: Counter[str]) -> Any:
    """The message of a record's item; None if it breaks the contract: counted, ``view_rejected``.

    The recorder keeps such payloads, so that their cause can be found.
    """
    try:
        return TOPICS[item.address.topic].codec.decode(item.payload)
    except WireError:
        counts["view_rejected"] += 1
        return None


def tell_left_out(path: Path, counts: Mapping[str, int]) -> None:
    """Say in the log what a view or a table does not show, and why."""
    for name, why in _LEFT_OUT.items():
        if counts.get(name):
            _log.warning("%s: %d %s", path, counts[name], why)


DRAW_PERIOD_NS = 200_000_000
"""At most five fields a second are drawn, by their stamps: each costs 16 bytes a vertex."""

VISIBLE_M = 2e-5
"""A field is drawn only if it differs by this from the last one [m]: 1 % of the colour scale."""


@dataclass(frozen=True, slots=True)
class FieldRow:
    """One field to draw.

    Attributes:
        time_ns: Wall clock [ns since the Unix epoch].
        sequence: Sequence number of its frame.
        mesh_sha256: Content hash of its mesh.
        displacement: Nodal displacement [m], shape ``(V, 3)``.
    """

    time_ns: int
    sequence: int
    mesh_sha256: bytes
    displacement: FloatArray


class FieldThinner:
    """Leaves out fields of one stream that come too fast or that look like the last one drawn."""

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
        last = self._drawn
        if (
            last is not None
            and row.mesh_sha256 == last.mesh_sha256
            and row.displacement.shape == last.displacement.shape
            and float(np.abs(row.displacement - last.displacement).max()) < VISIBLE_M
        ):
            return None
        self._drawn = row
        return row


_NOWHERE = np.full(3, np.nan)

_MM_PER_M = 1e3
"""Rerun shows 0.0012 m as 0.00 on its axis; people read a fingertip in millimetres."""


@dataclass(frozen=True, slots=True)
class TimelineRow:
    """One quantity at one instant.

    Attributes:
        time_ns: Wall clock [ns since the Unix epoch].
        sequence: Sequence number of its frame.
        values: The quantity, shape ``(n,)``; None = there is none (no contact).
        at: Where a force acts [m], shape ``(3,)``; None = unknown or no contact.
        slot_period_ns: Time between two slots of the frame [ns].
    """

    time_ns: int
    sequence: int
    values: Any
    at: Values | None = None
    slot_period_ns: int = 0


class SensorTimeline:
    """Sorts the messages of one sensor into rows to draw."""

    TOPICS: ClassVar[frozenset[str]] = frozenset(
        {"electrodes", "tare", "wrench", "pose", "features", "field", "field_truth", "synthesis"}
    )

    def __init__(self) -> None:
        self._rows: defaultdict[str, list[Any]] = defaultdict(list)
        self._matcher = TruthMatcher()
        self._tares: dict[int, Tare] = {}
        self._thinners = {"truth": FieldThinner(), "estimate": FieldThinner()}
        self.pending = False
        self.has_fields = False
        self.has_tared = False
        self.sensor_type = SensorType.BIOTAC
        """Type of the last frame; before the first one the most common type."""

    def add(self, message: Any) -> None:
        """Take one decoded message."""
        if isinstance(message, Tare):
            self._tares[message.tare_id] = message
            return
        self.pending = True
        if isinstance(message, ElectrodeFrame):
            self._add_frame(message)
        elif isinstance(message, FeatureEstimate):
            self._add_estimate(message)
        elif isinstance(message, WrenchFrame):
            self._rows["force/truth"].append(_row(message.stamp, message.force))
            for match in self._matcher.add(message):
                self._add_true_arrow(match)
                self._add_force_error(match)
                if match.pose is not None and match.pose.in_contact is None:
                    self._add_location_error(match)  # only the force says whether it is touched
        elif isinstance(message, IndenterPoseFrame):
            position = None if message.in_contact is False else message.position
            self._rows["location/truth"].append(_row(message.stamp, position))
            for match in self._matcher.add(message):
                self._add_true_arrow(match)
                self._add_location_error(match)
        elif isinstance(message, FieldFrame):
            self._add_field("truth", message)
        elif isinstance(message, FieldEstimate):
            self._add_field("estimate", as_field_frame(message))
        elif isinstance(message, SynthesisEstimate):
            self.has_fields = True
            self._rows["synthesised"].append(_row(message.source, message.tared_counts))

    def take(self) -> defaultdict[str, list[Any]]:
        """The rows since the last call, by what they show.

        ``electrodes/raw`` or ``electrodes/tared``: counts, float32, shape ``(19,)`` (SP: 24); NaN
        where not valid.
        ``pressure``: PDC followed by the PAC samples [counts], float32, shape ``(23,)`` (SP: 28);
        NaN where not valid. Of ``truth`` and ``estimate`` each: ``force/...`` [N], shape ``(3,)``;
        ``arrow/...``, the same at instants when it is known where it acts, or that nothing touches;
        ``location/...`` [m], shape ``(3,)`` or None; ``field/...``, each a ``FieldRow``.
        ``error/force`` [N] and ``error/location_mm`` [mm]: magnitudes, shape ``(1,)``; with
        ``/bound`` what the estimate says that they may be, NaN where it does not.
        ``synthesised``: tared counts synthesised from a field, shape ``(19,)``.
        """
        rows, self._rows, self.pending = self._rows, defaultdict(list), False
        return rows

    def _add_frame(self, frame: ElectrodeFrame) -> None:
        self.sensor_type = frame.sensor_type
        tare = self._tares.get(frame.tare_id) if frame.tare_id != NO_TARE else None
        if tare is None or tare.electrodes.shape != frame.electrodes.shape:
            kind, counts = "raw", frame.electrodes.astype(np.float32)
        else:
            kind, counts = "tared", frame.electrodes - tare.electrodes
            self.has_tared = True
        pressure = np.concatenate([[frame.pdc], frame.pac]).astype(np.float32)
        layout = frame.sensor_type.layout
        if frame.validity != layout.all_valid:
            valid = np.array([frame.validity >> bit & 1 for bit in range(layout.slots)], bool)
            counts[~valid[: layout.electrodes]] = np.nan
            pressure[~valid[[layout.pdc_bit, *range(layout.first_pac_bit, layout.slots)]]] = np.nan
        self._rows[f"electrodes/{kind}"].append(_row(frame.stamp, counts))
        row = _row(frame.stamp, pressure, slot_period_ns=frame.slot_period_ns)
        self._rows["pressure"].append(row)

    def _add_estimate(self, estimate: FeatureEstimate) -> None:
        (match,) = self._matcher.add(estimate)
        location = estimate.contact_location
        # The centre of pressure is where the force acts; the location may be off the skin.
        acts_at = location if estimate.centre_of_pressure is None else estimate.centre_of_pressure
        row = _row(estimate.source, estimate.force, at=acts_at)
        self._rows["force/estimate"].append(row)
        self._rows["arrow/estimate"].append(row)
        self._rows["location/estimate"].append(_row(estimate.source, location))
        self._add_force_error(match)
        self._add_location_error(match)
        if (bounds := estimate.bounds) is not None:
            place = bounds.contact_location
            for what, bound in (
                ("force", bounds.force),
                ("location_mm", None if place is None else _MM_PER_M * place),
            ):
                # A gap in the line where there is none.
                values = np.array([np.nan if bound is None else bound])
                self._rows[f"error/{what}/bound"].append(_row(estimate.source, values))

    def _add_field(self, name: str, known: FieldFrame) -> None:
        self.has_fields = True
        row = self._thinners[name].row(known)
        if row is not None:
            self._rows[f"field/{name}"].append(row)

    def _add_true_arrow(self, match: MatchedMessages) -> None:
        """The true force at the instant of a pose."""
        if match.estimate is None and match.wrench is not None and match.pose is not None:
            untouched = match.pose.in_contact is False
            at = None if untouched else _acts_near(match.wrench, match.pose)
            self._rows["arrow/truth"].append(_row(match.pose.stamp, match.wrench.force, at=at))

    def _add_force_error(self, match: MatchedMessages) -> None:
        self._add_error("force", match, match.force_error())

    def _add_location_error(self, match: MatchedMessages) -> None:
        error = match.location_error()
        if error is None and match.pose is not None and match.touched is not None:
            error = _NOWHERE  # a gap in the line, not a line across the time without contact
        self._add_error("location_mm", match, None if error is None else _MM_PER_M * error)

    def _add_error(self, what: str, match: MatchedMessages, error: Values | None) -> None:
        if error is not None and match.estimate is not None:
            row = _row(match.estimate.source, np.array([np.linalg.norm(error)]))
            self._rows[f"error/{what}"].append(row)


def line_of_action(wrench: WrenchFrame) -> tuple[Values, Values] | None:
    """A point [m] and the direction of the line along which a wrench acts, each ``(3,)``.

    None where it says no line: without a force, or without a torque (a sensor of forces only).
    """
    force, torque = wrench.force.astype(np.float64), np.asarray(wrench.torque, np.float64)
    size = float(np.linalg.norm(force))
    if size < LEAST_N or not torque.any():
        return None
    return np.cross(force, torque) / size**2, force / size


def _acts_near(wrench: WrenchFrame, pose: IndenterPoseFrame) -> Values:
    """Where the true force acts [m], shape ``(3,)``: its line's point beside the indenter's tip."""
    line = line_of_action(wrench)
    if line is None:
        return pose.position
    through, along = line
    return np.asarray(through + ((pose.position - through) @ along) * along)


def _row(
    stamp: Stamp, values: Any, *, at: Values | None = None, slot_period_ns: int = 0
) -> TimelineRow:
    return TimelineRow(stamp.wall_ns, stamp.sequence, values, at, slot_period_ns)
