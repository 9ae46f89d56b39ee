"""Runs an emulator as a program: where it is, what reads it, its faults, how much it has sent."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from palpate.errors import DeviceError, LinkError
from palpate_gateway.cli.emulated import Emulated
from palpate_gateway.cli.faults import Fault, parse_faults
from palpate_gateway.cli.key_values import command_words, sensor_toml
from palpate_gateway.cli.stopping import until_told

_TICK_S = 0.02
_SHOW_S = 0.5


def emulate_command(device: Emulated, faults: Sequence[str], seconds: float) -> None:
    """Serve until ``seconds`` have passed (0 = Ctrl-C).

    Raises:
        ConfigError: A fault is unknown.
        LinkError: The address cannot be had.
        DeviceError: It cannot go on, e.g. its bus is gone.
    """
    plan = parse_faults(faults, device.emulator.faults)
    console = Console(stderr=True)
    with until_told(), _crashes() as crashes:
        try:
            device.emulator.start()
        except device.failures as error:
            raise LinkError(
                f"{device.name}: no device can be put there: {error}",
                remedy="choose another address, port, link or channel; ports below 1024 need root",
            ) from error
        try:
            _introduce(device)
            line = Live(console=console, auto_refresh=False) if console.is_terminal else None
            with line or nullcontext():
                _serve(device, plan, seconds, line, crashes)
        finally:
            device.emulator.stop()
            typer.echo(f"{device.name}: {device.emulator.sent} samples sent", err=True)


@contextmanager
def _crashes() -> Iterator[list[BaseException]]:
    """What threads died of: an emulator that has died must not look like one that serves."""
    crashes: list[BaseException] = []
    before = threading.excepthook

    def keep(crash: threading.ExceptHookArgs) -> None:
        crashes.append(crash.exc_value or RuntimeError(str(crash.exc_type)))

    threading.excepthook = keep
    try:
        yield crashes
    finally:
        threading.excepthook = before


def _introduce(device: Emulated) -> None:
    """Its address, the profile's tables that read it, and a command that tries it."""
    typer.echo(f"# {device.name} at {device.emulator.address}; Ctrl-C ends it. For a profile:")
    sensors = device.sensors()
    for name, options in sensors:
        typer.echo("\n" + sensor_toml(name, device.driver, options), nl=False)
    typer.echo(f"\n# palpate gateway probe {device.driver} {command_words(sensors[0][1])}")


def _serve(
    device: Emulated,
    plan: Sequence[Fault],
    seconds: float,
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
                f"{device.name}: it cannot go on: {crashes[0]!r}",
                remedy="check its bus or address; if they are right, report this",
            ) from crashes[0]
        while waiting and waiting[0].start_s <= elapsed_s:
            fault = waiting.pop(0)
            emulator.inject(fault.name, fault.duration_s)
            how = f"for {fault.duration_s:g} s" if fault.duration_s else "once"
            _say(live, f"{elapsed_s:.1f} s: {fault.name} {how}")
        since_s = time.monotonic() - shown_s
        if live is not None and since_s >= _SHOW_S:
            rate_hz = (emulator.sent - shown) / since_s
            shown, shown_s = emulator.sent, time.monotonic()
            line = f"{emulator.address}  {elapsed_s:.0f} s  {shown} samples sent  {rate_hz:.0f}/s"
            live.update(Text(line), refresh=True)
        time.sleep(min(_TICK_S, until_s - elapsed_s))


def _say(live: Live | None, text: str) -> None:
    if live is None:
        typer.echo(text, err=True)
    else:
        live.console.print(text, markup=False, highlight=False)
