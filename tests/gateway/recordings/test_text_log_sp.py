"""Logs of a BioTac SP, and of fingers whose slots were lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.messages import SensorType
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.recordings.text_log import TextLog, TextLogOptions


def replay(path: Path) -> tuple[list[ElectrodeReading], TextLog]:
    device = TextLog(TextLogOptions(path=path))
    device.open()
    readings: list[ElectrodeReading] = []
    while got := device.read(1.0):
        readings += [r for r in got if isinstance(r, ElectrodeReading)]
    return readings, device


@pytest.mark.parametrize("start", ["pac", "e1"])
@pytest.mark.parametrize("style", ["btd", "log"])
def test_biotac_sp(log: Callable[..., Any], tmp_path: Path, style: str, start: str) -> None:
    """Its channel ids tell it, not its serial number, which here is that of a BioTac."""
    made = log(style=style, start=start, electrodes=list(range(17, 41)), frame_numbers=[4, 5, 8, 9])
    readings, device = replay(made.write(tmp_path / "sp"))
    layout = SensorType.BIOTAC_SP.layout
    assert device.info.sensor_type is device.identity.sensor_type is SensorType.BIOTAC_SP
    assert device.info.rate_hz == pytest.approx(4400 / 54)
    assert device.counters["samples"] == 4 * 54
    assert device.counters["missing_frames"] == 2
    assert [r.validity for r in readings] == [layout.all_valid] * 4
    assert readings[1].electrodes.tolist() == [1000 + 20 * c + 5 for c in range(17, 41)]
    assert readings[1].pac.tolist() == [2000 + 2 * k + (start == "e1") for k in range(27)]
    frame_s = 54 / 4400
    times_s = np.array([0, 1, 4, 5] if style == "log" else [0, 1, 2, 3]) * frame_s
    assert np.allclose([r.time_s for r in readings], times_s, atol=1e-6)


@pytest.mark.parametrize("count", [19, 24])
@pytest.mark.parametrize("start", ["pac", "e1"])
@pytest.mark.parametrize("style", ["btd", "log"])
def test_a_lost_pac_row_leaves_the_others_in_place(
    log: Callable[..., Any], tmp_path: Path, style: str, start: str, count: int
) -> None:
    made = log(5, style=style, start=start, electrodes=list(range(17, 17 + count)))
    size = 2 * (count + 3)
    lost = 10 if start == "pac" else 11
    del made.lines[2 * size + lost], made.lines[lost]  # in the third frame, and in the first
    readings, device = replay(made.write(tmp_path / "a"))
    layout = (SensorType.BIOTAC if count == 19 else SensorType.BIOTAC_SP).layout
    pac = [2000 + 2 * k + (start == "e1") for k in range(count + 3)]
    with_hole = [*pac[:5], 0, *pac[6:]]
    hole = layout.all_valid & ~(1 << layout.first_pac_bit + 5)
    wanted = [(with_hole, hole), (pac, layout.all_valid)] * 2 + [(pac, layout.all_valid)]
    assert [(r.pac.tolist(), r.validity) for r in readings] == wanted
    assert device.counters["incomplete_frames"] == 2
    assert device.counters["unplaced_slots"] == device.counters["duplicate_slots"] == 0


def test_rows_of_an_sp_in_a_log_of_19_electrodes_are_counted(
    log: Callable[..., Any], tmp_path: Path
) -> None:
    made = log(3000)
    late = made.lines[-44].split()
    made.lines[-43] = " ".join([*late[:3], "38", *late[4:]])
    _, device = replay(made.write(tmp_path / "a.btd"))
    assert device.counters["other_electrodes"] == 1
    assert device.counters["incomplete_frames"] == 1
