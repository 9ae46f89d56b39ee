"""Files of the recorder without a bus: rotation, full disks, what a killed run leaves behind."""

from __future__ import annotations

import os
import resource
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from typing import Any

import pytest

from palpate import heartbeat
from palpate.bus import TapSample
from palpate.bus.topics import ELECTRODES, TARE, Topic, sensor_key
from palpate.codec import ELECTRODE_FRAME
from palpate.errors import ErrorCode, RecordingError
from palpate.files import record_writer
from palpate.files.record import check_readable, read_record, recover, summarise
from palpate.files.record_writer import RecordWriter
from palpate.health import Health
from palpate.messages import NO_TARE, ElectrodeFrame, ServiceState, Tare
from palpate_services.config import RecorderConfig
from palpate_services.recorder import retention as retention_module
from palpate_services.recorder import writer as writer_module
from palpate_services.recorder.writer import FindTare, RecordFiles, leftovers, recover_all
from palpate_services.viewer.live_view import LiveView, ViewPlan

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]


def sample_of(payload: bytes, sensor: str = "finger", topic: Topic[Any] = ELECTRODES) -> TapSample:
    key = sensor_key("lab", sensor, topic.name)
    return TapSample(
        topic.name,
        "lab",
        sensor,
        key,
        topic.encoding,
        payload,
        time.monotonic_ns(),
        time.time_ns(),
    )


@pytest.fixture
def sample(make_frame: Frames) -> Callable[[int], TapSample]:
    return lambda sequence: sample_of(ELECTRODE_FRAME.encode(make_frame(sequence)))


@pytest.fixture
def open_files(tmp_path: Path) -> Callable[..., Any]:
    @contextmanager
    def opened(
        find_tare: FindTare | None = None, **config: Any
    ) -> Iterator[tuple[RecordFiles, Health]]:
        health = Health("recorder", "recorder")
        settings = {"out": tmp_path / "runs", "rrd": False, "min_free_bytes": 0, **config}
        files = RecordFiles(RecorderConfig(**settings), "lab", health, find_tare)
        files.start()
        try:
            yield files, health
        finally:
            files.close()

    return opened


def test_record_holds_what_was_written(
    open_files: Any, sample: Callable[[int], TapSample], tmp_path: Path
) -> None:
    samples = [sample(n) for n in range(1, 50)]
    with open_files() as (files, health):
        for item in samples:
            files.write(item)
            files.tick()
        assert len(list((tmp_path / "runs").glob("*.mcap.part"))) == 1
    (record,) = (tmp_path / "runs").iterdir()
    assert record.name.startswith("lab-2")
    check_readable(record)
    items = list(read_record(record))
    assert [item.payload for item in items] == [item.payload for item in samples]
    assert [item.sequence for item in items] == list(range(1, 50))
    assert health.counters["recorded_electrodes"] == 49


def test_each_record_holds_the_tares_that_its_frames_name(
    open_files: Any,
    make_frame: Frames,
    make_tare: Callable[..., Tare],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    asked: list[tuple[str, int]] = []

    def find(sensor: str, tare_id: int) -> Tare | None:
        asked.append((sensor, tare_id))
        # It is not known at once, and that of id 6 never.
        return make_tare(tare_id) if tare_id == 5 and len(asked) > 2 else None

    with open_files(find, rotate_bytes=65536) as (files, health):
        for sequence in range(1, 1500):
            tare_id = (5, 6, NO_TARE)[sequence % 3]
            frame = make_frame(sequence, tare_id=tare_id)
            files.write(sample_of(ELECTRODE_FRAME.encode(frame)))
            files.tick(idle=sequence % 100 == 0)
    records = sorted((tmp_path / "runs").iterdir())
    assert len(records) > 1
    for record in records:
        items = list(read_record(record))
        tares = [TARE.codec.decode(i.payload) for i in items if i.address.topic == "tare"]
        assert [tare.tare_id for tare in tares] == [5]
        assert {i.address.sensor for i in items} == {"finger"}
    assert ("finger", NO_TARE) not in asked
    assert health.counters["recorded_electrodes"] == 1499
    assert health.counters["recorded_tare"] == len(records)


def test_each_record_holds_a_tare_once(
    open_files: Any, make_frame: Frames, make_tare: Callable[..., Tare], tmp_path: Path
) -> None:
    """It was looked up for a frame that overtook it, and a gateway tells it again."""
    tares = [sample_of(TARE.codec.encode(make_tare(k)), topic=TARE) for k in (5, 5, 6, 5)]
    with open_files(lambda _, tare_id: make_tare(tare_id)) as (files, health):
        files.write(sample_of(ELECTRODE_FRAME.encode(make_frame(1, tare_id=5))))
        for tare in tares:
            files.write(tare)
    (record,) = (tmp_path / "runs").iterdir()
    kinds = [item.address.topic for item in read_record(record)]
    assert kinds == ["tare", "electrodes", "tare"]
    assert health.counters["recorded_tare"] == 2
    assert health.counters["repeated_tares"] == 3


def test_what_never_came_is_counted_once(
    open_files: Any, sample: Callable[[int], TapSample], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not what found no place to wait, nor what came while there was no disk."""
    free = [10**9]
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    monkeypatch.setattr(writer_module, "RETRY_S", 0.0)
    monkeypatch.setattr(writer_module, "free_bytes", lambda _: free[0])

    with open_files(min_free_bytes=10**8) as (files, health):
        for sequence in (1, 2, 5, 6):
            files.write(sample(sequence))
        files.write(replace(sample(9), lost_here=1))
        files.tick()
        assert health.counters["lost_on_bus"] == 2 + 1
        free[0] = 10**7
        for sequence in range(10, 20):
            files.tick()
            files.write(replace(sample(sequence), lost_here=1))
        free[0] = 10**9
        files.tick()
        files.write(replace(sample(20), lost_here=1))
        files.tick()
        assert health.counters["lost_on_bus"] == 3
        assert health.counters["lost_disk_full"] == 10


def test_broken_payload_is_kept_and_counted(open_files: Any, tmp_path: Path) -> None:
    with open_files() as (files, health):
        files.write(sample_of(b"\xff" * 30))
    (record,) = (tmp_path / "runs").iterdir()
    assert [item.payload for item in read_record(record)] == [b"\xff" * 30]
    assert health.counters["invalid_parse"] == 1


def test_invented_names_are_counted_and_cost_the_others_nothing(
    open_files: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_writer, "CHANNELS_MAX", 10)
    with open_files() as (files, health):
        for number in range(100):
            files.write(sample_of(b"x", f"finger{number}"))
        files.write(sample_of(b"y", "finger3"))
    assert health.counters["rejected_channels"] == 90
    (record,) = (tmp_path / "runs").iterdir()
    assert sum(summarise(record).counts.values()) == 11


def test_rotation_by_size_loses_nothing(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    with open_files(rotate_bytes=64 * 1024) as (files, _):
        for sequence in range(1, 1501):
            files.write(sample(sequence))
            files.tick(idle=sequence % 100 == 0)  # flushed, however fast this host writes
    records = sorted((tmp_path / "runs").iterdir())
    assert len(records) > 1
    sequences = [item.sequence for record in records for item in read_record(record)]
    assert sequences == list(range(1, 1501))


def test_a_slow_disk_has_time_to_close_a_record(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread that beats waits for it: a recorder was ended as one that hangs."""
    pulse = tmp_path / "pulse"
    monkeypatch.setenv(heartbeat.FILE_VARIABLE, str(pulse))
    monkeypatch.setattr(heartbeat, "_of_this_process", None)
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    allowed_s: list[float] = []

    def slow(_: int) -> None:
        found = heartbeat.read_pulse(pulse)
        assert found is not None
        allowed_s.append(found.allowed_ns * 1e-9)

    monkeypatch.setattr(os, "fsync", slow)
    with open_files(rotate_bytes=64 * 1024) as (files, _):
        for sequence in range(1, 1001):
            heartbeat.beat()
            files.write(sample(sequence))
            files.tick(idle=sequence % 100 == 0)
    assert len(allowed_s) > 1
    assert min(allowed_s) >= 30.0


def test_too_little_space_is_reported_and_recording_resumes(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    free = [10**9]
    monkeypatch.setattr("palpate.health.RECOVERY_S", 0.0)
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    monkeypatch.setattr(writer_module, "RETRY_S", 0.0)
    monkeypatch.setattr(writer_module, "free_bytes", lambda _: free[0])
    with open_files(min_free_bytes=10**8) as (files, health):
        files.write(sample(1))
        files.tick()
        free[0] = 10**7
        files.tick()
        status = health.status()
        assert status.state is ServiceState.DEGRADED
        assert status.last_error is not None
        assert status.last_error.code is ErrorCode.DISK
        assert str(tmp_path / "runs") in status.last_error.message
        assert "less than 100 MB are free (10 MB free)" in status.last_error.message
        files.write(sample(2))
        files.tick()
        assert health.counters["lost_disk_full"] == 1
        free[0] = 10**9
        files.tick()
        assert health.state is ServiceState.READY
        files.write(sample(3))
    records = sorted((tmp_path / "runs").iterdir())
    assert [[item.sequence for item in read_record(r)] for r in records] == [[1], [3]]
    assert all(record.suffix == ".mcap" for record in records)


@pytest.mark.parametrize("how", ["part", "replaced", "folder", "emptied", "moved", "file"])
def test_record_whose_file_is_taken_away_is_told_and_a_new_one_begun(
    how: str,
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    monkeypatch.setattr(writer_module, "RETRY_S", 0.0)
    runs = tmp_path / "runs"
    with open_files() as (files, health):
        for sequence in range(1, 6):
            files.write(sample(sequence))
        (part,) = runs.glob("*.part")
        if how in ("part", "replaced"):
            part.unlink()
        elif how == "moved":
            runs.rename(tmp_path / "elsewhere")
        else:
            shutil.rmtree(runs)
        if how == "replaced":
            part.write_bytes(b"another file")
        if how == "emptied":
            runs.mkdir()
        if how == "file":
            runs.write_bytes(b"no folder")
        files.tick()
        status = health.status()
        assert status.state is ServiceState.DEGRADED
        assert status.last_error is not None
        if how == "file":
            assert str(runs) in status.last_error.message
            runs.unlink()
            files.tick()
        else:
            assert str(part) in status.last_error.message
            assert "free" not in status.last_error.remedy
        files.write(sample(6))
    (record,) = runs.glob("*.mcap")
    assert [item.sequence for item in read_record(record)] == [6]
    assert health.counters["records_gone"] == 1
    assert health.counters["lost_with_record"] == (0 if how == "moved" else 5)
    assert "lost_disk_full" not in health.counters
    if how == "moved":
        (found,) = recover_all([tmp_path / "elsewhere" / part.name])
        assert [item.sequence for item in read_record(found.path)] == [1, 2, 3, 4, 5]
    if how == "replaced":
        assert part.read_bytes() == b"another file"


def test_record_that_is_gone_at_its_end_is_counted(
    open_files: Any, sample: Callable[[int], TapSample], tmp_path: Path
) -> None:
    with open_files() as (files, health):
        files.write(sample(1))
        (part,) = (tmp_path / "runs").glob("*.part")
        part.unlink()
        part.write_bytes(b"another file")
    assert health.state is ServiceState.DEGRADED
    assert health.counters["lost_with_record"] == 1
    assert list((tmp_path / "runs").iterdir()) == [part]


def test_each_full_disk_is_told_once_whatever_else_is_wrong(
    open_files: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Messages are lost in the queue, too; and health stays DEGRADED for a while after it."""
    free = [10**9]
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    monkeypatch.setattr(writer_module, "RETRY_S", 0.0)
    monkeypatch.setattr(writer_module, "free_bytes", lambda _: free[0])
    with open_files(min_free_bytes=10**8) as (files, health):
        health.fail(RecordingError("messages come too fast", remedy="record fewer"))
        for full in range(1, 3):
            free[0] = 10**7
            for _ in range(5):
                files.tick()
            assert health.counters["disk_failures"] == full
            free[0] = 10**9
            files.tick()
    told = [record for record in caplog.records if "MB are free" in record.getMessage()]
    assert len(told) == 2


def test_write_error_of_the_disk_is_survived(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    until: Until,
) -> None:
    """A limit on the size of files stands for a disk that refuses in the middle of a record."""
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with open_files() as (files, health):
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
            for sequence in range(1, 2001):
                files.write(sample(sequence))
                files.tick(idle=True)  # flushes, so that the limit is met after whole messages
                if health.state is ServiceState.DEGRADED:
                    break
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert health.state is ServiceState.DEGRADED
        error = health.status().last_error
        assert error is not None
        assert error.code is ErrorCode.DISK
        monkeypatch.setattr(writer_module, "RETRY_S", 0.0)
        files.tick()
        files.write(sample(5000))
        until(lambda: health.counters.get("recovered_records") == 1)
    kept = [
        item.sequence
        for record in sorted((tmp_path / "runs").glob("*.mcap"))
        for item in read_record(record)
    ]
    assert len(kept) > 20
    assert kept == [*range(1, len(kept)), 5000]


def test_unflushed_samples_are_counted_as_lost_when_the_disk_refuses(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    until: Until,
) -> None:
    """Each sample is in a record or counted, whether a write, a flush or the end of it fails."""
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(how: str, size: int) -> tuple[int, Health]:
        sent = 0
        with open_files(out=tmp_path / how) as (files, health):
            files.write(sample(sent := sent + 1))
            files.tick(idle=True)
            (part,) = (tmp_path / how).glob("*.part")
            try:
                resource.setrlimit(resource.RLIMIT_FSIZE, (part.stat().st_size + size, hard))
                while health.state is not ServiceState.DEGRADED:
                    files.write(sample(sent := sent + 1))
                    if how != "write" and sent == 8:
                        break
                if how == "flush":
                    files.tick(idle=True)
                if how == "end":
                    files.close()
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            assert health.state is ServiceState.DEGRADED
            files.tick()
        return sent, health

    for how, size in (("write", 20_000), ("flush", 10), ("end", 10)):
        sent, health = fill(how, size)
        recover_all(leftovers(tmp_path / how))
        kept = sum(1 for path in (tmp_path / how).glob("*.mcap") for _ in read_record(path))
        assert kept >= 1
        assert health.counters["lost_disk_full"] == sent - kept > 1, how


def test_a_disk_that_refuses_the_tare_of_a_frame_is_survived(
    open_files: Any,
    make_frame: Frames,
    make_tare: Callable[..., Tare],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(record_writer, "FLUSH_S", 0.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with open_files(lambda _, tare_id: make_tare(tare_id)) as (files, health):
        (part,) = (tmp_path / "runs").glob("*.part")
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (part.stat().st_size, hard))
            files.write(sample_of(ELECTRODE_FRAME.encode(make_frame(1, tare_id=5))))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert health.state is ServiceState.DEGRADED
    assert health.counters["lost_disk_full"] == 2, "the frame and its tare"


class HandClock:
    """The module ``time``, with a monotonic clock that goes on by hand."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


def test_whenever_it_is_killed_a_recorder_loses_less_than_promised(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 100 Hz, and in the silence after the last message (services/README.md)."""
    clock, sequences, copies = HandClock(), count(1), tmp_path / "copies"
    monkeypatch.setattr(record_writer, "time", clock)
    monkeypatch.setattr(writer_module, "time", clock)

    def kept() -> int:
        """Messages in a copy of what has reached the operating system."""
        copies.mkdir()
        (part,) = (tmp_path / "runs").glob("*.part")
        try:
            recovery = recover(Path(shutil.copy(part, copies)))
            return sum(1 for _ in read_record(recovery.path))
        finally:
            shutil.rmtree(copies)

    with open_files() as (files, _):
        for burst in (100, 35, 50, 65):
            for sent in islice(sequences, burst):
                clock.now_s += 0.01
                files.write(sample(sent))
                files.tick()
                if sent >= 30 and sent % 3 == 0:
                    assert sent - kept() < 30
            for _ in range(29):
                clock.now_s += 0.01
                files.tick(idle=True)
            assert kept() == sent


@pytest.mark.parametrize("size", [0, 1, 7])
def test_part_without_even_a_head_is_removed(tmp_path: Path, size: int) -> None:
    """A disk that refuses to write leaves one with each attempt."""
    part = tmp_path / "lab.mcap.part"
    part.write_bytes(b"\x89MCAP0\r"[:size])
    os.utime(part, (0, 0))
    assert recover_all(leftovers(tmp_path)) == []
    assert not part.exists()


def test_leftovers_are_recovered_but_not_those_of_the_living(
    open_files: Any, sample: Callable[[int], TapSample], tmp_path: Path, until: Until
) -> None:
    runs = tmp_path / "runs"
    writer = RecordWriter(runs / "lab-dead.mcap")
    for sequence in range(1, 11):
        item = sample(sequence)
        writer.write(item.key, item.schema, item.payload, log_time_ns=1, sequence=sequence)
    writer.flush()
    writer.abandon()
    with open_files() as (files, health):
        until(lambda: health.counters.get("recovered_records") == 1)
        files.write(sample(1))
        assert leftovers(runs) == []
        assert recover_all(leftovers(runs)) == []
    items = list(read_record(runs / "lab-dead.recovered.mcap"))
    assert [item.sequence for item in items] == list(range(1, 11))
    assert not list(runs.glob("*.part"))


def test_a_recovery_waits_until_there_is_room_for_a_copy(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    until: Until,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The copy kept the recorder paused, on a disk that was not full without it."""
    runs = tmp_path / "runs"
    writer = RecordWriter(runs / "lab-dead.mcap")
    item = sample(1)
    writer.write(item.key, item.schema, os.urandom(10**6), log_time_ns=1)
    writer.flush()
    writer.abandon()
    half = runs / "lab-old.recovered.mcap.part"
    half.write_bytes(bytes(600))
    free = [10**8 + 10**5]
    monkeypatch.setattr(writer_module, "CHECK_S", 0.0)
    monkeypatch.setattr(retention_module, "CHECK_S", 0.0)
    monkeypatch.setattr(writer_module, "free_bytes", lambda _: free[0])
    with open_files(min_free_bytes=10**8) as (files, health):
        until(lambda: not half.exists())
        until(lambda: "lab-dead.mcap.part waits to be recovered" in caplog.text)
        for _ in range(5):
            files.tick()
        files.write(sample(1))
        assert health.state is ServiceState.READY
        assert writer.part.exists()
        assert caplog.text.count("waits to be recovered") == 1
        free[0] = 10**9
        files.tick()
        until(lambda: health.counters.get("recovered_records") == 1)
    assert not writer.part.exists()
    assert sorted(summarise(path).counts[sample(1).key] for path in runs.glob("*.mcap")) == [1, 1]


def test_a_fifo_in_the_folder_does_not_hang_the_start(tmp_path: Path) -> None:
    fifo = tmp_path / "lab.mcap.part"
    os.mkfifo(fifo)
    os.utime(fifo, (0, 0))
    end = os.open(fifo, os.O_RDWR)  # so that it would be opened, and this test does not hang
    try:
        assert leftovers(tmp_path) == []
        with pytest.raises(RecordingError, match=r"lab\.mcap\.part.*not a regular file"):
            recover(fifo)
    finally:
        os.close(end)


def test_a_recovery_that_was_killed_is_done_again_at_the_next_start(
    sample: Callable[[int], TapSample], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    item = sample(1)
    writer = RecordWriter(tmp_path / "lab-dead.mcap")
    writer.write(item.key, item.schema, item.payload, log_time_ns=1, sequence=1)
    writer.flush()
    writer.abandon()
    half = shutil.copy(writer.part, tmp_path / "lab-dead.recovered.mcap.part")
    for part in (writer.part, half):
        os.utime(part, (0, 0))
    (found,) = recover_all(leftovers(tmp_path))
    assert list(tmp_path.iterdir()) == [found.path]
    assert found.path.name == "lab-dead.recovered.mcap"
    assert caplog.text == ""


def test_view_that_fails_leaves_the_record_alone(
    open_files: Any,
    sample: Callable[[int], TapSample],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def crashed(plan: ViewPlan) -> LiveView:
        assert plan.path is not None
        plan.path.mkdir()  # no file can be written there
        return LiveView(plan)

    monkeypatch.setattr(writer_module, "LiveView", crashed)
    with open_files(rrd=True) as (files, health):
        for sequence in range(1, 21):
            files.write(sample(sequence))
    (record,) = (tmp_path / "runs").glob("*.mcap")
    assert [item.sequence for item in read_record(record)] == list(range(1, 21))
    assert health.counters["view_failed"] == 1


def test_what_a_view_counts_last_is_not_lost(
    open_files: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ending:
        """Its thread counts once more, and ends, while the counts of all views are gathered."""

        def __init__(self, _: ViewPlan) -> None:
            self.counts: Counter[str] = Counter()

        def take_counts(self) -> Counter[str]:
            counts, self.counts = self.counts, Counter()
            return counts

        def join(self, _: float) -> bool:
            self.counts["view_no_mesh"] += 1
            return True

        def finish(self) -> None:
            pass

        def close(self, _: float) -> None:
            pass

    monkeypatch.setattr(writer_module, "LiveView", Ending)
    with open_files(rrd=True) as (_, health):
        pass
    assert health.counters["view_no_mesh"] == 1


def test_view_stops_at_its_size(make_frame: Frames, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from palpate_services.viewer.record_view import RerunView

    path = tmp_path / "view.rrd"
    with RerunView(path, title="view", max_bytes=1) as view:
        sizes = []
        for sequence in range(1, 31):
            view.add("finger", make_frame(sequence))
            view.flush()
            sizes.append(view.size())
        assert view.full
    assert path.stat().st_size == sizes[-1] > 0
