"""Bad records: each is refused by a typed error, soon, and without much memory."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import pytest
from tests.hostile import trial
from tests.hostile.records import CASES, KEY, NOW_NS, SCHEMA, write_good

from palpate.errors import RecordingError, WireError, printable
from palpate.files import record_writer
from palpate.files.record import check_readable, recover, summarise
from palpate.files.record_writer import RecordWriter

MEMORY_BYTES = 150 << 20
"""Twice the largest chunk that is allowed, packed and expanded, and some."""


def _look(record: Path) -> None:
    """As ``palpate info`` does."""
    summarise(record)
    check_readable(record)


@pytest.mark.parametrize("name", CASES)
def test_a_bad_record_is_refused_within_bounds(name: str, tmp_path: Path) -> None:
    record = tmp_path / "bad.mcap"
    CASES[name](record)
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError) as caught:
            _look(record)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < MEMORY_BYTES
    assert str(record) in caught.value.problem
    assert printable(str(caught.value)) == str(caught.value)


def test_there_are_enough_bad_records() -> None:
    assert len(CASES) >= 10


@pytest.mark.parametrize("name", ["chunk of 4 GB of zeros", "cut off", "60,000 channels"])
def test_recovery_of_a_bad_part_ends_within_bounds(name: str, tmp_path: Path) -> None:
    part = tmp_path / "bad.mcap.part"
    CASES[name](part)
    if name == "cut off":
        assert summarise(recover(part).path).counts == {KEY: 100}
    else:
        with pytest.raises(RecordingError):
            recover(part)
        assert part.exists()  # what cannot be read is never removed


def test_recovery_passes_many_heads_of_chunks_that_are_not_there(tmp_path: Path) -> None:
    """Each says that nearly the whole file is its chunk; to believe them would take hours."""
    part = tmp_path / "bad.mcap.part"
    write_good(tmp_path / "bad.mcap")
    head = b"\x06" + (20 << 20).to_bytes(8, "little") + bytes(28) + b"\x04\x00\x00\x00zstd"
    part.write_bytes((tmp_path / "bad.mcap").read_bytes()[:-30] + 400_000 * head)
    (tmp_path / "bad.mcap").unlink()
    found = recover(part)
    assert summarise(found.path).counts == {KEY: 100}
    assert found.places > 1


def test_the_writer_takes_no_more_streams_than_the_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_writer, "CHANNELS_MAX", 5)
    with RecordWriter(tmp_path / "a.mcap") as writer:
        for number in range(5):
            writer.write(f"{KEY}{number}", SCHEMA, b"x", log_time_ns=NOW_NS)
        with pytest.raises(WireError, match=r"a\.mcap\.part has 5 streams") as caught:
            writer.write(f"{KEY}5", SCHEMA, b"x", log_time_ns=NOW_NS)
        assert caught.value.reason == "channels"
        writer.write(f"{KEY}4", SCHEMA, b"x", log_time_ns=NOW_NS)
    assert sum(summarise(tmp_path / "a.mcap").counts.values()) == 6


def test_a_fifo_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match="not a regular file"):
        summarise(tmp_path / "a.mcap")


@pytest.mark.slow
def test_the_command_sends_no_control_character(tmp_path: Path) -> None:
    record = tmp_path / "a\x1b[31m.mcap"
    write_good(record)
    data = record.read_bytes()
    shown = trial.run("info", str(record))
    assert (shown.error, shown.traceback, shown.hung) == ("", False, False)
    assert "\x1b" not in shown.printed + shown.says
    assert KEY in shown.printed
    record.write_bytes(data[:-1])
    refused = trial.run("info", str(record))
    assert refused.error == RecordingError.__name__
    assert "\x1b" not in refused.printed + refused.says
