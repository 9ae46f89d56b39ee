"""``palpate replay``: nothing is lost, everything is accounted for, and it repeats bit for bit."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.gateway.ros_fakes import BEGAN_NS, hand_fields, make_bag, write_bag

from palpate.bus import Session
from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.errors import RecordingError
from palpate.files.record import RecordItem, read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import Status
from palpate.ros.layouts import BIOTAC_HAND, Dialect, encode
from palpate_deploy.diagnose.replay import ReplayAccount, replay, replay_profile, run_replay
from palpate_deploy.station.status import ask_status

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

pytestmark = pytest.mark.slow

BTD_SAMPLES, BTD_FRAMES, BTD_MISSING, BTD_JUMPS = 93_456, 2_124, 530, 154
"""The vendor's public capture: samples, frames, missing frames, time jumps."""


def _replay(palpate: Palpate, file: Path, out: Path, *more: str) -> dict[str, Any]:
    result = palpate("replay", file, "--out", out, "--no-rrd", "--json", *more)
    assert result.returncode == 0, result.stderr
    account: dict[str, Any] = json.loads(result.stdout)
    assert account["lossless"]
    assert len(account["records"]) == 1
    return account


def _readable(record: Path) -> Iterator[RecordItem]:
    """What stands before the damage of a record."""
    with contextlib.suppress(RecordingError):
        yield from read_record(record)


def _estimates(account: dict[str, Any]) -> list[bytes]:
    items = read_record(Path(account["records"][0]))
    return [item.payload for item in items if item.address.topic == FEATURES.name]


def test_text_log_and_its_record_give_identical_estimates(
    palpate: Palpate, text_log: Path, bundle: str, tmp_path: Path
) -> None:
    first = _replay(palpate, text_log, tmp_path / "first")
    assert (first["frames"], first["missing_frames"]) == (118, 2)
    assert first["recorded"]["electrodes"] == first["estimates"] == 118
    again = _replay(palpate, Path(first["records"][0]), tmp_path / "again")
    assert again["frames"] == 118
    assert _estimates(first) == _estimates(again)


def test_slow_answers_do_not_make_a_replay_lossy(
    text_log: Path, bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gateway is gone before its count at the end would have been asked for."""

    def slow(session: Session) -> list[Status]:
        found = ask_status(session)
        time.sleep(4.0)
        return found

    monkeypatch.setattr("palpate_deploy.diagnose.replay.ask_status", slow)
    profile = replay_profile(text_log, "fast", tmp_path / "out", "features-virtual", rrd=False)
    account = replay(profile, text_log)
    assert account.problems == []
    assert account.published == account.recorded["electrodes"] == 118


def test_records_of_others_in_its_folder_are_not_its_own(
    text_log: Path,
    virtual_record: Path,
    bundle: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its recorder recovers what a killed one has left, and another one may end meanwhile."""
    out = tmp_path / "out"
    out.mkdir()
    left = out / "replay-20200101T000000.000Z.mcap.part"
    left.write_bytes(virtual_record.read_bytes()[:-8000])
    os.utime(left, (0, 0))
    other = out / "replay-20200102T000000.000Z.mcap"

    def meanwhile(session: Session) -> list[Status]:
        shutil.copy(virtual_record, other)
        return ask_status(session)

    monkeypatch.setattr("palpate_deploy.diagnose.replay.ask_status", meanwhile)
    profile = replay_profile(text_log, "fast", out, "features-virtual", rrd=False)
    account = replay(profile, text_log)
    recovered = out / "replay-20200101T000000.000Z.recovered.mcap"
    assert set(out.glob("*.mcap")) == {other, recovered, *account.records}
    assert len(account.records) == 1
    assert account.problems == []
    assert account.recorded["electrodes"] == 118


def test_record_of_a_virtual_finger(
    palpate: Palpate, virtual_record: Path, bundle: str, tmp_path: Path
) -> None:
    account = _replay(palpate, virtual_record, tmp_path / "out")
    recorded = account["recorded"]
    assert {recorded[name] for name in ("electrodes", "wrench", "pose", "features")} == {300}


@pytest.mark.parametrize("lost", [range(100, 103), range(21, 281)])
def test_record_with_a_hole(
    palpate: Palpate, virtual_record: Path, bundle: str, tmp_path: Path, lost: range
) -> None:
    """What its recorder never got is no answer of this replay: it waits for all the others."""
    holed = tmp_path / "holed.mcap"
    with RecordWriter(holed) as writer:
        for item in read_record(virtual_record):
            if not (item.address.topic == ELECTRODES.name and item.sequence in lost):
                writer.write(item.key, item.schema, item.payload, log_time_ns=item.log_time_ns)
    account = _replay(palpate, holed, tmp_path / "out")
    left = 300 - len(lost)
    assert (account["frames"], account["missing_frames"]) == (left, len(lost))
    assert account["recorded"]["features"] == account["estimates"] == left


@pytest.mark.parametrize("dialect", ["ros1", "cdr"])
def test_bag_of_ros(palpate: Palpate, bundle: str, tmp_path: Path, dialect: Dialect) -> None:
    path = make_bag(tmp_path / ("a.bag" if dialect == "ros1" else "a"), 120, dialect)
    account = _replay(palpate, path, tmp_path / "out", "--bundle", bundle)
    assert account["frames"] == account["recorded"]["electrodes"] == account["estimates"] == 120
    assert account["missing_frames"] == 0


def test_messages_that_a_bag_loses_are_told(palpate: Palpate, bundle: str, tmp_path: Path) -> None:
    late = {50: 40, 51: 41}
    messages = [
        ("/hand", BIOTAC_HAND, BEGAN_NS + 10_000_000 * k, encode(fields, BIOTAC_HAND))
        for k in range(120)
        for fields in [hand_fields(k, BEGAN_NS + 10_000_000 * late.get(k, k) - 5_000_000)]
    ]
    path = write_bag(tmp_path / "a", messages, "cdr")
    result = palpate("replay", path, "--out", tmp_path / "out", "--no-rrd", "--json")
    assert result.returncode == 1
    assert "2 of its messages were dropped" in result.stderr
    account = json.loads(result.stdout)
    assert (account["frames"], account["dropped_messages"], account["lossless"]) == (118, 2, False)


def test_real_capture(palpate: Palpate, shared_data: Path, bundle: str, tmp_path: Path) -> None:
    capture = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    first = _replay(palpate, capture, tmp_path / "first")
    assert (first["samples"], first["frames"]) == (BTD_SAMPLES, BTD_FRAMES)
    assert (first["missing_frames"], first["time_jumps"]) == (BTD_MISSING, BTD_JUMPS)
    assert first["estimates"] == first["recorded"]["electrodes"] == BTD_FRAMES
    again = _replay(palpate, Path(first["records"][0]), tmp_path / "again")
    estimates = _estimates(first)
    assert len(estimates) == BTD_FRAMES
    assert estimates == _estimates(again)


def _three_fingers(lines: Iterable[str], *, port: int) -> Iterator[str]:
    """A log with the finger of ``port`` at the ports 1, 3 and 4; port 2 is empty."""
    in_rows = False
    for line in lines:
        if not in_rows:
            in_rows = line.startswith("Begin File")
            yield line
            continue
        columns = line.split()
        value, parity = columns[2 + 2 * port : 4 + 2 * port]
        moved = str(min(4095, int(value) + 5))
        yield " ".join([*columns[:4], value, parity, "0", "1", moved, parity, value, parity]) + "\n"


def test_all_fingers_of_a_log_are_played(
    palpate: Palpate, text_log: Path, bundle: str, tmp_path: Path
) -> None:
    file = tmp_path / "three.btd"
    with text_log.open(encoding="ascii") as lines:
        file.write_text("".join(_three_fingers(lines, port=1)), encoding="ascii")
    fingers = ("finger-1", "finger-3", "finger-4")
    first = _replay(palpate, file, tmp_path / "first")
    assert first["frames"] == first["estimates"] == 3 * 118
    assert first["frames_by_sensor"] == dict.fromkeys(fingers, 118)
    items = list(read_record(Path(first["records"][0])))
    for topic in (ELECTRODES.name, FEATURES.name):
        found = Counter(i.address.sensor for i in items if i.address.topic == topic)
        assert found == dict.fromkeys(fingers, 118)
    again = _replay(palpate, Path(first["records"][0]), tmp_path / "again")
    assert sorted(_estimates(first)) == sorted(_estimates(again))


def test_three_fingers_of_a_real_capture(
    palpate: Palpate, shared_data: Path, bundle: str, tmp_path: Path
) -> None:
    capture = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    file = tmp_path / "three.btd"
    with gzip.open(capture, "rt", encoding="latin-1") as lines:
        file.write_text("".join(_three_fingers(lines, port=3)), encoding="latin-1")
    account = _replay(palpate, file, tmp_path / "out")
    assert account["frames_by_sensor"] == dict.fromkeys(
        ("finger-1", "finger-3", "finger-4"), BTD_FRAMES
    )
    assert account["estimates"] == 3 * BTD_FRAMES


def test_truncated_log_is_said_and_what_was_read_is_recorded(
    palpate: Palpate, text_log: Path, bundle: str, tmp_path: Path
) -> None:
    """Packed; the plain one is the decoder's (test_cut_last_line of the gateway's text logs)."""
    cut = tmp_path / "cut.btd.gz"
    cut.write_bytes(gzip.compress(text_log.read_bytes())[:-100])
    result = palpate("replay", cut, "--out", tmp_path / "out", "--no-rrd", "--json")
    assert result.returncode == 3
    assert str(cut) in result.stderr
    assert "truncated" in result.stderr or "cut" in result.stderr
    account = json.loads(result.stdout)
    assert account["frames"] > 50
    assert account["recorded"]["electrodes"] == account["frames"] == account["estimates"]


@pytest.mark.parametrize("kind", ["text", "bytes", "folder"])
def test_file_that_is_no_log(palpate: Palpate, bundle: str, tmp_path: Path, kind: str) -> None:
    nonsense = tmp_path / "nonsense.btd"
    if kind == "folder":
        nonsense.mkdir()
    else:
        nonsense.write_bytes(b"hello\n" if kind == "text" else bytes(range(256)) * 99)
    result = palpate("replay", nonsense, "--out", tmp_path / "out", "--no-rrd")
    assert result.returncode == 3
    assert "nonsense.btd" in result.stderr
    assert "Traceback" not in result.stderr
    assert not result.stdout
    assert not list(tmp_path.glob("out/*")), "a record without a frame"


def test_damaged_record(
    palpate: Palpate, virtual_record: Path, bundle: str, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(virtual_record.read_bytes()[:-8000])
    readable = Counter(item.address.topic for item in _readable(cut))
    result = palpate("replay", cut, "--out", tmp_path / "out", "--no-rrd", "--json")
    assert result.returncode == 3
    assert "cut.mcap" in result.stderr
    account = json.loads(result.stdout)
    assert account["lossless"]
    assert account["recorded"]["electrodes"] == account["frames"] == readable["electrodes"]


def test_what_is_lost_of_a_damaged_record_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, bundle: str
) -> None:
    """Beside the damage, which alone would pass for the reason."""
    account = ReplayAccount(
        tmp_path / "cut.mcap",
        gateway={"frames_published": 100},
        features={"estimates_published": 90},
        recorded={"electrodes": 90, "features": 90},
        error=RecordingError("cut.mcap is damaged", remedy="recover it"),
        exit_status=3,
        counted=True,
    )
    monkeypatch.setattr("palpate_deploy.diagnose.replay.replay", lambda *_, **__: account)
    monkeypatch.setattr("palpate_deploy.diagnose.replay.replay_profile", lambda *_, **__: None)
    status = run_replay(account.file, "fast", tmp_path, "features-virtual", rrd=False, as_json=True)
    assert status == 3
    told = capsys.readouterr().err
    assert "cut.mcap is damaged" in told
    assert "100 frames published, 90 recorded" in told


def test_recorded_pace(palpate: Palpate, text_log: Path, bundle: str, tmp_path: Path) -> None:
    result = palpate(
        "replay", text_log, "--pace", "recorded", "--out", tmp_path / "out", "--no-rrd", "--json"
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["estimates"] > 0
