"""The Rerun view of a record: messages in, one ``.rrd`` with an explicit layout out.

For looking only; the MCAP is the record. Columns are sent in batches, which is twenty times cheaper
than logging each frame. With ``blueprint`` and ``field_view`` the only place that knows Rerun,
whose names change with each release.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.bus.topics import TOPICS
from palpate.errors import RecordingError
from palpate.files.bundle import FieldMesh
from palpate.files.record import read_record
from palpate.messages import FloatArray, SensorType
from palpate.process import require
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.layout import (
    AXES,
    FIELD_FULL_M,
    SEQUENCE,
    TIMELINE,
    blueprint,
    electrode_shades,
    fixtures,
    normals_of,
    shades,
)
from palpate_services.viewer.timeline import FieldRow, Row, SensorScene

Send = Callable[[str, list[Any], Iterable[Any]], None]


class _Skin:
    """The outside of a mesh with its own numbering: nodes inside would only fill the file."""

    def __init__(self, mesh: FieldMesh) -> None:
        used, triangles = np.unique(mesh.outer_faces, return_inverse=True)
        self.used: npt.NDArray[np.int32] = used
        self.triangles = triangles.reshape(-1, 3).astype(np.int32)
        self.rest: FloatArray = mesh.nodes[used]


class FieldDrawer:
    """Draws fields on the skins of their meshes.

    ``counters``: ``view_no_mesh`` (fields of a mesh that no bundle holds), ``view_wrong_mesh``
    (fields with another number of nodes than their mesh).

    Args:
        rr: Rerun.
        stream: Where the parts go that do not change.
        send: Sends columns of an entity at the times of rows.
        meshes: Where meshes are found.
    """

    def __init__(self, rr: Any, stream: Any, send: Send, meshes: MeshLibrary) -> None:
        self.counters: Counter[str] = Counter()
        self._rr = rr
        self._stream = stream
        self._send = send
        self._meshes = meshes
        self._skins: dict[bytes, _Skin] = {}
        self._begun: set[str] = set()

    def draw(self, entity: str, rows: list[FieldRow]) -> None:
        """Draw the fields of one stream.

        Args:
            entity: Where, below it one entity for each mesh.
            rows: Fields in order of time.
        """
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
                self._draw(f"{entity}/{sha256.hex()[:8]}", mesh, fitting)

    def _draw(self, entity: str, mesh: FieldMesh, rows: list[FieldRow]) -> None:
        skin = self._skins.get(mesh.sha256)
        if skin is None:
            skin = self._skins[mesh.sha256] = _Skin(mesh)
        rr = self._rr
        if entity not in self._begun:
            self._begun.add(entity)
            # Normals of the untouched skin: those of each field would nearly double the file.
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
        self._send(entity, rows, columns.partition([len(skin.used)] * len(rows)))


log = logging.getLogger(__name__)

APPLICATION = "palpate"

BATCH_MESSAGES = 200
"""Messages per sensor and stream after which an offline review sends what it has."""

ARROW_M_PER_N = 2e-3
"""Length of a force arrow in the picture."""


class View:
    """Writes one ``.rrd``. Not thread-safe.

    Args:
        path: The file to write.
        title: Shown as the recording's name.
        max_bytes: From this size on nothing more is written [bytes]; None = no bound.
        meshes: Where the meshes of fields are found; None = in the packaged bundles.
    """

    def __init__(
        self,
        path: Path,
        *,
        title: str,
        max_bytes: int | None = None,
        meshes: MeshLibrary | None = None,
    ) -> None:
        self._rr = require("rerun", extra="services")
        self.path = path
        self.full = False
        self._max_bytes = max_bytes
        self._scenes: dict[str, SensorScene] = {}
        self._drawn: dict[str, SensorType] = {}
        self._with_fields: set[str] = set()
        self._stream = self._rr.RecordingStream(APPLICATION)
        library = MeshLibrary() if meshes is None else meshes
        self._fields = FieldDrawer(self._rr, self._stream, self._send, library)
        self._open = False
        self._title = title

    def __enter__(self) -> View:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._disconnect()

    @property
    def counters(self) -> Counter[str]:
        """What could not be drawn, see ``FieldDrawer``."""
        return self._fields.counters

    def add(self, sensor: str, message: Any) -> None:
        """Take one message; it is drawn with the next :meth:`flush`.

        Args:
            sensor: The sensor it belongs to.
            message: A decoded message of one of ``SensorScene.TOPICS``.
        """
        if self.full:
            return
        scene = self._scenes.get(sensor)
        if scene is None:
            scene = self._scenes[sensor] = SensorScene()
        scene.add(message)

    def flush(self) -> None:
        """Draw what has come since the last time.

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
            raise RecordingError(
                f"{self.path}: Rerun cannot write the view: {error}",
                remedy="the MCAP record is not affected; make a view of it with: palpate review",
            ) from error
        if self._max_bytes is not None and self.size() > self._max_bytes:
            log.warning("%s has reached %d bytes and is closed", self.path, self._max_bytes)
            self.close()
            self.full = True

    def size(self) -> int:
        """Bytes on disk so far."""
        try:
            return self.path.stat().st_size
        except FileNotFoundError:
            return 0

    def close(self) -> None:
        """Draw the rest and close the file."""
        if self.full:
            return
        self.flush()
        self._disconnect()

    def _disconnect(self) -> None:
        if self._open:
            self._stream.flush(timeout_sec=5.0)
            self._stream.disconnect()
            self._open = False

    def _prepare(self, sensors: list[str]) -> None:
        kinds = {sensor: self._scenes[sensor].sensor_type for sensor in sensors}
        new = [sensor for sensor in sensors if self._drawn.get(sensor) is not kinds[sensor]]
        with_fields = {sensor for sensor in sensors if self._scenes[sensor].has_fields}
        if not new and with_fields <= self._with_fields:
            return
        again = self._drawn.keys() & new
        self._drawn.update(kinds)
        self._with_fields |= with_fields
        drawn = dict(sorted(self._drawn.items()))
        layout = blueprint(drawn, with_fields=self._with_fields)
        if self._open:
            self._stream.send_blueprint(layout)
        else:
            self._stream.save(self.path, default_blueprint=layout)
            self._stream.send_recording_name(self._title)
            self._open = True
        for sensor in new:
            for entity, value in fixtures(kinds[sensor], again=sensor in again):
                self._stream.log(f"{sensor}/{entity}", value, static=True)

    def _draw(self, sensor: str, scene: SensorScene) -> None:
        rr = self._rr
        rows = scene.take()
        for kind in ("raw", "tared"):
            for frames in _of_one_width(rows.electrodes[kind]):
                values = np.stack([frame.values for frame in frames])
                self._send(
                    f"{sensor}/electrodes/{kind}", frames, rr.Scalars.columns(scalars=values)
                )
        for tared in _of_one_width(rows.electrodes["tared"]):
            shades = electrode_shades(np.stack([frame.values for frame in tared]))
            count = shades.shape[1]
            columns = rr.Points3D.columns(colors=shades.reshape(-1)).partition([count] * len(tared))
            self._send(f"{sensor}/finger/electrodes", tared, columns)
        for pressure in _of_one_width(rows.pressure):
            pdc = np.array([row.values[0] for row in pressure], np.float64)
            self._send(f"{sensor}/pdc", pressure, rr.Scalars.columns(scalars=pdc))
            self._send_pac(f"{sensor}/pac", pressure)
        for name in ("truth", "estimate"):
            self._draw_force(sensor, name, rows.force[name])
            self._draw_arrows(sensor, name, rows.arrow[name])
            self._draw_location(sensor, name, rows.location[name])
        for what, errors in rows.error.items():
            if errors:
                values = np.array([row.values[0] for row in errors])
                self._send(f"{sensor}/error/{what}", errors, rr.Scalars.columns(scalars=values))

        for name, fields in rows.fields.items():
            self._fields.draw(f"{sensor}/field/{name}", fields)
        if rows.synthesised:
            values = np.stack([row.values for row in rows.synthesised])
            columns = rr.Scalars.columns(scalars=values)
            self._send(f"{sensor}/synthesised", rows.synthesised, columns)

    def _draw_force(self, sensor: str, name: str, rows: list[Row]) -> None:
        if not rows:
            return
        rr = self._rr
        force = np.stack([row.values for row in rows])
        for at, axis in enumerate(AXES):
            columns = rr.Scalars.columns(scalars=force[:, at].astype(np.float64))
            self._send(f"{sensor}/force/{axis}/{name}", rows, columns)

    def _draw_arrows(self, sensor: str, name: str, rows: list[Row]) -> None:
        """Force on the skin, ending where the finger is pressed."""
        if not rows:
            return
        anchored = [row.at is not None for row in rows]
        ends = np.array([row.at for row in rows if row.at is not None], np.float32).reshape(-1, 3)
        force = np.stack([row.values for row in rows])[anchored]
        vectors = (ARROW_M_PER_N * force).astype(np.float32)
        columns = self._rr.Arrows3D.columns(vectors=vectors, origins=ends - vectors).partition(
            np.array(anchored, int)
        )
        self._send(f"{sensor}/finger/force/{name}", rows, columns)

    def _draw_location(self, sensor: str, name: str, rows: list[Row]) -> None:
        if not rows:
            return
        touching = [row.values is not None for row in rows]
        points = np.array([row.values for row in rows if row.values is not None], np.float32)
        columns = self._rr.Points3D.columns(positions=points.reshape(-1, 3)).partition(
            np.array(touching, int)
        )
        self._send(f"{sensor}/finger/contact/{name}", rows, columns)

    def _send_pac(self, entity: str, rows: list[Row]) -> None:
        """All PAC samples at their own times: electrode, PAC, electrode, PAC, ..."""
        slots = 2 * np.arange(len(rows[0].values) - 1, dtype=np.int64) + 1
        times = np.concatenate([row.time_ns + slots * row.slot_period_ns for row in rows])
        samples = np.concatenate([row.values[1:] for row in rows]).astype(np.float64)
        rr = self._rr
        self._stream.send_columns(
            entity,
            [
                rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]")),
                rr.TimeColumn(
                    SEQUENCE,
                    sequence=np.repeat([row.sequence for row in rows], len(slots)),
                ),
            ],
            rr.Scalars.columns(scalars=samples),
        )

    def _send(self, entity: str, rows: list[Any], columns: Iterable[Any]) -> None:
        times = np.array([row.time_ns for row in rows], np.int64).astype("datetime64[ns]")
        rr = self._rr
        self._stream.send_columns(
            entity,
            [
                rr.TimeColumn(TIMELINE, timestamp=times),
                rr.TimeColumn(SEQUENCE, sequence=[row.sequence for row in rows]),
            ],
            columns,
        )


def _of_one_width(rows: list[Row]) -> list[list[Row]]:
    """Rows by how many values they have: two kinds where a finger was exchanged for an SP."""
    widths = dict.fromkeys(len(row.values) for row in rows)
    return [[row for row in rows if len(row.values) == width] for width in widths]


def review(record: Path, view: Path | None = None, *, bundles: Sequence[str] = ()) -> Path:
    """Make the view of an existing record.

    Args:
        record: An MCAP record of palpate.
        view: The file to write; None = beside the record with the ending ``.rrd``.
        bundles: Bundles that hold the meshes of its fields, beside the packaged ones.

    Returns:
        The file written.

    Raises:
        ConfigError: One of ``bundles`` does not exist.
        RecordingError: The record is truncated or not palpate's.
        MissingExtraError: Rerun is not installed.
    """
    target = record.with_suffix(".rrd") if view is None else view
    with View(target, title=record.stem, meshes=MeshLibrary(bundles)) as drawn:
        for count, item in enumerate(read_record(record), start=1):
            topic = item.address.topic
            if topic in SensorScene.TOPICS:
                drawn.add(item.address.sensor, TOPICS[topic].codec.decode(item.payload))
            if count % (BATCH_MESSAGES * len(SensorScene.TOPICS)) == 0:
                drawn.flush()
    for name, count in drawn.counters.items():
        if count:
            log.warning("%s: %s %d", target, name, count)
    return target
