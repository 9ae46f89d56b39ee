"""The record: what is written comes back; what is cut off is neither lost nor taken for whole."""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, SYNTHESIS, sensor_key
from palpate.codec import ELECTRODE_FRAME, WRENCH_FRAME
from palpate.errors import RecordingError, WireError
from palpate.files import record_writer
from palpate.files.record import check_readable, only_name, read_record, recover, summarise
from palpate.files.record_writer import RecordWriter, descriptor_set
from palpate.messages import Stamp

KEY = sensor_key("lab", "finger", "electrodes")


def write(path: Path, payload: bytes, count: int) -> None:
    with RecordWriter(path, {"station": "lab"}) as writer:
        for i in range(count):
            writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1000 + i, sequence=i)


def write_many(writer: RecordWriter, payload: bytes) -> None:
    for _ in range(10_000):
        writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1)
    writer.flush()


def write_times(path: Path, stamps: list[Stamp], *, log_times_ns: list[int], frame: Any) -> None:
    with RecordWriter(path) as writer:
        for stamp, log_time_ns in zip(stamps, log_times_ns, strict=True):
            payload = ELECTRODE_FRAME.encode(replace(frame, stamp=stamp))
            writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=log_time_ns)


@pytest.fixture
def payload(examples: dict[str, Any]) -> bytes:
    return ELECTRODE_FRAME.encode(examples["ElectrodeFrame"])


def test_what_is_written_comes_back(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "run.mcap"
    write(path, payload, 500)
    items = list(read_record(path))
    assert [item.sequence for item in items] == list(range(500))
    assert {item.payload for item in items} == {payload}
    assert items[0].address.sensor == "finger"
    summary = summarise(path)
    assert summary.counts == {KEY: 500}
    assert summary.metadata["station"] == "lab"
    assert summary.complete
    check_readable(path)


@pytest.mark.parametrize("step_s", [0, -3, 3600, -60])
def test_lengths_and_rates_do_not_follow_the_wall_clock(
    tmp_path: Path, examples: dict[str, Any], step_s: int
) -> None:
    """500 frames at 100 Hz of which the first came in a heap, and a wall clock that is set."""
    frame, path = examples["ElectrodeFrame"], tmp_path / "run.mcap"
    began_ns, step_ns = 10**18, step_s * 10**9
    stamps, log_times_ns = [], []
    for i in range(501):
        wall_ns = began_ns + i * 10**7 + (step_ns if i > 250 else 0)
        stamps.append(
            replace(frame.stamp, sequence=i + 1, monotonic_ns=10**9 + i * 10**7, wall_ns=wall_ns)
        )
        log_times_ns.append(max(wall_ns, began_ns + 10**9) if i <= 250 else wall_ns)
    write_times(path, stamps, log_times_ns=log_times_ns, frame=frame)
    summary = summarise(path)
    assert summary.rates_hz == pytest.approx({KEY: 100.0})
    assert summary.durations_s == pytest.approx({KEY: 5.0})
    assert summary.wall_step_s == pytest.approx(step_s)


def test_runs_of_a_stream_are_timed_apart(tmp_path: Path, examples: dict[str, Any]) -> None:
    """After a restart of the host, and of a file that is played again, the clock begins anew."""
    frame, path = examples["ElectrodeFrame"], tmp_path / "run.mcap"
    runs = [(1, 10**15), (2, 10**9), (2, 10**9)]
    stamps = [
        replace(
            frame.stamp, clock_id=clock, monotonic_ns=at_ns + i * 10**7, wall_ns=10**18 + i * 10**7
        )
        for clock, at_ns in runs
        for i in range(101)
    ]
    write_times(path, stamps, log_times_ns=[10**18] * len(stamps), frame=frame)
    summary = summarise(path)
    assert summary.durations_s == pytest.approx({KEY: 3.0})
    assert summary.rates_hz == pytest.approx({KEY: 100.0})


@pytest.mark.parametrize("after_ns", [10**7, 0])
def test_what_is_missing_of_a_stream_is_counted(
    tmp_path: Path, examples: dict[str, Any], after_ns: int
) -> None:
    """Whether the record was taken live, or of a file that is played as fast as possible."""
    frame, path = examples["ElectrodeFrame"], tmp_path / "run.mcap"
    sequences = [*range(100, 200), *range(203, 300), *range(2704, 2800)]
    stamps = [
        replace(frame.stamp, sequence=k, monotonic_ns=k * 10**7, session_id=7) for k in sequences
    ]
    log_times_ns = [10**18 + k * after_ns for k in sequences]
    write_times(path, stamps, log_times_ns=log_times_ns, frame=frame)
    assert summarise(path).lost == {KEY: 3 + 2404}


def test_a_message_that_does_not_decode_is_counted_and_not_timed(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    write(path, b"\xff" * 30, 3)
    summary = summarise(path)
    assert summary.counts == {KEY: 3}
    assert not summary.rates_hz


def test_the_embedded_schema_is_enough_to_read_it_without_palpate(
    tmp_path: Path, payload: bytes
) -> None:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    path = tmp_path / "run.mcap"
    write(path, payload, 1)
    files = descriptor_pb2.FileDescriptorSet.FromString(
        descriptor_set(ELECTRODE_FRAME.message_type)
    )
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    generic = message_factory.GetMessageClass(
        pool.FindMessageTypeByName("palpate.v1.ElectrodeFrame")
    )
    message: Any = generic.FromString(next(iter(read_record(path))).payload)
    assert message.sensor_serial == "BT000123"


def test_the_name_tells_an_unfinished_record(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordWriter(path)
    writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1)
    assert not path.exists()
    assert writer.part.exists()
    with pytest.raises(RecordingError, match=r"run.mcap.part exists"):
        RecordWriter(path)
    writer.close()
    assert path.exists()
    assert not writer.part.exists()


def test_a_record_that_is_being_written_is_not_recovered(tmp_path: Path, payload: bytes) -> None:
    """Recovery removes the part: under a living writer that would lose the record."""
    path = tmp_path / "run.mcap"
    writer = RecordWriter(path)
    writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1)
    writer.flush()
    with pytest.raises(
        RecordingError, match=r"run\.mcap\.part is being written.*stop its recorder"
    ):
        recover(writer.part)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap.part"]
    writer.close()
    assert len(list(read_record(path))) == 1


def test_every_truncation_is_noticed_and_whole_messages_are_recovered(
    tmp_path: Path, payload: bytes
) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        for i in range(60):
            writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1000 + i, sequence=i)
            if i % 10 == 9:
                writer.flush()
    whole = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    most = 0
    for size in range(0, len(whole) - 1, 37):
        cut.write_bytes(whole[:size])
        with pytest.raises(RecordingError, match=r"cut.mcap"):
            list(read_record(cut))
        part = tmp_path / "cut.mcap.part"
        part.write_bytes(whole[:size])
        try:
            target = recover(part).path
        except RecordingError:
            part.unlink()  # nothing readable: nothing was removed, nothing written
            assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.mcap", "run.mcap"]
            continue
        sequences = [item.sequence for item in read_record(target)]
        assert sequences == list(range(len(sequences)))
        most = max(most, len(sequences))
        target.unlink()
    assert most == 60


@pytest.fixture
def long_record(tmp_path: Path, payload: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Thirty chunks of ten messages."""
    monkeypatch.setattr(record_writer, "FLUSH_S", float("inf"))  # however slow this host is
    path = tmp_path / "run.mcap"
    with RecordWriter(path, {"station": "lab"}) as writer:
        for i in range(300):
            writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1000 + i, sequence=i)
            if i % 10 == 9:
                writer.flush()
    return path


def indices_of(record: Path) -> list[ChunkIndex]:
    with record.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def chunks_of(record: Path) -> list[int]:
    """Where the chunks begin."""
    return [index.chunk_start_offset for index in indices_of(record)]


@pytest.mark.parametrize("where", ["within a chunk", "over heads of records", "first chunk"])
@pytest.mark.parametrize("ending", [".mcap", ".mcap.part"])
def test_what_lies_behind_a_damage_is_recovered_and_nothing_is_deleted(
    long_record: Path, where: str, ending: str
) -> None:
    whole = long_record.read_bytes()
    chunks = chunks_of(long_record)
    assert len(chunks) == 30
    begin, size = {
        "within a chunk": (chunks[10] + 80, 3),
        "over heads of records": (chunks[10] - 4, chunks[12] - chunks[10]),
        "first chunk": (chunks[0] + 80, 3),
    }[where]
    damaged = long_record.with_name(f"bad{ending}")
    content = whole[:begin] + bytes(size) + whole[begin + size :]
    if ending == ".mcap.part":
        content = content[: chunks[-1] + 100]
    damaged.write_bytes(content)
    if where == "first chunk" and ending == ".mcap.part":
        with pytest.raises(RecordingError):  # the stream has no name, as there is no index yet
            recover(damaged)
        assert damaged.read_bytes() == content
        return
    found = recover(damaged)
    sequences = [item.sequence for item in read_record(found.path)]
    missing = set(range(290)) - set(sequences)
    assert missing <= set(range(10) if where == "first chunk" else range(90, 140))
    assert len(sequences) >= 250
    assert sequences == sorted(sequences)
    assert found.places >= 1
    assert found.left_out >= size
    assert "could not be read" in str(found)
    kept = damaged if ending == ".mcap" else damaged.with_name("bad.mcap.damaged")
    assert found.original == kept
    assert kept.read_bytes() == content


@pytest.mark.parametrize("bit", range(8))
def test_a_chunk_that_says_it_is_something_else_is_missed_and_saved(
    long_record: Path, bit: int
) -> None:
    """One flipped bit of its first byte; readers pass over kinds of records they do not know."""
    content = bytearray(long_record.read_bytes())
    chunks = chunks_of(long_record)
    content[chunks[10]] ^= 1 << bit
    long_record.write_bytes(content)
    with pytest.raises(RecordingError, match=r"run\.mcap is damaged.*palpate recover"):
        summarise(long_record)
    part = long_record.with_name("cut.mcap.part")
    part.write_bytes(content[: chunks[20]])
    for damaged, messages in ((long_record, 300), (part, 200)):
        found = recover(damaged)
        assert [item.sequence for item in read_record(found.path)] == list(range(messages))
        assert (found.places, found.left_out) == (1, 1)
        assert found.original is not None


@pytest.mark.parametrize("of", ["chunk", "index behind it"])
@pytest.mark.parametrize("bit", [0, 4, 8, 9, 10, 11, 12, 13, 19, 24, 25, 40])
def test_a_flipped_bit_of_a_length_costs_no_other_chunk(
    long_record: Path, of: str, bit: int
) -> None:
    """What a record says to have may reach over good chunks, and over the end of the file."""
    content = bytearray(long_record.read_bytes())
    indices = indices_of(long_record)
    at = indices[10].chunk_start_offset + (0 if of == "chunk" else indices[10].chunk_length)
    content[at + 1 + bit // 8] ^= 1 << bit % 8
    part = long_record.with_name("cut.mcap.part")
    part.write_bytes(content[: indices[29].chunk_start_offset])
    found = recover(part)
    sequences = [item.sequence for item in read_record(found.path)]
    missing = set(range(290)) - set(sequences)
    assert missing <= set(range(100, 110) if of == "chunk" else ())
    assert sequences == sorted(set(sequences))
    if missing:
        assert found.left_out > 100
    assert found.places > 0
    assert part.with_name("cut.mcap.damaged").exists()


@pytest.mark.parametrize("of", ["chunk", "index behind it"])
@pytest.mark.parametrize("last", [20, 29])
def test_a_length_that_ends_at_a_later_record_is_not_believed(
    long_record: Path, of: str, last: int
) -> None:
    """Nothing behind it looks damaged, and the part was deleted with what lay between."""
    content = bytearray(long_record.read_bytes())
    indices = indices_of(long_record)
    at = indices[10].chunk_start_offset + (0 if of == "chunk" else indices[10].chunk_length)
    size = indices[last].chunk_start_offset - at - 9
    content[at + 1 : at + 9] = size.to_bytes(8, "little")
    part = long_record.with_name("cut.mcap.part")
    part.write_bytes(content[: indices[29].chunk_start_offset])
    found = recover(part)
    assert [item.sequence for item in read_record(found.path)] == list(range(290))
    assert found.places == 1
    assert part.with_name("cut.mcap.damaged").exists()


@pytest.mark.parametrize("bit", range(8))
def test_recovery_makes_no_message_of_an_index(long_record: Path, bit: int) -> None:
    """One flipped bit makes the kinds equal; the index began with the channel and a time."""
    content = bytearray(long_record.read_bytes())
    indices = indices_of(long_record)
    content[indices[10].chunk_start_offset + indices[10].chunk_length] ^= 1 << bit
    part = long_record.with_name("cut.mcap.part")
    part.write_bytes(content[: indices[29].chunk_start_offset])
    found = recover(part)
    assert [item.sequence for item in read_record(found.path)] == list(range(290))


def test_every_flipped_bit_of_the_index_is_noticed(long_record: Path) -> None:
    """Others seek by it: those would miss messages, or fail."""
    content = long_record.read_bytes()
    begin = int.from_bytes(content[-28:-20], "little")  # by the footer
    for bit in range(8 * begin, 8 * len(content), 101):
        changed = bytearray(content)
        changed[bit >> 3] ^= 1 << (bit & 7)
        long_record.write_bytes(changed)
        with pytest.raises(RecordingError, match=r"run\.mcap: .*recover it"):
            check_readable(long_record)
    recover(long_record)


def test_a_stream_is_saved_whose_schema_stood_in_a_damaged_chunk(
    tmp_path: Path, payload: bytes
) -> None:
    path = tmp_path / "run.mcap"
    thumb = sensor_key("lab", "thumb", "electrodes")
    with RecordWriter(path) as writer:
        for key in (KEY, thumb):  # of one schema, written with the first
            writer.write(key, ELECTRODE_FRAME.schema, payload, log_time_ns=1000)
            writer.flush()
    whole = bytearray(path.read_bytes())
    first = chunks_of(path)[0]
    whole[first + 80 : first + 83] = bytes(3)
    path.write_bytes(whole)
    assert summarise(recover(path).path).counts == {thumb: 1}


def test_recovery_replaces_no_other_file_and_leaves_whole_records(
    long_record: Path, tmp_path: Path
) -> None:
    content = long_record.read_bytes()
    with pytest.raises(RecordingError, match=r"run\.mcap is whole"):
        recover(long_record)
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(content[:-200])
    other = tmp_path / "cut.recovered.mcap"
    other.write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"cut\.recovered\.mcap exists.*move it away"):
        recover(part)
    assert other.read_bytes() == b"precious"
    other.unlink()
    found = recover(part)
    assert (found.original, part.exists()) == (None, False)
    # Killed before it had removed the part, a recovery is done again.
    part.write_bytes(content[:-200])
    assert summarise(recover(part).path).counts == {KEY: 300}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.recovered.mcap", "run.mcap"]
    # And so is one that was killed in the middle.
    part.write_bytes(content[:-200])
    (tmp_path / "cut.recovered.mcap").rename(tmp_path / "cut.recovered.mcap.part")
    assert summarise(recover(part).path).counts == {KEY: 300}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.recovered.mcap", "run.mcap"]


def test_a_recovery_that_the_disk_refuses_leaves_nothing(long_record: Path, tmp_path: Path) -> None:
    """Half a copy kept the disk full, and its recorder paused."""
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(long_record.read_bytes()[:-200])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (part.stat().st_size // 4, hard))
    try:
        with pytest.raises(RecordingError, match=r"cut\.recovered\.mcap.*File too large"):
            recover(part)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.mcap.part", "run.mcap"]
    assert summarise(recover(part).path).counts == {KEY: 300}


def test_a_file_without_a_whole_message_is_not_sent_in_a_circle(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    path.write_bytes(b"")
    with pytest.raises(RecordingError) as caught:
        recover(path)
    assert "palpate recover" not in caught.value.remedy


def test_flipped_bits_never_raise_anything_but_recording_errors(
    tmp_path: Path, payload: bytes
) -> None:
    path = tmp_path / "run.mcap"
    write(path, payload, 20)
    whole = bytearray(path.read_bytes())
    damaged = tmp_path / "damaged.mcap"
    for bit in range(0, 8 * len(whole), 61):
        changed = bytearray(whole)
        changed[bit >> 3] ^= 1 << (bit & 7)
        damaged.write_bytes(changed)
        with contextlib.suppress(RecordingError):
            assert len(list(read_record(damaged))) == 20  # e.g. a bit of an unused index


def test_a_second_station_is_refused_by_name_but_counted_and_recovered(
    tmp_path: Path, payload: bytes
) -> None:
    """Else two fingers of one name become one; such files come of ``mcap merge``."""
    path = tmp_path / "two.mcap"
    keys = [KEY, sensor_key("other", "finger", "electrodes")]
    with RecordWriter(path) as writer:
        for number in range(20):
            writer.write(
                keys[number % 2], ELECTRODE_FRAME.schema, payload, log_time_ns=1000 + number
            )
    refusal = r"two\.mcap holds the stations lab, other -> .*@v1/other/"
    with pytest.raises(RecordingError, match=refusal):
        list(read_record(path))
    with pytest.raises(RecordingError, match=refusal):
        only_name(path, "electrodes", "sensor")
    assert summarise(path).counts == dict.fromkeys(keys, 10)
    with pytest.raises(RecordingError, match="is whole"):
        recover(path)
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(path.read_bytes()[:-100])
    assert summarise(recover(part).path).counts == dict.fromkeys(keys, 10)


def test_a_foreign_or_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with pytest.raises(RecordingError, match="does not exist"):
        list(read_record(path))
    for content in (b"", b"time,value\n1,2\n", b"\x89MCAP0\r\n"):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"x\.mcap"):
            list(read_record(path))


def test_an_unknown_schema_is_not_recorded(tmp_path: Path) -> None:
    writer = RecordWriter(tmp_path / "run.mcap")
    with pytest.raises(WireError, match=r"palpate\.v9\.Frame"):
        writer.write(KEY, "palpate.v9.Frame", b"", log_time_ns=1)
    writer.abandon()


def test_a_full_disk_is_named(tmp_path: Path, payload: bytes) -> None:
    """/dev/full stands for the disk: every write fails with ENOSPC."""
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this system")
    writer = RecordWriter(tmp_path / "run.mcap")
    os.dup2(os.open("/dev/full", os.O_WRONLY), writer._file.fileno())
    with pytest.raises(RecordingError, match=r"No space left.*free space"):
        write_many(writer, payload)
    writer.abandon()


_CHILD = """
import sys, time
from pathlib import Path
from palpate.files.record_writer import RecordWriter
writer = RecordWriter(Path(sys.argv[1]))
payload = sys.stdin.buffer.read()
i = 0
while True:
    i += 1
    writer.write(sys.argv[2], sys.argv[3], payload, log_time_ns=time.time_ns(), sequence=i)
    sys.stdout.write(f"{i}\\n"); sys.stdout.flush()
    time.sleep(0.01)
"""


class FillingDisk(io.BufferedWriter):
    """A file whose disk is full for one write, of which half still fits."""

    full = False

    def write(self, data: Any) -> int:
        if not type(self).full:
            return super().write(data)
        type(self).full = False
        super().write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_record_with_half_a_write_in_it_never_looks_whole(
    tmp_path: Path, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where there is room again for the end: a chaos run found such a file."""
    with monkeypatch.context() as patch:
        opened = "palpate.files.record_writer.open"
        patch.setattr(opened, lambda path, _: FillingDisk(io.FileIO(path, "xb")), raising=False)
        writer = RecordWriter(tmp_path / "run.mcap")
    writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=1)
    writer.flush()
    writer.write(KEY, ELECTRODE_FRAME.schema, payload, log_time_ns=2)
    FillingDisk.full = True
    with pytest.raises(RecordingError, match="No space left"):
        writer.flush()
    with pytest.raises(RecordingError, match="No space left"):
        writer.close()
    writer.abandon()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]
    assert [item.log_time_ns for item in read_record(recover(writer.part).path)] == [1]


def test_nothing_is_left_of_a_record_that_could_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = "palpate.files.record_writer.open"
    monkeypatch.setattr(opened, lambda path, _: FillingDisk(io.FileIO(path, "xb")), raising=False)
    FillingDisk.full = True
    with pytest.raises(RecordingError, match="No space left"):
        RecordWriter(tmp_path / "run.mcap")
    assert not any(tmp_path.iterdir())


def test_kill_9_loses_no_more_than_a_flush(tmp_path: Path, examples: dict[str, Any]) -> None:
    """At 100 Hz 0.3 s are 30 messages; the count is compared, not a clock."""
    path = tmp_path / "run.mcap"
    child = subprocess.Popen(
        [
            sys.executable,
            "-c",
            _CHILD,
            str(path),
            KEY.replace("electrodes", "wrench"),
            WRENCH_FRAME.schema,
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.write(WRENCH_FRAME.encode(examples["WrenchFrame"]))
    child.stdin.close()
    written = int(child.stdout.readline())  # however long the child takes to start
    started = time.monotonic()
    while time.monotonic() - started < 1.5:
        written = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    rest = child.stdout.read().split()
    written = int(rest[-1]) if rest else written
    child.wait()
    target = recover(path.with_name("run.mcap.part")).path
    kept = [item.sequence for item in read_record(target)]
    assert kept == list(range(1, len(kept) + 1))
    assert written - len(kept) <= 30


def test_a_record_leaves_nothing_to_the_garbage_collector(tmp_path: Path) -> None:
    """It comes to a recorder once in hours; until then 20 kB of each schema stayed behind."""

    def write_all(number: int) -> None:
        with RecordWriter(tmp_path / f"{number}.mcap") as writer:
            for topic in (ELECTRODES, FEATURES, FIELD, SYNTHESIS):
                key = sensor_key("lab", "finger", topic.name)
                writer.write(key, topic.codec.schema, b"x", log_time_ns=number)

    write_all(0)
    gc.collect()
    gc.disable()
    try:
        write_all(1)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_a_long_record_needs_no_more_memory_than_a_short_one(tmp_path: Path) -> None:
    """MCAP's writer keeps an object for each chunk until the end: 50 MB an hour."""
    with RecordWriter(tmp_path / "long.mcap") as writer:

        def flushed(count: int) -> int:
            for number in range(count):
                for key in (KEY, f"{KEY}2", f"{KEY}3"):
                    writer.write(key, ELECTRODE_FRAME.schema, b"x", log_time_ns=number)
                writer.flush()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            grown = -flushed(200) + flushed(2000)
        finally:
            tracemalloc.stop()
    assert grown < 100_000  # 2000 objects of 1 kB would be 2 MB
    check_readable(tmp_path / "long.mcap")
    with open(tmp_path / "long.mcap", "rb") as file:
        reader = make_reader(file)  # MCAP's own, which seeks by the index
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == 2200
        late = list(reader.iter_messages(starting_at=1990, ending_before=2000, topics=[KEY]))
    assert [message.log_time for _, _, message in late] == list(range(1990, 2000))
