"""A record as Foxglove shows it: its messages as they are, and beside them a scene of each finger.

The scene is in Foxglove's own messages (``foxglove.SceneUpdate``, ``foxglove.FrameTransform``): the
skin, coloured by how far it has moved, the electrodes by their tared counts, and force and contact
location, estimated and true. A finger's frame is named as its sensor; all of them hang on
``station``, side by side.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.writer import CompressionType, Writer

from palpate.bus.topics import SCHEMAS
from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate.files.record import metadata_of, read_record
from palpate.files.record_writer import descriptor_set
from palpate.process import require
from palpate_services.inference.repository import MeshLibrary
from palpate_services.viewer.layout import (
    ELECTRODE_PLACES,
    ESTIMATE_COLOUR,
    FIELD_FULL_M,
    TRUTH_COLOUR,
    electrode_shades,
)
from palpate_services.viewer.record_view import ARROW_M_PER_N
from palpate_services.viewer.surfaces import OuterSkin, shades
from palpate_services.viewer.timeline import (
    FieldRow,
    SensorTimeline,
    TimelineRow,
    message_of,
    tell_left_out,
)

ROOT = "station"
"""Frame that all fingers' frames hang on."""

FINGER_EVERY_M = 0.04
"""Distance between the frames of two fingers along y [m]."""

ELECTRODE_PERIOD_NS = 50_000_000
"""Electrodes are coloured anew twenty times a second at most: it is more than anybody sees."""

_SHAFT_M, _HEAD_M, _ELECTRODE_M, _CONTACT_M = 6e-4, 1.4e-3, 1.2e-3, 1.6e-3
_COLOURS = {"estimate": ESTIMATE_COLOUR, "truth": TRUTH_COLOUR}


def export_foxglove(record: Path, out: Path, *, bundles: Sequence[str] = ()) -> Counter[str]:
    """Write the MCAP file, whole or not at all; what is there is replaced.

    Args:
        record: ``NAME.mcap``.
        out: File to write; another one.
        bundles: Bundles with meshes of its fields, beside the packaged ones.

    Returns:
        Messages of each topic of the scene; ``view_no_mesh``, fields whose mesh no bundle has;
        ``view_wrong_mesh``, fields with other nodes than their mesh; ``view_rejected``, messages
        that break the contract, which are copied and not drawn.

    Raises:
        ConfigError: ``out`` is a record, or one of ``bundles`` does not exist.
        RecordingError: The record is truncated or not palpate's.
        DatasetError: The disk refused.
        MissingExtraError: Foxglove's messages are not installed.
    """
    require("foxglove_schemas_protobuf", extra="services")
    if out.resolve() == record.resolve():
        raise ConfigError(f"{out} is the record itself", remedy="name another file to write")
    if out.is_file() and metadata_of(out):
        raise ConfigError(f"{out} is another record", remedy="name another file to write")
    with written_whole(out) as part, part.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="", library="palpate")
        scenes = _Scenes(writer, MeshLibrary(bundles))
        known = _Channels(writer)
        for item in read_record(record):
            channel = known.channel(item.key, SCHEMAS[item.schema].message_type)
            writer.add_message(
                channel,
                log_time=item.log_time_ns,
                data=item.payload,
                publish_time=item.publish_time_ns,
                sequence=item.sequence,
            )
            if item.address.topic in SensorTimeline.TOPICS:
                message = message_of(item, scenes.counts)
                if message is not None:
                    scenes.add(item.address.sensor, message, item.log_time_ns)
        writer.finish()
    tell_left_out(out, scenes.counts)
    return scenes.counts


class _Channels:
    """Channels and schemas of a file, registered when they are first needed."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def channel(self, topic: str, kind: Any) -> int:
        """Channel of a topic with protobuf messages of a kind."""
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(
                name, "protobuf", descriptor_set(kind)
            )
        if (topic, name) not in self._channels:
            self._channels[topic, name] = self._writer.register_channel(
                topic, "protobuf", self._schemas[name]
            )
        return self._channels[topic, name]


class _Scenes:
    """Writes scenes of all fingers as their messages come."""

    def __init__(self, writer: Writer, meshes: MeshLibrary) -> None:
        self.counts: Counter[str] = Counter()
        self._writer, self._meshes = writer, meshes
        self._channels = _Channels(writer)
        self._fingers: dict[str, SensorTimeline] = {}
        self._skins: dict[bytes, OuterSkin] = {}
        self._electrodes_ns: dict[str, int] = {}

    def add(self, sensor: str, message: Any, log_time_ns: int) -> None:
        """Take a message of a finger, and write what it changes at the time it was logged.

        A player shows a file by these times; in a replayed record the stamps are older ones.
        """
        finger = self._fingers.get(sensor)
        if finger is None:
            finger = self._fingers[sensor] = SensorTimeline()
            self._write("/tf", _frame(sensor, len(self._fingers) - 1, log_time_ns), log_time_ns)
        finger.add(message)
        if not finger.pending:
            return
        rows = finger.take()
        for row in rows["electrodes/tared"]:
            # The wall clock may have been set back.
            if abs(row.time_ns - self._electrodes_ns.get(sensor, 0)) >= ELECTRODE_PERIOD_NS:
                self._electrodes_ns[sensor] = row.time_ns
                places = ELECTRODE_PLACES[finger.sensor_type]
                self._scene(sensor, log_time_ns, _electrodes(sensor, row, places))
        for name in _COLOURS:
            for row in rows[f"arrow/{name}"]:
                self._scene(sensor, log_time_ns, _arrow(sensor, name, row))
            for row in rows[f"location/{name}"]:
                self._scene(sensor, log_time_ns, _contact(sensor, name, row))
            for field in rows[f"field/{name}"]:
                self._field(sensor, name, field, log_time_ns)

    def _field(self, sensor: str, name: str, field: FieldRow, log_time_ns: int) -> None:
        mesh = self._meshes.find(field.mesh_sha256)
        if mesh is None or field.displacement.shape != mesh.nodes.shape:
            self.counts["view_no_mesh" if mesh is None else "view_wrong_mesh"] += 1
            return
        skin = self._skins.get(mesh.sha256)
        if skin is None:
            skin = self._skins[mesh.sha256] = OuterSkin(mesh)
        entity = _entity(sensor, f"skin/{name}", field.time_ns)
        moved = field.displacement[skin.used]
        triangles = entity.triangles.add()
        _place(triangles.pose, np.zeros(3))
        for point in skin.rest + moved:
            _point(triangles.points.add(), point)
        for colour in _colours(shades(np.linalg.norm(moved, axis=1) / FIELD_FULL_M)):
            _paint(triangles.colors.add(), colour)
        triangles.indices.extend(skin.triangles.reshape(-1).tolist())
        self._scene(sensor, log_time_ns, entity)

    def _scene(self, sensor: str, log_time_ns: int, change: Any) -> None:
        """Write an entity, or that one is there no more."""
        from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
        from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

        update = SceneUpdate()
        (update.entities if isinstance(change, SceneEntity) else update.deletions).append(change)
        self._write(f"/{sensor}/scene", update, log_time_ns)

    def _write(self, topic: str, message: Any, log_time_ns: int) -> None:
        channel = self._channels.channel(topic, type(message))
        data = message.SerializeToString()
        self._writer.add_message(channel, log_time_ns, data, publish_time=log_time_ns)
        self.counts[topic] += 1


def _frame(sensor: str, number: int, time_ns: int) -> Any:
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    frame = FrameTransform(parent_frame_id=ROOT, child_frame_id=sensor)
    frame.timestamp.FromNanoseconds(time_ns)
    frame.translation.y = FINGER_EVERY_M * number
    frame.rotation.w = 1.0
    return frame


def _entity(sensor: str, name: str, time_ns: int) -> Any:
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

    entity = SceneEntity(frame_id=sensor, id=name, frame_locked=True)
    entity.timestamp.FromNanoseconds(time_ns)
    return entity


def _gone(name: str, time_ns: int) -> Any:
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

    deletion = SceneEntityDeletion(type=SceneEntityDeletion.MATCHING_ID, id=name)
    deletion.timestamp.FromNanoseconds(time_ns)
    return deletion


def _electrodes(sensor: str, row: TimelineRow, places: npt.NDArray[np.floating]) -> Any:
    entity = _entity(sensor, "electrodes", row.time_ns)
    colours = _colours(electrode_shades(row.values))
    for place, colour in zip(places, colours, strict=True):
        _ball(entity.spheres.add(), place, _ELECTRODE_M, colour)
    return entity


def _arrow(sensor: str, name: str, row: TimelineRow) -> Any:
    """A force on the skin, ending where the finger is pressed."""
    force = np.asarray(row.values, np.float64)
    length = ARROW_M_PER_N * float(np.linalg.norm(force))
    if row.at is None or length == 0.0:
        return _gone(f"force/{name}", row.time_ns)
    entity = _entity(sensor, f"force/{name}", row.time_ns)
    arrow = entity.arrows.add()
    head = min(_HEAD_M, length)
    _place(arrow.pose, np.asarray(row.at, np.float64) - ARROW_M_PER_N * force, along=force)
    arrow.shaft_length, arrow.shaft_diameter = length - head, _SHAFT_M
    arrow.head_length, arrow.head_diameter = head, 2.0 * _SHAFT_M
    _paint(arrow.color, np.array(_COLOURS[name]) / 255.0)
    return entity


def _contact(sensor: str, name: str, row: TimelineRow) -> Any:
    if row.values is None:
        return _gone(f"contact/{name}", row.time_ns)
    entity = _entity(sensor, f"contact/{name}", row.time_ns)
    colour = np.array(_COLOURS[name]) / 255.0
    _ball(entity.spheres.add(), row.values, _CONTACT_M, colour)
    return entity


def _ball(sphere: Any, at: npt.ArrayLike, size_m: float, colour: npt.NDArray[np.floating]) -> None:
    _place(sphere.pose, np.asarray(at, np.float64))
    sphere.size.x = sphere.size.y = sphere.size.z = size_m
    _paint(sphere.color, colour)


def _place(
    pose: Any, at: npt.NDArray[np.floating], along: npt.NDArray[np.floating] | None = None
) -> None:
    """Put a pose somewhere, its x axis along a direction."""
    _point(pose.position, at)
    turn = pose.orientation
    turn.w = 1.0
    if along is None:
        return
    # The half-way vector between x and the direction is the axis of a half turn from one to other.
    half = along / np.linalg.norm(along) + np.array([1.0, 0.0, 0.0])
    if np.linalg.norm(half) < 1e-9:  # straight back
        half = np.array([0.0, 0.0, 1.0])
    turn.w = 0.0
    _point(turn, half / np.linalg.norm(half))


def _point(there: Any, values: npt.NDArray[np.floating]) -> None:
    there.x, there.y, there.z = (float(value) for value in values)


def _paint(colour: Any, values: npt.NDArray[np.floating]) -> None:
    colour.r, colour.g, colour.b = (float(value) for value in values)
    colour.a = 1.0


def _colours(packed: npt.NDArray[np.uint32]) -> npt.NDArray[np.floating]:
    """Red, green and blue, 0 to 1, of packed colours, shape (N, 3)."""
    return ((packed.reshape(-1, 1) >> np.array([24, 16, 8], np.uint32)) & 255) / 255.0
