"""A record for Foxglove: its own messages as they were, and scenes that are geometrically right."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from palpate.bus.topics import TOPICS, sensor_key
from palpate.errors import ConfigError, RecordingError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import ElectrodeFrame, FeatureEstimate, IndenterPoseFrame, Tare, WrenchFrame
from palpate_services.viewer.foxglove import export_foxglove
from palpate_services.viewer.record_view import ARROW_M_PER_N

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]

FORCES = np.array([[0.0, 0.0, 2.0], [1.0, -2.0, 2.0], [-3.0, 0.0, 0.0], [0.5, 0.5, 1.0]])
PLACE = np.array([-0.004, 0.001, -0.007])


@pytest.fixture
def record(make_frame: Frames, make_tare: Callable[..., Tare], tmp_path: Path) -> Path:
    """Four presses of two fingers; the last one has no contact location."""
    path = tmp_path / "lab.mcap"
    sd = np.full(3, 0.1, np.float32)
    with RecordWriter(path) as writer:
        for sensor in ("left", "right"):
            for number, force in enumerate(FORCES.astype(np.float32)):
                frame = make_frame(number + 1, tare_id=5)
                stamp = dataclasses.replace(
                    frame.stamp, wall_ns=frame.stamp.wall_ns + 10**9 * number
                )
                touched = number < 3
                place = PLACE.astype(np.float32) if touched else None
                messages = {
                    "tare": make_tare(),
                    "electrodes": dataclasses.replace(frame, stamp=stamp),
                    "wrench": WrenchFrame(stamp, "FT", force, np.zeros(3, np.float32)),
                    "pose": IndenterPoseFrame(
                        stamp, "sphere", PLACE, np.array([1.0, 0, 0, 0]), touched
                    ),
                    "features": FeatureEstimate(
                        stamp, "BT", bytes(32), 5, touched, force, sd,
                        place, sd if touched else None,
                    ),
                    "field": bundles.guess(stamp, depth_m=1e-4 * number),
                }  # fmt: skip
                for name, message in messages.items():
                    codec = TOPICS[name].codec
                    key = sensor_key("lab", sensor, name)
                    writer.write(
                        key, codec.schema, codec.encode(message), log_time_ns=stamp.wall_ns
                    )
    return path


def messages_of(path: Path) -> dict[str, list[Any]]:
    """Topic -> protobuf messages of Foxglove, or raw payloads of ours, by an independent reader."""
    kinds = {kind.DESCRIPTOR.full_name: kind for kind in (SceneUpdate, FrameTransform)}
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            kind = kinds.get(schema.name)
            content = message.data if kind is None else kind.FromString(message.data)
            found.setdefault(channel.topic, []).append(content)
    return found


def test_own_messages_are_kept_and_scenes_stand_beside(record: Path, tmp_path: Path) -> None:
    mine = str(bundles.write(tmp_path / "mine", "field"))
    counts = export_foxglove(record, tmp_path / "f.mcap", bundles=[mine])
    found = messages_of(tmp_path / "f.mcap")
    own = [(item.key, item.payload) for item in read_record(record)]
    for key in {key for key, _ in own}:
        assert found[key] == [payload for other, payload in own if other == key]
    frames = [(one.parent_frame_id, one.child_frame_id) for one in found["/tf"]]
    assert frames == [("station", "left"), ("station", "right")]
    assert counts["/left/scene"] == len(found["/left/scene"]) == len(found["/right/scene"])
    entities = [entity for one in found["/left/scene"] for entity in one.entities]
    assert {entity.frame_id for entity in entities} == {"left"}
    names = {entity.id for entity in entities}
    assert names == {"electrodes", "force/estimate", "force/truth", "contact/estimate",
                     "contact/truth", "skin/estimate"}  # fmt: skip


def test_an_arrow_ends_where_the_finger_is_pressed(record: Path, tmp_path: Path) -> None:
    export_foxglove(record, tmp_path / "f.mcap")
    scenes = messages_of(tmp_path / "f.mcap")["/left/scene"]
    arrows = [
        entity.arrows[0]
        for one in scenes
        for entity in one.entities
        if entity.id == "force/estimate"
    ]
    assert len(arrows) == 3
    for arrow, force in zip(arrows, FORCES, strict=False):
        turn, start = arrow.pose.orientation, arrow.pose.position
        along = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply([1.0, 0.0, 0.0])
        length = arrow.shaft_length + arrow.head_length
        np.testing.assert_allclose(along, force / np.linalg.norm(force), atol=1e-6)
        assert length == pytest.approx(ARROW_M_PER_N * np.linalg.norm(force))
        end = np.array([start.x, start.y, start.z]) + length * along
        np.testing.assert_allclose(end, PLACE, atol=1e-6)


def test_a_lost_electrode_is_not_shown_as_pressed(
    make_frame: Frames, make_tare: Callable[..., Tare], tmp_path: Path
) -> None:
    path = tmp_path / "lab.mcap"
    frame = make_frame(tare_id=5)
    lost = dataclasses.replace(frame, validity=frame.validity & ~(1 << 4))
    with RecordWriter(path) as writer:
        for name, message in (("tare", make_tare()), ("electrodes", lost)):
            codec = TOPICS[name].codec
            key = sensor_key("lab", "left", name)
            writer.write(key, codec.schema, codec.encode(message), log_time_ns=frame.stamp.wall_ns)
    export_foxglove(path, tmp_path / "f.mcap")
    (scene,) = messages_of(tmp_path / "f.mcap")["/left/scene"]
    colours = [
        np.array([ball.color.r, ball.color.g, ball.color.b]) for ball in scene.entities[0].spheres
    ]
    assert np.ptp(colours[4]) < 0.1, "grey"
    assert max(colours[4]) < min(max(colour) for at, colour in enumerate(colours) if at != 4)


def log_times_of(path: Path) -> dict[str, list[int]]:
    """Topic -> times at which a player shows its messages [ns]."""
    found: dict[str, list[int]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(message.log_time)
    return found


def test_a_scene_comes_with_its_message_in_a_replay_too(record: Path, tmp_path: Path) -> None:
    """There the stamps are of the first run, and the log of the second."""
    again, later_ns = tmp_path / "again.mcap", 3600 * 10**9
    arrivals_ns: dict[str, set[int]] = {}
    with RecordWriter(again) as writer:
        for item in read_record(record):
            time_ns = item.log_time_ns + later_ns
            arrivals_ns.setdefault(item.address.sensor, set()).add(time_ns)
            writer.write(item.key, item.schema, item.payload, log_time_ns=time_ns)
    export_foxglove(again, tmp_path / "f.mcap")
    times_ns = log_times_of(tmp_path / "f.mcap")
    for sensor, arrived_ns in arrivals_ns.items():
        assert set(times_ns[f"/{sensor}/scene"]) == arrived_ns
        assert times_ns["/tf"][0] <= min(arrived_ns)


def test_electrodes_are_coloured_after_the_clock_was_set_back(
    make_frame: Frames, make_tare: Callable[..., Tare], tmp_path: Path
) -> None:
    path, frame = tmp_path / "lab.mcap", make_frame(tare_id=5)
    with RecordWriter(path) as writer:
        codec, key = TOPICS["tare"].codec, sensor_key("lab", "left", "tare")
        writer.write(key, codec.schema, codec.encode(make_tare()), log_time_ns=1)
        codec, key = TOPICS["electrodes"].codec, sensor_key("lab", "left", "electrodes")
        for number, set_back_s in enumerate((0, 0, 60, 60)):
            wall_ns = frame.stamp.wall_ns + (number - 10 * set_back_s) * 10**8
            stamp = dataclasses.replace(frame.stamp, sequence=number + 1, wall_ns=wall_ns)
            payload = codec.encode(dataclasses.replace(frame, stamp=stamp))
            writer.write(key, codec.schema, payload, log_time_ns=wall_ns)
    assert export_foxglove(path, tmp_path / "f.mcap")["/left/scene"] == 4


def test_what_is_no_longer_there_is_deleted(record: Path, tmp_path: Path) -> None:
    export_foxglove(record, tmp_path / "f.mcap")
    scenes = messages_of(tmp_path / "f.mcap")["/right/scene"]
    gone = {one.id for scene in scenes for one in scene.deletions}
    assert gone == {"force/estimate", "force/truth", "contact/estimate", "contact/truth"}
    kinds = {one.type for scene in scenes for one in scene.deletions}
    assert kinds == {SceneEntityDeletion.MATCHING_ID}


def test_the_skin_moves_as_its_field_says(record: Path, tmp_path: Path) -> None:
    mine = str(bundles.write(tmp_path / "mine", "field"))
    export_foxglove(record, tmp_path / "f.mcap", bundles=[mine])
    skins = [
        entity.triangles[0]
        for one in messages_of(tmp_path / "f.mcap")["/left/scene"]
        for entity in one.entities
        if entity.id == "skin/estimate"
    ]
    mesh = bundles.skin()
    used = np.unique(mesh.outer_faces)
    last = skins[-1]
    points = np.array([[one.x, one.y, one.z] for one in last.points])
    wanted = mesh.nodes[used] + bundles.pressed(3e-4)[used]
    np.testing.assert_allclose(points, wanted, atol=1e-7)
    np.testing.assert_array_equal(used[np.array(last.indices).reshape(-1, 3)], mesh.outer_faces)
    assert len({(one.r, one.g, one.b) for one in skins[0].colors}) == 1
    assert len({(one.r, one.g, one.b) for one in last.colors}) > 1


def test_fields_of_an_unknown_mesh_are_counted(record: Path, tmp_path: Path) -> None:
    counts = export_foxglove(record, tmp_path / "f.mcap")
    assert counts["view_no_mesh"] == 2 * len(FORCES)


def test_a_field_with_other_nodes_than_its_mesh_is_counted(
    make_frame: Frames, tmp_path: Path
) -> None:
    path, stamp = tmp_path / "lab.mcap", make_frame(1).stamp
    codec, key = TOPICS["field"].codec, sensor_key("lab", "left", "field")
    with RecordWriter(path) as writer:
        for number, nodes in enumerate((None, 3, None)):
            now = dataclasses.replace(stamp, wall_ns=stamp.wall_ns + 10**9 * number)
            field = bundles.guess(now, depth_m=1e-4 * number)
            field = dataclasses.replace(field, displacement=field.displacement[:nodes])
            writer.write(key, codec.schema, codec.encode(field), log_time_ns=now.wall_ns)
    mine = str(bundles.write(tmp_path / "mine", "field"))
    counts = export_foxglove(path, tmp_path / "f.mcap", bundles=[mine])
    assert (counts["view_wrong_mesh"], counts["/left/scene"]) == (1, 2)


def test_an_invalid_message_is_copied_and_not_drawn(
    make_frame: Frames, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "lab.mcap"
    codec, key = TOPICS["electrodes"].codec, sensor_key("lab", "left", "electrodes")
    payloads = [codec.encode(make_frame(1)), b"\xff\xff", codec.encode(make_frame(2))]
    with RecordWriter(path) as writer:
        for payload in payloads:
            writer.write(key, codec.schema, payload, log_time_ns=1)
    counts = export_foxglove(path, tmp_path / "f.mcap")
    assert messages_of(tmp_path / "f.mcap")[key] == payloads
    assert counts["view_rejected"] == 1
    assert "f.mcap: 1 messages break the contract" in caplog.text


def test_a_damaged_record_leaves_no_file(record: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(record.read_bytes()[:-200])
    with pytest.raises(RecordingError):
        export_foxglove(cut, tmp_path / "f.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.mcap", "lab.mcap"]
    with pytest.raises(ConfigError, match="record itself"):
        export_foxglove(record, tmp_path / "." / "lab.mcap")


def test_a_file_for_foxglove_is_no_damaged_record(record: Path, tmp_path: Path) -> None:
    export_foxglove(record, tmp_path / "f.mcap")
    with pytest.raises(RecordingError, match="schema 'foxglove") as caught:
        list(read_record(tmp_path / "f.mcap"))
    assert caught.value.problem.count("f.mcap") == 1
    assert "open it in Foxglove" in caught.value.remedy
