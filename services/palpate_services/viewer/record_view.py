"""The Rerun view of a record: one ``.rrd`` from its messages, live or afterwards.

The MCAP is the record; a view is only a picture of it, and may fail. Columns are sent in batches,
which is twenty times cheaper than to log each frame. With ``layout`` and ``simulation`` the only
module that uses Rerun, whose names change with each release.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import RecordingError
from palpate.files.atomic import written_whole
from palpate.files.bundle import FieldMesh
from palpate.files.record import read_record
from palpate.messages import FloatArray
from palpate.process import require
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.layout import (
    AXES,
    FIELD_FULL_M,
    SEQUENCE,
    TIMELINE,
    SensorContents,
    electrode_shades,
    record_fixtures,
    record_layout,
)
from palpate_services.viewer.surfaces import OuterSkin, normals_of, shades
from palpate_services.viewer.timeline import (
    FieldRow,
    SensorTimeline,
    TimelineRow,
    message_of,
    tell_left_out,
)

_log = logging.getLogger(__name__)

APPLICATION = "palpate"

BATCH_MESSAGES = 200
"""Messages per sensor and stream in one batch of a review."""

ARROW_M_PER_N = 2e-3
"""Length of a force arrow [m/N]."""

_CURVES = (
    "electrodes/raw", "electrodes/tared", "error/force", "error/force/bound", "error/location_mm",
    "error/location_mm/bound", "synthesised",
)  # fmt: skip

Send = Callable[[str, list[Any], Iterable[Any]], None]


class FieldDrawer:
    """Draws fields on the skins of their meshes.

    ``counters``: ``view_no_mesh`` (fields of a mesh that no bundle holds), ``view_wrong_mesh``
    (fields with another number of nodes than their mesh).
    """

    def __init__(self, rr: Any, stream: Any, meshes: MeshLibrary) -> None:
        self.counters: Counter[str] = Counter()
        self._rr = rr
        self._stream = stream
        self._meshes = meshes
        self._skins: dict[bytes, OuterSkin] = {}
        self._begun: set[str] = set()

    def draw(self, entity: str, rows: list[FieldRow], send: Send) -> None:
        """Draw fields in order of time with ``send``; each mesh gets an entity below ``entity``."""
        for sha256, group in groupby(rows, key=lambda row: row.mesh_sha256):
            same = list(group)
            mesh = self._meshes.find(sha256)
            if mesh is None:
                self.counters["view_no_mesh"] += len(same)
                continue
            fitting = [row for row in same if row.displacement.shape == mesh.nodes.shape]
            if len(fitting) < len(same):
                self.counters["view_wrong_mesh"] += len(same) - len(fitting)
            if fitting:
                self._draw(f"{entity}/{sha256.hex()[:8]}", mesh, fitting, send)

    def _draw(self, entity: str, mesh: FieldMesh, rows: list[FieldRow], send: Send) -> None:
        skin = self._skins.get(mesh.sha256)
        if skin is None:
            skin = self._skins[mesh.sha256] = OuterSkin(mesh)
        rr = self._rr
        if entity not in self._begun:
            self._begun.add(entity)
            # Normals of the untouched skin: normals for each field would nearly double the file.
            fixed = rr.Mesh3D.from_fields(
                triangle_indices=skin.triangles,
                vertex_normals=normals_of(skin.rest, skin.triangles),
            )
            self._stream.log(entity, fixed, static=True)
        moved = np.stack([row.displacement[skin.used] for row in rows])
        colours = shades(np.linalg.norm(moved, axis=2) / FIELD_FULL_M)
        columns = rr.Mesh3D.columns(
            vertex_positions=(skin.rest + moved).reshape(-1, 3), vertex_colors=colours.reshape(-1)
        )
        send(entity, rows, columns.partition([len(skin.used)] * len(rows)))


class RerunView:
    """Writes one ``.rrd``, which is closed at ``max_bytes``. Use from one thread.

    Without a ``path`` there is no file, but ``take`` returns what has been drawn; views with one
    ``recording_id`` are then one recording to the viewer, whose layout shows ``known``, too.
    ``title`` is shown as the recording's name, and errors call the file ``named``; ``meshes``
    None = those of the packaged bundles. A ``live`` view may go on for days and takes less. Of the
    PAC samples, 2,200 a second and sensor, it draws the smallest and the largest of each frame. It
    has no footer, whose parts Rerun would keep in memory until the end, 5 MB a minute; viewers read
    the whole file instead.
    """

    def __init__(
        self,
        path: Path | None,
        *,
        title: str,
        max_bytes: int | None = None,
        meshes: MeshLibrary | None = None,
        live: bool = False,
        recording_id: str | None = None,
        known: Mapping[str, SensorContents] | None = None,
        named: Path | None = None,
    ) -> None:
        self._rr = require("rerun", extra="services")
        self._live = live
        self.path = path
        self._named = named or path
        self.full = False
        self._max_bytes = max_bytes
        self._scenes: dict[str, SensorTimeline] = {}
        self._drawn: dict[str, SensorContents] = {}
        self.contents: Mapping[str, SensorContents] = dict(known or {})
        """What the layout shows, by sensor."""
        self._layout = b""
        self._drawn_bytes: Any = None  # Rerun's, of a view without a file
        self._stream = self._rr.RecordingStream(APPLICATION, recording_id=recording_id)
        library = MeshLibrary() if meshes is None else meshes
        self._fields = FieldDrawer(self._rr, self._stream, library)
        self._open = False
        self._title = title

    def __enter__(self) -> RerunView:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            with contextlib.suppress(RecordingError):  # not instead of the error that there is
                self._disconnect()

    @property
    def counters(self) -> Counter[str]:
        """Counts of what could not be drawn, see ``FieldDrawer``."""
        return self._fields.counters

    def add(self, sensor: str, message: Any) -> None:
        """Take one message of ``SensorTimeline.TOPICS``; it is drawn with the next ``flush``."""
        if self.full:
            return
        scene = self._scenes.get(sensor)
        if scene is None:
            scene = self._scenes[sensor] = SensorTimeline()
        scene.add(message)

    def flush(self) -> None:
        """Draw the messages since the last call.

        Raises:
            RecordingError: Rerun cannot write the file.
        """
        fresh = [name for name, scene in self._scenes.items() if scene.pending]
        if not fresh or self.full:
            return
        try:
            self._prepare(fresh)
            for sensor in fresh:
                self._draw(sensor, self._scenes[sensor])
        except Exception as error:  # Rerun's errors share no base of their own
            raise self._unwritable(error) from error
        if self._max_bytes is not None and self.size() > self._max_bytes:
            _log.warning("%s has reached %d bytes and is closed", self.path, self._max_bytes)
            self.close()
            self.full = True

    def take(self) -> tuple[bytes, bytes]:
        """Of a view without a file, since the last call: what was drawn, and the layout if changed.

        Both are complete: an ``.rrd`` and an ``.rbl``; empty = nothing.
        """
        drawn = b"" if self._drawn_bytes is None else self._drawn_bytes.read() or b""
        layout, self._layout = self._layout, b""
        return drawn, layout

    def size(self) -> int:
        """Bytes on disk so far."""
        if self.path is None:
            return 0
        try:
            return self.path.stat().st_size
        except FileNotFoundError:
            return 0

    def close(self) -> None:
        """Draw the rest and close the file.

        Raises:
            RecordingError: Rerun cannot write it.
        """
        if self.full:
            return
        self.flush()
        self._disconnect()

    def _disconnect(self) -> None:
        if not self._open:
            return
        self._open = False
        try:
            self._stream.flush(timeout_sec=5.0)
        except Exception as error:  # of a full disk, too
            raise self._unwritable(error) from error
        finally:
            self._stream.disconnect()

    def _unwritable(self, error: Exception) -> RecordingError:
        return RecordingError(
            f"{self._named}: Rerun cannot write the view: {error}",
            remedy="check the folder's rights and free space; the MCAP record is not affected, and "
            "palpate review makes a view of it",
        )

    def _prepare(self, sensors: list[str]) -> None:
        drawn = dict(self._drawn)
        for sensor in sensors:
            scene = self._scenes[sensor]
            drawn[sensor] = SensorContents(scene.sensor_type, scene.has_tared, scene.has_fields)
        before, self._drawn = self._drawn, drawn
        if drawn == before:
            return
        contents = {**self.contents}
        for sensor, one in drawn.items():
            had = contents.get(sensor, one)
            contents[sensor] = SensorContents(
                one.kind, one.tared or had.tared, one.fields or had.fields
            )
        layout = record_layout(dict(sorted(contents.items())))
        if self.path is None:
            if not self._open:
                self._drawn_bytes = self._stream.binary_stream()
            if contents != self.contents:
                self._layout = _layout_bytes(layout)
        elif self._open:
            self._stream.send_blueprint(layout)
        else:
            self._stream.save(self.path, layout, write_footer=not self._live)
        self.contents = contents
        if not self._open:
            self._stream.send_recording_name(self._title)
            self._open = True
        for sensor in sensors:
            kind, known = drawn[sensor].kind, before.get(sensor)
            if known is None or known.kind is not kind:
                for entity, value in record_fixtures(kind):
                    self._stream.log(f"{sensor}/{entity}", value, static=True)

    def _draw(self, sensor: str, timeline: SensorTimeline) -> None:
        rr = self._rr
        rows = timeline.take()
        for name in _CURVES:
            for same in _of_one_width(rows[name]):
                values = np.stack([row.values for row in same])
                self._send(f"{sensor}/{name}", same, rr.Scalars.columns(scalars=values))
        for tared in _of_one_width(rows["electrodes/tared"]):
            shades = electrode_shades(np.stack([frame.values for frame in tared]))
            count = shades.shape[1]
            columns = rr.Points3D.columns(colors=shades.reshape(-1)).partition([count] * len(tared))
            self._send(f"{sensor}/finger/electrodes", tared, columns)
        for pressure in _of_one_width(rows["pressure"]):
            pdc = np.array([row.values[0] for row in pressure], np.float64)
            self._send(f"{sensor}/pdc", pressure, rr.Scalars.columns(scalars=pdc))
            self._send_pac(f"{sensor}/pac", pressure)
        for name in ("truth", "estimate"):
            if forces := rows[f"force/{name}"]:
                force = np.stack([row.values for row in forces]).astype(np.float64)
                for axis, values in zip(AXES, force.T, strict=True):
                    columns = rr.Scalars.columns(scalars=values)
                    self._send(f"{sensor}/force/{axis}/{name}", forces, columns)
            # Force on the skin, ending where the finger is pressed.
            arrows = rows[f"arrow/{name}"]
            vectors = [ARROW_M_PER_N * row.values for row in arrows if row.at is not None]
            ends = [row.at for row in arrows if row.at is not None]
            parts = {"vectors": _points(vectors), "origins": _points(ends) - _points(vectors)}
            there = [row.at is not None for row in arrows]
            columns = rr.Arrows3D.columns(**parts)
            self._send_some(f"{sensor}/finger/force/{name}", arrows, there, columns)
            places = rows[f"location/{name}"]
            points = _points([row.values for row in places if row.values is not None])
            there = [row.values is not None for row in places]
            columns = rr.Points3D.columns(positions=points)
            self._send_some(f"{sensor}/finger/contact/{name}", places, there, columns)
            self._fields.draw(f"{sensor}/field/{name}", rows[f"field/{name}"], self._send)

    def _send_some(
        self, entity: str, rows: list[TimelineRow], there: list[bool], columns: Any
    ) -> None:
        """Send columns that have a value only in some of the rows."""
        if rows:
            self._send(entity, rows, columns.partition(np.array(there, int)))

    def _send_pac(self, entity: str, rows: list[TimelineRow]) -> None:
        """PAC samples at their own times: electrode, PAC, electrode, PAC, ..."""
        samples = np.stack([row.values[1:] for row in rows]).astype(np.float64)
        shown = np.tile(np.arange(samples.shape[1]), (len(rows), 1))
        if self._live:
            shown = _extremes(samples)
        begin_ns = np.array([[row.time_ns] for row in rows], np.int64)
        period_ns = np.array([[row.slot_period_ns] for row in rows], np.int64)
        times_ns = begin_ns + (2 * shown + 1) * period_ns
        sequence = np.repeat([row.sequence for row in rows], shown.shape[1])
        values = np.take_along_axis(samples, shown, axis=1)
        columns = self._rr.Scalars.columns(scalars=values.reshape(-1))
        self._send_at(entity, times_ns.reshape(-1), sequence, columns)

    def _send(self, entity: str, rows: list[Any], columns: Iterable[Any]) -> None:
        times_ns = np.array([row.time_ns for row in rows], np.int64)
        self._send_at(entity, times_ns, [row.sequence for row in rows], columns)

    def _send_at(self, entity: str, times_ns: Any, sequence: Any, columns: Iterable[Any]) -> None:
        rr = self._rr
        times = [
            rr.TimeColumn(TIMELINE, timestamp=times_ns.astype("datetime64[ns]")),
            rr.TimeColumn(SEQUENCE, sequence=sequence),
        ]
        self._stream.send_columns(entity, times, columns)


def _layout_bytes(layout: Any) -> bytes:
    """A layout as Rerun's ``.rbl``, which it writes into files only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layout.rbl"
        layout.save(APPLICATION, path)
        return path.read_bytes()


def _extremes(samples: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Where the smallest and the largest of each row are, in order of time, shape ``(N, 2)``."""
    least = np.where(np.isnan(samples), np.inf, samples).argmin(axis=1)
    most = np.where(np.isnan(samples), -np.inf, samples).argmax(axis=1)
    return np.sort(np.stack([least, most], axis=1), axis=1)


def _points(values: list[Any]) -> FloatArray:
    return np.array(values, np.float32).reshape(-1, 3)


def _of_one_width(rows: list[TimelineRow]) -> list[list[TimelineRow]]:
    """Rows by their number of values: two kinds where a finger was exchanged for an SP."""
    widths = dict.fromkeys(len(row.values) for row in rows)
    return [[row for row in rows if len(row.values) == width] for width in widths]


def review(record: Path, view: Path | None = None, *, bundles: Sequence[str] = ()) -> Path:
    """Make the view of an existing record, by default beside it with the ending ``.rrd``.

    It is written whole or not at all; one that is there is replaced. ``bundles`` hold meshes of its
    fields, beside the packaged ones. What is left out is told in the log. Returns the view's path.

    Raises:
        ConfigError: One of ``bundles`` does not exist.
        RecordingError: The record is truncated or not palpate's, or has nothing that is drawn.
        DatasetError: The disk refused.
        MissingExtraError: Rerun is not installed.
    """
    target = record.with_suffix(".rrd") if view is None else view
    meshes = MeshLibrary(bundles)
    with (
        written_whole(target) as part,
        RerunView(part, title=record.stem, meshes=meshes, named=target) as drawn,
    ):
        for count, item in enumerate(read_record(record), start=1):
            if item.address.topic in SensorTimeline.TOPICS:
                message = message_of(item, drawn.counters)
                if message is not None:
                    drawn.add(item.address.sensor, message)
            if count % (BATCH_MESSAGES * len(SensorTimeline.TOPICS)) == 0:
                drawn.flush()
        drawn.close()
        if not part.exists():
            raise RecordingError(
                f"{record} holds nothing that a view shows",
                remedy="give a record with frames or estimates: palpate info",
            )
    tell_left_out(target, drawn.counters)
    return target
