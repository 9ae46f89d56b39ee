"""Runs an emulator as a program: shows its address and options, plays its fault plan."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import NamedTuple

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from palpate.errors import ConfigError, DeviceError, LinkError
from palpate.process import until_signal
from palpate_gateway.cli.emulate_devices import EmulatedDevice
from palpate_gateway.cli.key_values import command_words, sensor_toml

_TICK_S = 0.02
_SHOW_S = 0.5


class ScheduledFault(NamedTuple):
    """Begin of a fault [s after the start], its name, and its duration [s]; 0 = once."""

    start_s: float
    name: str
    duration_s: float


def parse_faults(texts: Iterable[str], known: Collection[str]) -> list[ScheduledFault]:
    """Faults in order of time.

    Raises:
        ConfigError: A text is not a fault, or the device has no such fault; names all faults.
    """
    faults = []
    for text in texts:
        name, _, when = text.partition("@")
        start, plus, duration = when.partition("+")
        try:
            fault = ScheduledFault(float(start), name, float(duration) if plus else 0.0)
        except ValueError:
            fault = ScheduledFault(math.nan, name, 0.0)
        if not (0.0 <= fault.start_s < math.inf and 0.0 <= fault.duration_s < math.inf):
            raise ConfigError(
                f"--fault {text!r} is not NAME@START[+SECONDS]",
                remedy="write e.g. silence@10+3: silence from 10 s to 13 s; or lost@5: once at 5 s",
            )
        if name not in known:
            raise ConfigError(
                f"--fault {text!r}: this device has no fault {name!r}",
                remedy=f"its faults: {', '.join(sorted(known))}",
            )
        faults.append(fault)
    return sorted(faults)


def run_emulator(
    name: str, device: EmulatedDevice, plan: Sequence[ScheduledFault], seconds: float
) -> None:
    """Serve with the faults of a plan until ``seconds`` have passed (0 = Ctrl-C).

    Raises:
        LinkError: The address is not available.
        DeviceError: The emulator failed, e.g. its bus is gone.
    """
    console = Console(stderr=True)
    with until_signal(), _crashes() as crashes:
        try:
            device.emulator.start()
        except device.failures as error:
            raise LinkError(
                f"{name}: the emulator cannot start there: {error}",
                remedy="choose another address, port, link or channel; ports below 1024 need root",
            ) from error
        try:
            _introduce(name, device)
            line = Live(console=console, auto_refresh=False) if console.is_terminal else None
            with line or nullcontext():
                _serve(device, plan, seconds, console, line, crashes)
        finally:
            device.emulator.stop()
            typer.echo(f"{name}: {device.emulator.sent} samples sent", err=True)


@contextmanager
def _crashes() -> Iterator[list[BaseException]]:
    """Exceptions that ended threads: a failed emulator must not look like one that serves."""
    crashes: list[BaseException] = []
    before = threading.excepthook

    def keep(crash: threading.ExceptHookArgs) -> None:
        crashes.append(crash.exc_value or RuntimeError(str(crash.exc_type)))

    threading.excepthook = keep
    try:
        yield crashes
    finally:
        threading.excepthook = before


def _introduce(name: str, device: EmulatedDevice) -> None:
    """Show its address, the tables for a profile, and a command that tries it."""
    typer.echo(f"# {name} at {device.emulator.address}; Ctrl-C ends it. For a profile:")
    sensors = device.sensors()
    for sensor, options in sensors:
        typer.echo("\n" + sensor_toml(sensor, device.driver, options), nl=False)
    typer.echo(f"\n# palpate gateway probe {device.driver} {command_words(sensors[0][1])}")


def _serve(
    device: EmulatedDevice,
    plan: Sequence[ScheduledFault],
    seconds: float,
    console: Console,
    live: Live | None,
    crashes: Sequence[BaseException],
) -> None:
    emulator, waiting = device.emulator, list(plan)
    began_s = shown_s = time.monotonic()
    shown, rate_hz = 0, 0.0
    until_s = seconds or math.inf
    while (elapsed_s := time.monotonic() - began_s) < until_s:
        if crashes:
            raise DeviceError(
                f"the emulator failed: {crashes[0]!r}",
                remedy="check its bus or address; if they are right, report this",
            ) from crashes[0]
        while waiting and waiting[0].start_s <= elapsed_s:
            fault = waiting.pop(0)
            emulator.inject(fault.name, fault.duration_s)
            how = f"for {fault.duration_s:g} s" if fault.duration_s else "once"
            said = Text(f"{elapsed_s:.1f} s: {fault.name} {how}")
            console.print(said, soft_wrap=True)
        since_s = time.monotonic() - shown_s
        if live is not None and since_s >= _SHOW_S:
            rate_hz = (emulator.sent - shown) / since_s
            shown, shown_s = emulator.sent, time.monotonic()
            line = f"{emulator.address}  {elapsed_s:.0f} s  {shown} samples sent  {rate_hz:.0f}/s"
            live.update(Text(line), refresh=True)
        time.sleep(min(_TICK_S, until_s - elapsed_s))
