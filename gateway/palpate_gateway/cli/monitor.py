"""``palpate gateway monitor``: a device's values, rate, age and counters, live."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.cli.measuring import Stream, Streams
from palpate_gateway.cli.probe import counter_lines, device_of
from palpate_gateway.cli.reading_text import text_of, values_of
from palpate_gateway.cli.stopping import until_told
from palpate_gateway.device import Device

_READ_S = 0.1
_AGAIN_S = 0.5
"""Pause before a lost device is opened again [s]."""
_REPORT_S = 1.0
_REFRESH_S = 0.25


class Monitor:
    """Reads a device, and opens it again when it is lost.

    Args:
        device: Closed.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.streams = Streams()
        self.lost = 0
        """How often it was lost."""
        self.error: DeviceError | None = None
        """Why it does not deliver now."""
        self.ended = False
        self._again_s = 0.0

    def step(self) -> None:
        """Take what comes within a tenth of a second."""
        if not self.device.is_open and time.monotonic() < self._again_s:
            time.sleep(_READ_S)
            return
        try:
            self.device.open()
            readings = self.device.read(_READ_S)
        except DeviceError as error:
            if self.device.is_open and isinstance(error, DeviceTimeout):
                return  # its age tells
            self.lost += self.device.is_open
            self.error = error
            self.device.close()
            self._again_s = time.monotonic() + _AGAIN_S
            return
        self.error = None
        self.ended = not readings
        self.streams.add(readings, time.monotonic())

    @property
    def state(self) -> str:
        """What to say of the device now."""
        if self.error is not None:
            return f"lost: {self.error}"
        return "ended" if self.ended else "open"

    def counters(self) -> dict[str, int]:
        """The device's since it was opened last, and how often it was lost."""
        return {**self.device.counters, "device_lost": self.lost}


def monitor_command(driver: str, pairs: Sequence[str], *, seconds: float, as_json: bool) -> int:
    """Show a device until ``seconds`` have passed (0 = Ctrl-C) or it ends.

    Raises:
        ConfigError: Unknown driver, or an option is unknown or wrong.
        MissingExtraError: The driver needs a package that is not installed.
        DeviceError: It cannot be opened at the start.
    """
    monitor = Monitor(device_of(driver, pairs))
    console = Console()
    with until_told(), monitor.device:
        if console.is_terminal and not as_json:
            with Live(console=console, auto_refresh=False) as live:
                for _ in _reports(monitor, seconds, _REFRESH_S):
                    live.update(_picture(monitor), refresh=True)
        else:
            for began_s in _reports(monitor, seconds, _REPORT_S):
                elapsed_s = time.monotonic() - began_s
                typer.echo(_json(monitor, elapsed_s) if as_json else _line(monitor, elapsed_s))
    return 0


def _reports(monitor: Monitor, seconds: float, every_s: float) -> Iterator[float]:
    """The start's time, each time that a report is due and at the end."""
    began_s = time.monotonic()
    until = began_s + seconds if seconds else math.inf
    due_s = measured_s = began_s
    while time.monotonic() < until and not monitor.ended:
        due_s += every_s
        while time.monotonic() < min(due_s, until) and not monitor.ended:
            monitor.step()
        # A rate needs a second, also where the picture is drawn more often.
        if time.monotonic() >= min(measured_s + _REPORT_S, until):
            measured_s += _REPORT_S
            monitor.streams.restart()
        yield began_s


def _rate(stream: Stream) -> str:
    return "no rate" if stream.told_hz is None else f"{stream.told_hz:.1f} Hz"


def _age_s(stream: Stream) -> float:
    return time.monotonic() - stream.heard_s


def _picture(monitor: Monitor) -> Group:
    table = Table()
    values = []
    for heading in ("stream", "readings", "rate", "age"):
        table.add_column(heading, justify="left" if heading == "stream" else "right", no_wrap=True)
    for name, stream in monitor.streams.by_name.items():
        table.add_row(name, str(stream.readings), _rate(stream), f"{_age_s(stream):.2f} s")
        # Values of a finger are wider than what a terminal has left beside the rest.
        values += [f"{name:10} {line}" for line in text_of(stream.last)]
    counters = counter_lines(monitor.counters())
    title = f"{monitor.device.info.model}: {monitor.state}"
    return Group(Text(title), table, Text("\n".join([*values, "", *counters])))


def _line(monitor: Monitor, elapsed_s: float) -> str:
    parts = [f"{elapsed_s:7.1f} s  {monitor.state}"]
    for name, stream in monitor.streams.by_name.items():
        age = f"age {_age_s(stream):.2f} s"
        parts.append(f"{name} {_rate(stream)} {age}: {'; '.join(text_of(stream.last))}")
    return "  |  ".join(parts)


def _json(monitor: Monitor, elapsed_s: float) -> str:
    streams = {
        name: {
            "readings": stream.readings,
            "rate_hz": stream.told_hz,
            "age_s": round(_age_s(stream), 4),
            "last": values_of(stream.last),
        }
        for name, stream in monitor.streams.by_name.items()
    }
    return json.dumps(
        {
            "elapsed_s": round(elapsed_s, 3),
            "state": monitor.state,
            "streams": streams,
            "counters": monitor.counters(),
        }
    )
