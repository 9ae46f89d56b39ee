"""The view of a record: whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from palpate.bus.topics import ELECTRODES, ROBOT_POSE, sensor_key
from palpate.errors import RecordingError
from palpate.files.record import RecordItem, read_record, summarise
from palpate.files.record_writer import RecordWriter
from palpate.messages import ElectrodeFrame, Pose, RobotPoseFrame
from palpate_services.viewer import record_view
from palpate_services.viewer.record_view import review

pytest.importorskip("rerun")

Frames = Callable[..., ElectrodeFrame]


@pytest.fixture
def record(make_frame: Frames, tmp_path: Path) -> Path:
    """So long that the view is begun before all is read."""
    path = tmp_path / "lab.mcap"
    key = sensor_key("lab", "finger", ELECTRODES.name)
    with RecordWriter(path) as writer:
        for sequence in range(1, 4001):
            payload = ELECTRODES.codec.encode(make_frame(sequence))
            writer.write(key, ELECTRODES.codec.schema, payload, log_time_ns=sequence)
    return path


def cut(record: Path) -> None:
    record.write_bytes(record.read_bytes()[: record.stat().st_size * 3 // 4])


@pytest.mark.parametrize("beside", [True, False])
def test_a_damaged_record_leaves_the_view_that_is_there(record: Path, beside: bool) -> None:
    """The one beside it may be the recorder's own, and whole."""
    view = review(record, None if beside else record.with_name("view.rrd"))
    whole = view.read_bytes()
    cut(record)
    with pytest.raises(RecordingError, match="damaged or cut off after"):
        review(record, view)
    assert view.read_bytes() == whole
    assert sorted(record.parent.iterdir()) == sorted([record, view])


def test_no_view_is_left_of_a_damaged_record(record: Path) -> None:
    cut(record)
    with pytest.raises(RecordingError):
        review(record)
    assert list(record.parent.iterdir()) == [record]


def test_an_interrupted_review_leaves_the_view_that_is_there(
    record: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = review(record)
    whole = view.read_bytes()

    def interrupted(path: Path) -> Iterator[RecordItem]:
        for count, item in enumerate(read_record(path)):
            if count == 3000:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(record_view, "read_record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        review(record)
    assert view.read_bytes() == whole
    assert sorted(record.parent.iterdir()) == sorted([record, view])


def test_a_record_with_nothing_to_show_is_named(make_frame: Frames, tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    with RecordWriter(path) as writer:
        pose = RobotPoseFrame("arm", 1, 1, Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        key = sensor_key("lab", "arm", ROBOT_POSE.name)
        writer.write(key, ROBOT_POSE.codec.schema, ROBOT_POSE.codec.encode(pose), log_time_ns=1)
    with pytest.raises(RecordingError, match="holds nothing that a view shows"):
        review(path)
    assert list(tmp_path.iterdir()) == [path]


def test_an_invalid_message_is_left_out_and_told(
    make_frame: Frames, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The recorder keeps such payloads, so that their cause can be found."""
    path = tmp_path / "lab.mcap"
    key = sensor_key("lab", "finger", ELECTRODES.name)
    with RecordWriter(path) as writer:
        for payload in (
            ELECTRODES.codec.encode(make_frame(1)),
            b"\xff\xff",
            ELECTRODES.codec.encode(make_frame(2)),
        ):
            writer.write(key, ELECTRODES.codec.schema, payload, log_time_ns=1)
    assert review(path).stat().st_size > 0
    assert "lab.rrd: 1 messages break the contract" in caplog.text


def test_a_full_disk_is_told(record: Path, small_disk: Callable[[str], Path]) -> None:
    disk = small_disk("300k")
    with pytest.raises(RecordingError, match=r"view\.rrd: Rerun cannot write") as caught:
        review(record, disk / "view.rrd")
    assert "free space" in caught.value.remedy
    assert list(disk.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"%PDF-1.4\n" * 300, b"\x89MCAP"])
def test_what_is_no_record_is_not_called_a_damaged_one(tmp_path: Path, content: bytes) -> None:
    """Nothing can be recovered of it."""
    path = tmp_path / "junk.mcap"
    path.write_bytes(content)
    for look in (review, summarise):
        with pytest.raises(RecordingError, match=r"junk\.mcap is no MCAP file") as caught:
            look(path)
        assert caught.value.remedy == "give a record written by palpate"
