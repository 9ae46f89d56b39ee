"""A serial line over a pseudo terminal: bytes, silence, unplugging, and what cannot be opened."""

from __future__ import annotations

import os
import pty
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.ports.port import settle
from palpate_gateway.ports.serial_port import SerialPort

serial = pytest.importorskip("serial")


class Plug:
    """The device's end of a line."""

    def __init__(self) -> None:
        self.device, host = pty.openpty()
        tty.setraw(self.device)
        tty.setraw(host)
        self.name = os.ttyname(host)
        self._host: int | None = host

    def pull(self) -> None:
        """Both ends are closed, as by an unplugged adapter."""
        for end in (self.device, self._host):
            if end is not None:
                os.close(end)
        self.device, self._host = -1, None


@pytest.fixture
def plug() -> Iterator[Plug]:
    made = Plug()
    yield made
    if made.device >= 0:
        made.pull()


def test_bytes_go_both_ways(plug: Plug) -> None:
    with SerialPort(plug.name, 230400) as port:
        os.write(plug.device, b"\x00\xff\r\n\x11\x13hello")
        assert port.read(1.0) == b"\x00\xff\r\n\x11\x13hello"
        port.write(b"\x00abc\n")
        assert os.read(plug.device, 100) == b"\x00abc\n"


def test_the_first_byte_ends_the_wait(plug: Plug) -> None:
    with SerialPort(plug.name, 230400) as port:
        later = threading.Timer(0.05, os.write, (plug.device, b"now"))
        later.start()
        got = b""
        while len(got) < 3:
            got += port.read(10.0)
        later.join()
    assert got == b"now"


def test_a_device_that_takes_nothing_is_told_and_asked_no_more(plug: Plug) -> None:
    with SerialPort(plug.name, 230400) as port:
        os.set_blocking(plug.device, False)
        # As by a low CTS: the line's output is stopped, and nothing leaves it.
        stopped = os.open(plug.name, os.O_RDWR | os.O_NOCTTY)
        termios.tcflow(stopped, termios.TCOOFF)
        with pytest.raises(DeviceLost, match=r"takes no bytes for 1 s.*RTS/CTS"):
            port.write(b"one")
        termios.tcflow(stopped, termios.TCOON)
        os.close(stopped)
        with pytest.raises(DeviceLost, match="takes no bytes"):
            port.write(b"two")
        with pytest.raises(BlockingIOError):
            os.read(plug.device, 100)
        port.close()
        port.open()
        port.write(b"three")
        assert os.read(plug.device, 100) == b"three"


def test_a_device_that_does_not_read_any_more_is_told(plug: Plug) -> None:
    with (
        SerialPort(plug.name, 230400) as port,
        pytest.raises(DeviceLost, match="takes no bytes"),
    ):
        port.write(bytes(1 << 20))


def test_silence_is_a_timeout_and_reading_goes_on(plug: Plug) -> None:
    with SerialPort(plug.name, 230400) as port:
        with pytest.raises(DeviceTimeout, match=r"nothing came within 0\.01 s"):
            port.read(0.01)
        os.write(plug.device, b"x")
        assert port.read(1.0) == b"x"


def test_unplugging_is_told_and_another_line_may_be_opened(plug: Plug) -> None:
    port = SerialPort(plug.name, 230400)
    port.open()
    plug.pull()
    with pytest.raises(DeviceLost, match="is gone"):
        port.read(0.2)
    port.close()
    port.close()
    with pytest.raises(DeviceError, match="not open"):
        port.read(0.1)


def test_a_line_that_is_not_there_says_what_to_do(tmp_path: Path) -> None:
    port = SerialPort(str(tmp_path / "ttyUSB9"), 115200)
    with pytest.raises(DeviceError, match=r"ttyUSB9: cannot be opened.*-> plug it in"):
        port.open()


def test_adapter_that_is_pulled_while_it_is_opened_is_told(
    plug: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Then pyserial lets the system's own error through, which is no OSError.
    monkeypatch.setattr(serial.Serial, "_update_dtr_state", lambda _: plug.pull())
    with pytest.raises(DeviceError, match="cannot be opened"):
        SerialPort(plug.name, 230400).open()


def test_adapter_that_is_pulled_while_it_takes_nothing_is_told(
    plug: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(_: object) -> None:
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr(serial.Serial, "reset_output_buffer", gone)
    with (
        SerialPort(plug.name, 230400) as port,
        pytest.raises(DeviceLost, match="is gone"),
    ):
        port.write(bytes(1 << 20))


def test_a_line_is_for_one_program(plug: Plug) -> None:
    with SerialPort(plug.name, 230400), pytest.raises(DeviceError, match="another program"):
        SerialPort(plug.name, 230400).open()


def test_settling_ends_on_a_line_that_never_rests(plug: Plug) -> None:
    stop = threading.Event()

    def talk() -> None:
        while not stop.is_set():
            os.write(plug.device, b"noise")
            time.sleep(0.005)

    talker = threading.Thread(target=talk)
    with SerialPort(plug.name, 230400) as port:
        talker.start()
        assert settle(port, quiet_s=0.5, longest_s=0.2) > 0
        stop.set()
        talker.join()
        settle(port, quiet_s=0.05, longest_s=5.0)
        with pytest.raises(DeviceTimeout):
            port.read(0.01)
