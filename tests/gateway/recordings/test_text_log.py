from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import ConfigError, PalpateError, RecordingError
from palpate.messages import SensorType
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.recordings.text_log import TextLog, TextLogOptions, TextLogReader, ports_of


def replay(
    path: Path, port: int = 0
) -> tuple[list[ElectrodeReading], TextLog, PalpateError | None]:
    device = TextLog(TextLogOptions(path=path, port=port))
    readings: list[ElectrodeReading] = []
    try:
        device.open()
        while got := device.read(1.0):
            readings += [r for r in got if isinstance(r, ElectrodeReading)]
    except PalpateError as error:
        return readings, device, error
    return readings, device, None


@pytest.mark.parametrize("gz", [False, True])
@pytest.mark.parametrize("start", ["pac", "e1"])
@pytest.mark.parametrize("style", ["btd", "log"])
def test_reads_both_styles(
    log: Callable[..., Any], tmp_path: Path, style: str, start: str, gz: bool
) -> None:
    # The name says nothing: gzip is known by its magic number.
    path = log(style=style, start=start).write(tmp_path / "data.txt", gz=gz)
    readings, device, error = replay(path)
    assert error is None
    assert len(readings) == 12
    assert device.counters["samples"] == 12 * 44
    assert device.counters["time_jumps"] == 0
    assert readings[3].electrodes.tolist() == [1000 + 20 * c + 3 for c in range(17, 36)]
    assert [r.tick for r in readings] == list(range(100, 112))
    assert np.allclose([r.time_s for r in readings], np.arange(12) * 0.01, atol=1e-6)
    assert all(r.validity == ch.ALL_VALID for r in readings)


def test_header(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log().write(tmp_path / "a.btd")
    header = TextLogReader(path).header
    with TextLog(TextLogOptions(path=path)) as device:
        assert device.identity.serial == "BT0123456789ABCD"  # cut at the stray bytes 00 10
        assert device.identity.start_wall_ns == 1_594_741_080_000_000_000
    assert header.lines == 13
    assert header.serial(4) == ""
    assert header.sample_rate_hz == 4400.0


def test_log_without_header_has_no_serial(log: Callable[..., Any], tmp_path: Path) -> None:
    with TextLog(TextLogOptions(path=log(style="log").write(tmp_path / "a"))) as device:
        assert device.identity.serial == "unknown-port3"
        assert device.identity.start_wall_ns is None


def test_rebuilt_time_leaves_room_for_missing_frames(
    log: Callable[..., Any], tmp_path: Path
) -> None:
    path = log(style="log", frame_numbers=[1, 2, 5, 6]).write(tmp_path / "a")
    readings, device, _ = replay(path)
    assert np.allclose([r.time_s for r in readings], [0.0, 0.01, 0.04, 0.05])
    assert device.counters["missing_frames"] == 2
    assert [r.missed_before for r in readings] == [0, 0, 2, 0]


def test_a_damaged_frame_number_moves_no_time(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(style="log", frame_numbers=[1, 2, 100_000_003, 4, 5]).write(tmp_path / "a")
    readings, device, _ = replay(path)
    assert np.allclose([r.time_s for r in readings], [0.0, 0.01, 0.02, 0.03, 0.04])
    assert device.counters["missing_frames"] == 0
    assert device.counters["counter_restarts"] == 2


@pytest.mark.parametrize("block_bytes", [1, 700, 5000])
def test_blocks_do_not_matter(log: Callable[..., Any], tmp_path: Path, block_bytes: int) -> None:
    path = log().write(tmp_path / "a.btd", gz=True)
    reader = TextLogReader(path, block_bytes=block_bytes)
    channel = np.concatenate([block.channel for block in reader.blocks()])
    assert reader.damage is None
    assert len(channel) == 12 * 44


def test_last_line_without_line_end_is_whole(log: Callable[..., Any], tmp_path: Path) -> None:
    readings, _, error = replay(log().write(tmp_path / "a.btd", cut=2))
    assert (len(readings), error) == (12, None)


# --- bad input: what came before is delivered, then the error names file, line and remedy ---


def check(error: PalpateError | None, kind: type[PalpateError], *words: str) -> None:
    assert isinstance(error, kind)
    for word in words:
        assert word in str(error)
    assert error.remedy


@pytest.mark.parametrize("cut", [3, 5, 20])
def test_cut_last_line(log: Callable[..., Any], tmp_path: Path, cut: int) -> None:
    path = log().write(tmp_path / "cut.btd", cut=cut)
    readings, device, error = replay(path)
    check(error, RecordingError, "cut.btd, line 541: the last line is cut", "truncated")
    assert len(readings) == 11
    assert device.read(1.0) == []


def test_log_that_ends_inside_a_frame(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.lines = made.lines[:-20]
    readings, device, error = replay(made.write(tmp_path / "short.btd"))
    check(error, RecordingError, "short.btd: the log ends inside a frame, after 24 slots")
    assert len(readings) == 11
    assert device.read(1.0) == []


def test_frame_that_lost_a_slot_at_the_end_is_delivered(
    log: Callable[..., Any], tmp_path: Path
) -> None:
    made = log()
    del made.lines[-10]
    readings, device, error = replay(made.write(tmp_path / "a.btd"))
    assert (len(readings), error) == (12, None)
    assert device.counters["incomplete_frames"] == 1


@pytest.mark.parametrize("cut", [1, 12, 300])
def test_truncated_gzip(log: Callable[..., Any], tmp_path: Path, cut: int) -> None:
    path = log(200).write(tmp_path / "data.btd.gz", gz=True)
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    readings, _, error = replay(path)
    check(error, RecordingError, "data.btd.gz: the gzip file is truncated", "copy the file again")
    whole, _, _ = replay(log(200).write(tmp_path / "whole.btd"))
    assert 0 < len(readings) <= 200
    assert [r.electrodes.tolist() for r in readings] == [
        r.electrodes.tolist() for r in whole[: len(readings)]
    ]


def test_damaged_gzip(log: Callable[..., Any], tmp_path: Path) -> None:
    data = bytearray(gzip.compress(log(50).content()))
    data[len(data) // 2] ^= 0xFF
    path = tmp_path / "a.gz"
    path.write_bytes(data)
    check(replay(path)[2], RecordingError, "a.gz")


BAD_ROWS = {
    "unknown channel": ("0.1 0 100 50 0 1 0 1 2000 0", "unknown channel id 50"),
    "value": ("0.1 0 100 17 0 1 0 1 4096 0", "value 4096 at port 3 is not a 12-bit count"),
    "negative": ("0.1 0 100 17 0 1 0 1 -1 0", "value -1 at port 3"),
    "fraction": ("0.1 0 100 17 0 1 0 1 2.5 0", "value 2.5 at port 3"),
    "parity": ("0.1 0 100 17 0 1 0 1 2000 2", "parity column of port 3 is 2, not 0 or 1"),
    "columns": ("0.1 0 100 17 0 1 0 1 2000", "9 columns where the first row has 10"),
    "more columns": ("0.1 0 100 17 0 1 0 1 2000 0 7", "11 columns where the first row has 10"),
    "text": ("0.1 0 100 17 0 1 x 1 2000 0", "not a row of numbers"),
    "underscore": ("0.1 0 1_00 17 0 1 0 1 2000 0", "not a row of numbers"),
    "points": ("0.1.2 0 100 17 0 1 0 1 2000 0", "not a row of numbers"),
    "nan": ("nan 0 100 17 0 1 0 1 2000 0", "a number is not finite"),
    "batch": ("0.1 -4 100 17 0 1 0 1 2000 0", "batch index -4 is not a count"),
    "frame": ("0.1 0 1e99 17 0 1 0 1 2000 0", "frame index 1e+99 is not a count"),
}


@pytest.mark.parametrize("what", BAD_ROWS)
def test_damaged_row(log: Callable[..., Any], tmp_path: Path, what: str) -> None:
    row, message = BAD_ROWS[what]
    made = log()
    made.lines[5 * 44 + 7] = row
    readings, device, error = replay(made.write(tmp_path / "bad.btd"))
    check(error, RecordingError, f"bad.btd, line {13 + 5 * 44 + 8}: {message}")
    assert len(readings) == 5
    assert device.read(1.0) == []


def test_damaged_first_row(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.lines[0] = BAD_ROWS["unknown channel"][0]
    check(replay(made.write(tmp_path / "a.btd"))[2], RecordingError, "line 14", "channel id 50")


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "empty.btd").write_bytes(b"")
    check(replay(tmp_path / "empty.btd")[2], RecordingError, "empty.btd: the file is empty")


def test_missing_file(tmp_path: Path) -> None:
    check(
        replay(tmp_path / "no.btd")[2], RecordingError, "no.btd: cannot be read", "check the path"
    )


@pytest.mark.parametrize("content", [b"hello world\n", b"\x89PNG\r\n\x1a\n\x00\x00", b"a,b\n1,2\n"])
def test_not_a_log(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    check(replay(path)[2], RecordingError, "notes.txt: line 1 is neither a log header nor a row")


def test_header_without_rows(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.lines = []
    check(replay(made.write(tmp_path / "a.btd"))[2], RecordingError, "a header and no rows")


def test_header_without_begin(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.header.remove("Begin File")
    check(replay(made.write(tmp_path / "a.btd"))[2], RecordingError, "'Begin File'")


@pytest.mark.parametrize("rate", ["0", "fast", "-3"])
def test_bad_rate(log: Callable[..., Any], tmp_path: Path, rate: str) -> None:
    made = log()
    made.header[8] = f"SampRate: {rate}"
    check(replay(made.write(tmp_path / "a.btd"))[2], RecordingError, "rate", rate)


@pytest.mark.parametrize("number", ["inf", "nan", "-Infinity", "seven"])
def test_header_number_that_is_none(log: Callable[..., Any], tmp_path: Path, number: str) -> None:
    made = log()
    made.header[8] = f"SampRate: {number}"
    path = made.write(tmp_path / "a.btd")
    check(replay(path)[2], RecordingError, "samprate", number, "not a number")


def test_a_key_that_nobody_uses_refuses_no_log(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.header[9] = "FramesInBatch: 7,7,7"
    readings, _, error = replay(made.write(tmp_path / "a.btd"))
    assert error is None
    assert readings


def test_wrong_number_of_columns_from_the_start(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"0.0 1 2 17 5\n" * 50)
    check(replay(path)[2], RecordingError, "line 1: the row has 5 columns", "value and parity")


def test_eighteen_electrodes(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(electrodes=list(range(17, 35))).write(tmp_path / "a.btd")
    check(replay(path)[2], RecordingError, "a.btd: the log has 18 electrodes, not 19 (E19 never")


def test_twenty_electrodes(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(electrodes=list(range(17, 37))).write(tmp_path / "a.btd")
    check(replay(path)[2], RecordingError, "20 electrodes, not 24 (E21, E22, E23, E24 never")


# --- parity and ports ---


def test_wrong_parity_invalidates_its_channel_and_is_counted(
    log: Callable[..., Any], tmp_path: Path
) -> None:
    made = log()
    for at in (2 * 44 + 1, 3 * 44 + 1):
        made.lines[at] = made.lines[at][:-1] + "1"
    readings, device, error = replay(made.write(tmp_path / "a.btd"))
    assert error is None
    assert [k for k, r in enumerate(readings) if r.validity != ch.ALL_VALID] == [2, 3]
    assert readings[2].validity == ch.ALL_VALID & ~1
    assert device.counters["parity_errors"] == 2
    assert device.counters["parity_errors_e1"] == 2


def test_port_without_sensor(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log().write(tmp_path / "a.btd")
    _, _, error = replay(path, port=2)
    check(error, RecordingError, "every slot of port 2 has wrong parity", "with data: 3")
    check(replay(path, port=5)[2], RecordingError, "no port 5, it has 3", "with data: 3")


def test_no_sensor_at_all(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log()
    made.lines = [line[:-1] + "1" for line in made.lines]
    check(replay(made.write(tmp_path / "a"))[2], RecordingError, "all 3 ports has wrong parity")


def test_several_fingers_need_a_choice(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log(style="log")
    made.lines = [line.replace("0 1 0 1 ", "7 0 0 1 ") for line in made.lines]
    path = made.write(tmp_path / "three")
    check(replay(path)[2], ConfigError, "2 fingers are in this log, at ports 1, 3", "option port")
    readings, _, error = replay(path, port=1)
    assert error is None
    assert readings[0].electrodes.tolist() == [7] * 19


def test_real_capture(shared_data: Path) -> None:
    folder = shared_data / "syntouch_btd_raw"
    if not (folder / "data.btd.gz").is_file():
        pytest.skip("the public BTD capture is not beside the project")
    readings, device, error = replay(folder / "data.btd.gz")
    assert error is None
    assert len(readings) == 2124
    counters = device.counters
    assert counters["samples"] == 93_456
    assert counters["missing_frames"] == 530
    assert counters["time_jumps"] == 154
    assert counters["parity_errors"] == counters["unknown_channels"] == 0
    assert counters["saturated_samples"] == 66
    # The serial starts as that of an SP, the layout is that of the 19-electrode sensor.
    assert device.identity.serial == "BTSP050400018017"
    assert device.info.sensor_type is SensorType.BIOTAC
    truth = np.load(folder / "frames.npz")
    names = {"electrodes_raw": "electrodes", "pac_raw": "pac", "pdc_raw": "pdc", "tac_raw": "tac",
             "tdc_raw": "tdc", "time_s": "time_s", "frame": "tick"}  # fmt: skip
    for key, name in names.items():
        assert np.array_equal(truth[key], [getattr(r, name) for r in readings]), key
    blocks = list(TextLogReader(folder / "data.btd.gz").blocks())
    batches = np.concatenate([block.batch for block in blocks])[::44]
    assert np.array_equal(truth["batch"], batches)
    assert all(r.validity == ch.ALL_VALID for r in readings)


def test_real_capture_has_nothing_at_port_1(shared_data: Path) -> None:
    path = shared_data / "syntouch_btd_raw" / "data.btd.gz"
    check(replay(path, port=1)[2], RecordingError, "port 1", "ports with data: 3")


def test_the_ports_of_a_log(log: Callable[..., Any], tmp_path: Path) -> None:
    made = log(style="log")
    made.lines = [line.replace("0 1 0 1 ", "7 0 0 1 ") for line in made.lines]
    assert ports_of(made.write(tmp_path / "two")) == (1, 3)
    assert ports_of(log().write(tmp_path / "one")) == (3,)
