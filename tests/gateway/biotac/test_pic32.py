"""The PIC32 driver against its emulator, over a pseudo terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.gateway.reading_devices import Follower

from palpate.config import parse_config
from palpate.errors import DeviceError
from palpate_gateway.biotac.pic32 import VALIDITY, BiotacPic32, Pic32Options
from palpate_gateway.emulators.biotac_pic32 import BiotacPic32Emulator
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.readings import ElectrodeReading

pytest.importorskip("serial")


class Board(Follower[ElectrodeReading]):
    """What the board's finger measured is known."""

    def assert_right(self) -> None:
        """Every reading is what the finger measured."""
        right = idle_counts(0.0, 0)
        for one in self.readings:
            np.testing.assert_array_equal(one.electrodes, right[:19])
            assert (one.pdc, one.tac, one.tdc) == tuple(right[19:22])
            assert 2040 <= one.pac[0] < 2045
            assert not one.pac[1:].any()
            assert one.validity == VALIDITY


@pytest.fixture
def board() -> Iterator[BiotacPic32Emulator]:
    # Its timer wraps during the test.
    with BiotacPic32Emulator(ticks=2**32 - 40_000_000, load_g=(120, 118)) as emulator:
        yield emulator


def make(board: BiotacPic32Emulator, **options: Any) -> BiotacPic32:
    values = {"port": board.address, **options}
    return BiotacPic32(parse_config(Pic32Options, values, where="test"))


@pytest.fixture
def follower(board: BiotacPic32Emulator) -> Iterator[Board]:
    device = make(board)
    yield Board(device, ElectrodeReading)
    device.close()


def test_one_frame_each_tick(follower: Board) -> None:
    readings = follower.more(150)
    follower.assert_right()
    assert not follower.errors
    ticks = np.diff([one.tick for one in readings])
    assert ticks.min() >= 1
    assert [one.missed_before for one in readings[1:]] == list(ticks - 1)
    times = np.diff([one.time_s for one in readings])
    assert np.median(times) == pytest.approx(0.01, abs=1e-5)
    assert VALIDITY.bit_count() == 23


def test_the_older_firmware() -> None:
    with BiotacPic32Emulator(electrodes_first=True) as board:
        follower = Board(make(board, layout="electrodes_first", serial="BT-7"), ElectrodeReading)
        follower.more()
        follower.assert_right()
        assert follower.device.identity.serial == "BT-7"
        follower.device.close()
        follower.device.close()


@pytest.mark.parametrize("fault", ["restart", "unplug", "silence"])
def test_a_board_that_is_gone_is_found_again(
    board: BiotacPic32Emulator, follower: Board, fault: str
) -> None:
    follower.more()
    board.inject(fault, 0.0 if fault == "restart" else 0.8)
    follower.until(lambda: follower.errors)
    follower.more()
    follower.assert_right()


def test_saturated_stuck_and_drifting_come_out_as_they_are(
    board: BiotacPic32Emulator, follower: Board
) -> None:
    follower.more()
    board.inject("clock_drift", 1.0)
    board.inject("saturated", 0.3)
    follower.until(lambda: follower.readings[-1].pac[0] == 4095)
    follower.until(lambda: follower.readings[-1].pac[0] != 4095)
    board.inject("stuck", 20.0)
    follower.until(lambda: len({int(one.pac[0]) for one in follower.more(8)}) == 1)
    assert not follower.errors


def test_a_stream_that_runs_already_is_stopped_first(board: BiotacPic32Emulator) -> None:
    killed = make(board)
    Board(killed, ElectrodeReading).more()
    killed._port.close()  # as of a process that is killed
    second = Board(make(board), ElectrodeReading)
    second.more()
    second.assert_right()
    assert not second.errors
    second.device.close()


def test_nobody_there_and_the_wrong_speed_are_told(board: BiotacPic32Emulator) -> None:
    with pytest.raises(DeviceError, match="no record within 1 s of command 'r'"):
        make(board, baud=115200).open()
    with pytest.raises(DeviceError, match="cannot be opened"):
        make(board, port=board.address + "-none").open()


def test_a_finger_that_was_pulled_is_told_and_not_delivered_as_zeros(
    board: BiotacPic32Emulator, follower: Board
) -> None:
    follower.more()
    board.inject("absent", 60.0)
    # Reading says so, and so does each attempt to open again.
    follower.until(lambda: sum("no finger answers" in str(one) for one in follower.errors) > 1)
    board.end("absent")
    follower.more()
    follower.assert_right()
    assert follower.counts()["absent"] > 10
