"""``palpate gateway probe`` and ``monitor``: a device's values, rate, age and counters.

Probe opens a device once and reports all that it gives; monitor shows it live.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from palpate.errors import DeviceError, DeviceTimeout
from palpate.process import until_signal
from palpate_gateway.cli.key_values import parse_key_values, text_keys
from palpate_gateway.cli.streams import DeviceStream, DeviceStreams, measure, text_of, values_of
from palpate_gateway.device import Device
from palpate_gateway.drivers import load_driver, make_device

_FAILED = 1
_READ_S = 0.1
_AGAIN_S = 0.5
"""Pause before a lost device is opened again [s]."""
_REPORT_S = 1.0
_REFRESH_S = 0.25
_RATE_TOLERANCE = 0.05
_OF_NOMINAL_RATE = ("electrodes", "wrench", "pose")
"""Streams at the rate of the device; other streams of a virtual finger may be slower."""


def device_of(driver: str, pairs: Sequence[str]) -> Device:
    """The device of a command line, closed.

    Raises:
        ConfigError: Unknown driver, or an option is unknown or wrong.
        MissingExtraError: The driver needs a package that is not installed.
    """
    texts = text_keys(load_driver(driver).options_class)
    return make_device(driver, parse_key_values(pairs, texts))


def probe_command(driver: str, pairs: Sequence[str], *, seconds: float, as_json: bool) -> int:
    """Print identity, rates, first readings and counters of a device.

    Returns:
        0, or 1 if it cannot be opened or gives no reading.
    """
    device = device_of(driver, pairs)
    if not as_json:
        typer.echo(f"device     {device.info.model} ({driver})")
    try:
        with device:
            streams = measure(device, seconds)
            found = _found(device, streams)
    except DeviceError as error:
        counters = dict(device.counters)
        if as_json:
            told = {"error": error.problem, "fix": error.remedy, "counters": counters}
            typer.echo(json.dumps(told))
        else:
            for line in counter_lines(counters):
                typer.echo(line)
        typer.echo(f"error: {error.problem}", err=True)
        typer.echo(f"  fix: {error.remedy}", err=True)
        return _FAILED
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        _show(device, found, streams)
    return 0


def _found(device: Device, streams: DeviceStreams) -> dict[str, Any]:
    info = device.info
    return {
        "driver": info.driver,
        "model": info.model,
        "serial": device.identity.serial,
        "sensor_type": None if info.sensor_type is None else info.sensor_type.name.lower(),
        "nominal_rate_hz": info.rate_hz,
        "streams": {
            name: {
                "readings": stream.readings,
                "rate_hz": stream.rate_hz,
                "first": values_of(stream.first),
            }
            for name, stream in streams.by_name.items()
        },
        "counters": dict(device.counters),
    }


def _show(device: Device, found: dict[str, Any], streams: DeviceStreams) -> None:
    nominal_hz = device.info.rate_hz
    typer.echo(f"serial     {found['serial']}")
    typer.echo(f"nominal    {nominal_hz:.2f} Hz")
    for name, stream in streams.by_name.items():
        rate_hz = stream.rate_hz
        rate = "rate unknown: too few readings" if rate_hz is None else f"{rate_hz:.2f} Hz"
        typer.echo(f"{name:11}{rate} ({stream.readings} readings)")
        nominal = device.info.live and name in _OF_NOMINAL_RATE
        if nominal and rate_hz and abs(rate_hz / nominal_hz - 1.0) > _RATE_TOLERANCE:
            typer.echo(f"{'':11}note: this is not the nominal rate; see the counters")
        for line in text_of(stream.first):
            typer.echo(f"{'':11}{line}")
    for line in counter_lines(found["counters"]):
        typer.echo(line)


def counter_lines(counters: Mapping[str, int]) -> list[str]:
    """Counters above 0, and the names of those at 0."""
    above = ", ".join(f"{name} {count}" for name, count in sorted(counters.items()) if count)
    zero = ", ".join(name for name, count in sorted(counters.items()) if not count)
    lines = [f"counters   {above or 'none'}"]
    return [*lines, f"    all 0: {zero}"] if zero else lines


class DeviceMonitor:
    """Reads a device, and opens it again when it is lost."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.streams = DeviceStreams()
        self.lost = 0
        """How often the device was lost."""
        self.error: DeviceError | None = None
        """Error that stops the readings now."""
        self.ended = False
        self._again_s = 0.0

    def step(self) -> None:
        """Read for a tenth of a second."""
        if not self.device.is_open and time.monotonic() < self._again_s:
            time.sleep(_READ_S)
            return
        try:
            self.device.open()
            readings = self.device.read(_READ_S)
        except DeviceError as error:
            if self.device.is_open and isinstance(error, DeviceTimeout):
                return  # the age of its last reading shows it
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
        """State of the device."""
        if self.error is not None:
            return f"lost: {self.error}"
        return "ended" if self.ended else "open"

    def counters(self) -> dict[str, int]:
        """Counters of the device since its last opening, and how often it was lost."""
        return {**self.device.counters, "device_lost": self.lost}


def monitor_command(driver: str, pairs: Sequence[str], *, seconds: float, as_json: bool) -> int:
    """Show a device until ``seconds`` have passed (0 = Ctrl-C) or it ends.

    Raises:
        DeviceError: It cannot be opened at the start.
    """
    monitor = DeviceMonitor(device_of(driver, pairs))
    console = Console()
    with until_signal(), monitor.device:
        if console.is_terminal and not as_json:
            with Live(console=console, auto_refresh=False) as live:
                for _ in _reports(monitor, seconds, _REFRESH_S):
                    live.update(_picture(monitor), refresh=True)
        else:
            for began_s in _reports(monitor, seconds, _REPORT_S):
                elapsed_s = time.monotonic() - began_s
                typer.echo(_json(monitor, elapsed_s) if as_json else _line(monitor, elapsed_s))
    return 0


def _reports(monitor: DeviceMonitor, seconds: float, every_s: float) -> Iterator[float]:
    """The start's time, each time that a report is due and at the end."""
    began_s = time.monotonic()
    until = began_s + seconds if seconds else math.inf
    due_s = measured_s = began_s
    while time.monotonic() < until and not monitor.ended:
        due_s += every_s
        while time.monotonic() < min(due_s, until) and not monitor.ended:
            monitor.step()
        # Rates are measured over a second, although the picture is drawn more often.
        if time.monotonic() >= min(measured_s + _REPORT_S, until):
            measured_s += _REPORT_S
            monitor.streams.restart()
        yield began_s


def _rate(stream: DeviceStream) -> str:
    return "no rate" if stream.shown_hz is None else f"{stream.shown_hz:.1f} Hz"


def _age_s(stream: DeviceStream) -> float:
    return time.monotonic() - stream.last_s


def _picture(monitor: DeviceMonitor) -> Group:
    table = Table()
    values = []
    for heading in ("stream", "readings", "rate", "age"):
        table.add_column(heading, justify="left" if heading == "stream" else "right", no_wrap=True)
    for name, stream in monitor.streams.by_name.items():
        table.add_row(name, str(stream.readings), _rate(stream), f"{_age_s(stream):.2f} s")
        # The values of a finger are too wide for a column of the table.
        values += [f"{name:10} {line}" for line in text_of(stream.last)]
    counters = counter_lines(monitor.counters())
    title = f"{monitor.device.info.model}: {monitor.state}"
    return Group(Text(title), table, Text("\n".join([*values, "", *counters])))


def _line(monitor: DeviceMonitor, elapsed_s: float) -> str:
    parts = [f"{elapsed_s:7.1f} s  {monitor.state}"]
    for name, stream in monitor.streams.by_name.items():
        age = f"age {_age_s(stream):.2f} s"
        parts.append(f"{name} {_rate(stream)} {age}: {'; '.join(text_of(stream.last))}")
    return "  |  ".join(parts)


def _json(monitor: DeviceMonitor, elapsed_s: float) -> str:
    streams = {
        name: {
            "readings": stream.readings,
            "rate_hz": stream.shown_hz,
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
