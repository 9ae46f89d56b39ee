"""A log as the maker's C library writes it: three fingers, no header, all time stamps zero.

Made by code in the shape of the one public log (hardware reference 1.8, 4.2: 13,200 rows, 300
frames, 60 batches): numbers begin with 1, a row ends with a space, the first is of channel 17.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from palpate.errors import ConfigError
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import ElectrodeReading

FRAMES, PORTS, SLOTS = 300, 3, 44
CHANNELS = [channel for one in (*range(17, 36), 1, 2, 3) for channel in (one, 0)]


@pytest.fixture(scope="module")
def counts() -> npt.NDArray[np.int64]:
    """What untouched fingers measured, shape ``(frames, slots, ports)``."""
    random = np.random.default_rng(300)
    rest = random.integers(1878, 3193, (1, SLOTS, PORTS))
    rest[0, 1::2] = 2040
    noise = random.integers(-5, 6, (FRAMES, SLOTS, PORTS))
    return rest + noise


@pytest.fixture(params=["plain", "packed"])
def path(request: pytest.FixtureRequest, tmp_path: Path, counts: npt.NDArray[np.int64]) -> Path:
    rows = [
        f"0.000000 {1 + frame // 5} {1 + frame} {channel} "
        + "".join(f"{count} 0 " for count in counts[frame, slot])
        for frame in range(FRAMES)
        for slot, channel in enumerate(CHANNELS)
    ]
    assert len(rows) == 13_200
    data = "".join(row + "\n" for row in rows).encode("ascii")
    file = tmp_path / "output.txt"
    file.write_bytes(gzip.compress(data) if request.param == "packed" else data)
    return file


def replay(path: Path, port: int) -> tuple[list[Any], dict[str, int]]:
    with make_device("text_log", {"path": path, "port": port}) as device:
        readings: list[Any] = []
        while got := device.read(1.0):
            readings += got
        return readings, dict(device.counters)


@pytest.mark.parametrize("port", [1, 2, 3])
def test_every_finger_is_read_without_loss(
    path: Path, port: int, counts: npt.NDArray[np.int64]
) -> None:
    readings, counters = replay(path, port)
    assert [one.tick for one in readings] == list(range(1, FRAMES + 1))
    assert all(isinstance(one, ElectrodeReading) for one in readings)
    assert {one.validity for one in readings} == {(1 << 44) - 1}
    assert counters.pop("samples") == FRAMES * SLOTS
    assert counters.pop("frames") == FRAMES
    assert not any(counters.values())
    mine = counts[:, :, port - 1]
    np.testing.assert_array_equal([one.electrodes for one in readings], mine[:, 0:38:2])
    np.testing.assert_array_equal([one.pac for one in readings], mine[:, 1::2])
    slow = [(one.pdc, one.tac, one.tdc) for one in readings]
    np.testing.assert_array_equal(slow, mine[:, [38, 40, 42]])


def test_times_are_rebuilt_on_the_grid_of_slots(path: Path) -> None:
    readings, _ = replay(path, 1)
    np.testing.assert_allclose(
        [one.time_s for one in readings], np.arange(FRAMES) * SLOTS / 4400.0, atol=1e-9
    )


def test_which_finger_must_be_said(path: Path) -> None:
    with pytest.raises(ConfigError, match="3 fingers are in this log, at ports 1, 2, 3"):
        make_device("text_log", {"path": path}).open()


def test_a_row_that_ends_with_a_space_takes_the_fast_way(
    path: Path, monkeypatch: pytest.MonkeyPatch, counts: npt.NDArray[np.int64]
) -> None:
    def slow(*_: object) -> Callable[..., Any]:
        raise AssertionError("line by line")

    monkeypatch.setattr("palpate_gateway.recordings.text_log_format._parse_slow", slow)
    assert len(replay(path, 2)[0]) == FRAMES
