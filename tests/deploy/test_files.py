"""Commands about records: info, recover, review."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from palpate.bus.topics import SCHEMAS
from palpate.config import LinkConfig
from palpate.errors import LinkError, RecordingError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.health import Health
from palpate_deploy.demo.bundles import write_virtual_record
from palpate_deploy.diagnose import records
from palpate_services.config import RecorderConfig
from palpate_services.recorder import service, writer
from palpate_services.viewer import simulation

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


def test_info_counts_streams(palpate: Palpate, virtual_record: Path) -> None:
    result = palpate("info", virtual_record, "--json")
    assert result.returncode == 0
    told = json.loads(result.stdout)
    counts = {key.rpartition("/")[2]: n for key, n in told["counts"].items()}
    assert counts == {"electrodes": 300, "wrench": 300, "pose": 300, "tare": 1}
    rates = {key.rpartition("/")[2]: round(hz) for key, hz in told["rates_hz"].items()}
    assert rates == {"electrodes": 100, "wrench": 100, "pose": 100}


def test_info_table(palpate: Palpate, virtual_record: Path) -> None:
    result = palpate("info", virtual_record)
    assert result.returncode == 0
    assert "finger/electrodes" in result.stdout
    assert "wall clock" not in result.stdout


@pytest.mark.parametrize("as_json", [False, True])
def test_info_refuses_a_damaged_index(virtual_record: Path, tmp_path: Path, as_json: bool) -> None:
    path = tmp_path / "spoilt.mcap"
    content = bytearray(virtual_record.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"spoilt\.mcap: the checksum of its index"):
        records.show_info(path, as_json=as_json)


def test_info_says_that_the_wall_clock_was_set(
    virtual_record: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "set.mcap"
    with RecordWriter(path) as writer:
        for i, item in enumerate(read_record(virtual_record)):
            codec = SCHEMAS[item.schema]
            message = codec.decode(item.payload)
            ahead_ns = 60 * 10**9 if i > 400 else 0
            stamp = replace(message.stamp, wall_ns=message.stamp.wall_ns + ahead_ns)
            payload = codec.encode(replace(message, stamp=stamp))
            writer.write(item.key, item.schema, payload, log_time_ns=item.log_time_ns + ahead_ns)
    records.print_contents(path)
    shown = capsys.readouterr().out
    assert "the wall clock was set by +60.0 s" in shown
    assert "100.00" in shown


def _without(record: Path, path: Path, lost: range) -> Path:
    """A copy of a record that lacks these of its electrode frames."""
    with RecordWriter(path) as writer:
        for item in read_record(record):
            if not (item.address.topic == "electrodes" and item.sequence in lost):
                writer.write(
                    item.key,
                    item.schema,
                    item.payload,
                    log_time_ns=item.log_time_ns,
                    sequence=item.sequence,
                )
    return path


def test_info_tells_what_never_came(
    virtual_record: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _without(virtual_record, tmp_path / "hole.mcap", range(100, 237))
    records.show_info(path, as_json=True)
    lost = json.loads(capsys.readouterr().out)["lost"]
    assert {key.rpartition("/")[2]: n for key, n in lost.items()} == {
        "electrodes": 137,
        "wrench": 0,
        "pose": 0,
    }
    records.show_info(path, as_json=False)
    (row,) = (line for line in capsys.readouterr().out.splitlines() if "electrodes" in line)
    assert row.split("│")[-2].strip() == "137"


def test_record_says_that_messages_never_came(
    link: LinkConfig, virtual_record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "runs"
    out.mkdir()

    def pause(*_: object, **__: object) -> list[Path]:
        return [_without(virtual_record, out / "lab.mcap", range(100, 237))]

    monkeypatch.setattr(service, "run_recorder", pause)
    monkeypatch.setattr(records, "stop_on_signals", threading.Event)
    with pytest.raises(RecordingError, match="137 messages that were published never came"):
        records.record_station(link, "lab", {"out": out}, duration_s=1.0)


def test_record_tells_of_its_own_record_alone(
    link: LinkConfig,
    virtual_record: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The station's recorder ends one in the same folder meanwhile."""
    own: list[str] = []

    def record(config: RecorderConfig, *more: Any, **options: Any) -> list[Path]:
        shutil.copy(virtual_record, config.out / "the-stations.mcap")
        paths = real(config, *more, **options)
        own.extend(path.name for path in paths)
        return paths

    real = service.run_recorder
    monkeypatch.setattr(service, "run_recorder", record)
    monkeypatch.setattr(records, "stop_on_signals", threading.Event)
    with pytest.raises(LinkError, match="nothing came of station 'lab'"):
        records.record_station(link, "lab", {"out": tmp_path, "rrd": False}, duration_s=0.5)
    shown = "".join(capsys.readouterr().out.split())
    assert "the-stations" not in shown
    assert len(own) == 1
    assert own[0] in shown


def test_record_refuses_a_disk_without_room_at_once(
    link: LinkConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "free_bytes", lambda _: 8 * 10**6)
    monkeypatch.setattr(service, "run_recorder", lambda *_, **__: pytest.fail("it began"))
    with pytest.raises(RecordingError, match="8 MB free, a record needs 268 MB") as refused:
        records.record_station(link, "lab", {"out": tmp_path / "runs"}, duration_s=1.0)
    assert "--out" in refused.value.remedy
    assert not (tmp_path / "runs").exists()


def test_names_of_files_are_printed_without_control_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    view = tmp_path / "view.rrd"
    view.touch()
    monkeypatch.setattr(simulation, "review_simulations", lambda *_, **__: view)
    monkeypatch.setattr(records, "_draw_store", lambda *_: None)
    records._review_store(tmp_path, view, tmp_path / "red\x1b[31m.png", (), 8)
    shown = capsys.readouterr().out
    assert ".png" in shown
    assert "\x1b" not in shown


def test_truncated_record_is_refused_and_recovered(
    palpate: Palpate, virtual_record: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(virtual_record.read_bytes()[:-4000])
    refused = palpate("info", cut)
    assert refused.returncode == 3
    assert "palpate recover" in refused.stderr
    part = tmp_path / "cut.mcap.part"
    shutil.move(cut, part)
    assert palpate("recover", part).returncode == 0
    assert sum(1 for _ in read_record(tmp_path / "cut.recovered.mcap")) > 100
    again = palpate("recover", virtual_record)
    assert again.returncode != 0
    assert "is whole" in again.stderr
    assert virtual_record.exists()


@pytest.mark.parametrize("option", ["--out", "--png", "--foxglove"])
def test_review_replaces_no_record(
    palpate: Palpate, virtual_record: Path, tmp_path: Path, option: str
) -> None:
    other = tmp_path / "other.mcap"
    shutil.copy(virtual_record, other)
    before = other.read_bytes()
    refused = palpate("review", virtual_record, option, other)
    assert refused.returncode == 2
    assert "error: " in refused.stderr
    assert "Traceback" not in refused.stderr
    assert other.read_bytes() == before


def test_what_is_there_is_not_said_to_be_absent(palpate: Palpate, tmp_path: Path) -> None:
    result = palpate("info", tmp_path)
    assert result.returncode == 2
    assert "is a folder" in result.stderr


def test_review_writes_a_view(palpate: Palpate, virtual_record: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    view = tmp_path / "view.rrd"
    result = palpate("review", virtual_record, "--out", view)
    assert result.returncode == 0, result.stderr
    assert view.stat().st_size > 0
    assert f"rerun {view}" in result.stdout


def test_a_picture_of_a_record_without_estimates_is_refused(
    palpate: Palpate, virtual_record: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    result = palpate(
        "review", virtual_record, "--out", tmp_path / "a.rrd", "--png", tmp_path / "a.png"
    )
    assert result.returncode == 3
    assert "holds no estimates" in result.stderr
    assert not (tmp_path / "a.png").exists()


def test_virtual_record_is_the_same_again(tmp_path: Path, virtual_record: Path) -> None:
    again = tmp_path / "again.mcap"
    write_virtual_record(again, frames=300, seed=5)
    first, second = (
        [(item.key, item.payload) for item in read_record(path) if item.address.topic != "tare"]
        for path in (virtual_record, again)
    )
    # A tare's id is unique to its run; everything else, but for that id in the frames, repeats.
    assert [key for key, _ in first] == [key for key, _ in second]
    wrenches = [[p for k, p in items if k.endswith("wrench")] for items in (first, second)]
    assert wrenches[0] == wrenches[1]


def test_record_says_that_its_folder_was_removed(
    link: LinkConfig,
    wait_until: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop, out = threading.Event(), tmp_path / "runs"
    monkeypatch.setattr(records, "stop_on_signals", lambda: stop)

    def remove() -> None:
        try:
            wait_until(lambda: any(out.glob("*.part")), 60.0, "a record begins")
            shutil.rmtree(out)
            wait_until(lambda: any(out.glob("*.part")), 60.0, "another begins")
        finally:
            stop.set()

    remover = threading.Thread(target=remove)
    remover.start()
    with pytest.raises(RecordingError, match="its file was removed or moved"):
        records.record_station(link, "lab", {"out": out, "rrd": False}, duration_s=0)
    remover.join()
    assert any(out.glob("*.mcap"))


@pytest.mark.parametrize("counter", ["overflow", "lost_at_stop", "lost_disk_full"])
def test_record_says_that_messages_are_lost(
    link: LinkConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counter: str
) -> None:
    def lose(*_: object, health: Health, **__: object) -> list[Path]:
        health.count(counter, 2478)
        return []

    monkeypatch.setattr(service, "run_recorder", lose)
    monkeypatch.setattr(records, "stop_on_signals", threading.Event)
    with pytest.raises(RecordingError, match=rf"2,478 messages .* not in it \({counter}\)"):
        records.record_station(link, "lab", {"out": tmp_path}, duration_s=1.0)


def test_record_names_what_is_cut_off(
    link: LinkConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    part = tmp_path / "lab-20261130T081327.448Z.mcap.part"

    def fail(*_: object, **__: object) -> list[Path]:
        part.write_bytes(bytes(2048))
        return [part.with_suffix("")]

    monkeypatch.setattr(service, "run_recorder", fail)
    monkeypatch.setattr(records, "stop_on_signals", threading.Event)
    with pytest.raises(LinkError, match="nothing came"):
        records.record_station(link, "lab", {"out": tmp_path}, duration_s=1.0)
    assert f"palpate recover {part}" in capsys.readouterr().out
