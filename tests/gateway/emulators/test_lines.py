"""Emulated serial lines: whose a name is, what is never replaced or removed, and what is heard."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from palpate.errors import ConfigError
from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator
from palpate_gateway.emulators.biotac_pic32 import BiotacPic32Emulator
from palpate_gateway.emulators.biotac_slots import idle_counts
from palpate_gateway.emulators.bota import BotaEmulator
from palpate_gateway.emulators.emulator import no_load
from palpate_gateway.emulators.lines import SerialLine
from palpate_gateway.emulators.robotous import RobotousSerialEmulator

PATIENCE_S = 20.0


@pytest.fixture
def name(tmp_path: Path) -> Path:
    return tmp_path / "line"


@pytest.fixture
def line(name: Path) -> Iterator[SerialLine]:
    with closing(SerialLine(115200, str(name))) as made:
        made.plug()
        yield made


@pytest.mark.parametrize("unplugged", [False, True])
def test_a_name_is_that_of_one_line(line: SerialLine, name: Path, unplugged: bool) -> None:
    line.keep_plugged(not unplugged)
    with closing(SerialLine(9600, str(name))) as other:
        with pytest.raises(ConfigError, match="another emulator, which runs -> end that one"):
            other.plug()
        line.plug()
        assert name.exists()
        line.close()
        assert not name.is_symlink()
        other.plug()
        assert name.exists()


def test_two_ways_to_a_name_are_one(line: SerialLine, name: Path, tmp_path: Path) -> None:
    (tmp_path / "again").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="another emulator"):
        SerialLine(9600, str(tmp_path / "again" / name.name)).plug()


def test_the_name_that_a_killed_emulator_left_is_used_again(name: Path) -> None:
    # Its terminal may by now be that of another program.
    ours, other = os.openpty()
    try:
        name.symlink_to(os.ttyname(other))
        with closing(SerialLine(9600, str(name))) as line:
            line.plug()
            assert os.readlink(name) != os.ttyname(other)
        assert not name.is_symlink()
    finally:
        os.close(ours)
        os.close(other)


def test_a_link_of_the_users_stays(name: Path, tmp_path: Path) -> None:
    name.symlink_to(tmp_path)
    with closing(SerialLine(9600, str(name))) as line:
        with pytest.raises(ConfigError, match=r"is a link to .* -> choose another"):
            line.plug()
    assert name.readlink() == tmp_path


def test_what_replaced_the_line_is_not_removed_with_it(
    line: SerialLine, name: Path, tmp_path: Path
) -> None:
    name.unlink()
    name.symlink_to(tmp_path)
    line.close()
    assert name.readlink() == tmp_path


@pytest.mark.parametrize("kind", ["link", "file"])
def test_what_took_the_name_of_an_unplugged_line_stays(
    line: SerialLine, name: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A link was replaced by the line, and removed at its end; a file ended the emulator."""
    line.unplug()
    if kind == "link":
        name.symlink_to("/dev/ttyUSB0")
    else:
        name.write_text("mine")
    for _ in range(3):
        line.keep_plugged(True)
        assert not line.plugged
        assert line.read(0.0) == b""
    assert caplog.text.count(f"{name} cannot be made: File exists") == 1
    assert name.is_symlink() == (kind == "link")
    name.unlink()
    line.keep_plugged(True)
    assert name.readlink().is_char_device()
    line.close()
    assert not name.is_symlink()


def test_a_line_tells_whether_all_can_be_read(line: SerialLine) -> None:
    assert line.write(b"heard")
    while line.write(bytes(1000)):
        assert line.overrun == 0
    assert line.overrun > 0  # nobody reads, and it holds no more
    line.unplug()
    assert not line.write(b"lost")


@pytest.mark.parametrize(
    "kind", [BotaEmulator, RobotousSerialEmulator, BiotacPic32Emulator, BiotacBridgeEmulator]
)
def test_what_an_unplugged_device_measures_is_not_counted_as_sent(kind: Any) -> None:
    measured = 0

    def source(*at: float) -> Any:
        nonlocal measured
        measured += 1
        return no_load(at[0]) if len(at) == 1 else idle_counts(at[0], 0)

    if kind in (BotaEmulator, RobotousSerialEmulator):
        emulator = kind(source)
    else:
        emulator = kind(counts=source)
    if hasattr(emulator, "running"):
        emulator.running = True  # as after the request of a host
    emulator.inject("unplug", 1000.0)
    with emulator:
        deadline = time.monotonic() + PATIENCE_S
        while measured < 1000 if kind is BiotacBridgeEmulator else measured < 10:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert emulator.sent == 0
