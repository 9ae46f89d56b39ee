"""``palpate gateway probe``: open a device once and tell all that it tells."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import typer

from palpate.errors import DeviceError
from palpate_gateway.cli.key_values import parse_key_values, text_keys
from palpate_gateway.cli.measuring import Streams, measure
from palpate_gateway.cli.reading_text import text_of, values_of
from palpate_gateway.device import Device
from palpate_gateway.drivers import load_driver, make_device

_FAILED = 1
_RATE_TOLERANCE = 0.05
_OF_NOMINAL_RATE = ("electrodes", "wrench", "pose")
"""Streams that come at a device's rate; a virtual finger's others may be slower."""


def device_of(driver: str, pairs: Sequence[str]) -> Device:
    """The closed device that a command line describes.

    Raises:
        ConfigError: Unknown driver, or an option is unknown or wrong.
        MissingExtraError: The driver needs a package that is not installed.
    """
    texts = text_keys(load_driver(driver).options_class)
    return make_device(driver, parse_key_values(pairs, texts))


def probe_command(driver: str, pairs: Sequence[str], *, seconds: float, as_json: bool) -> int:
    """Print what a device tells.

    Returns:
        0, or 1 if it cannot be opened or brings nothing.

    Raises:
        ConfigError: Unknown driver, or an option is unknown or wrong.
        MissingExtraError: The driver needs a package that is not installed.
    """
    device = device_of(driver, pairs)
    if not as_json:
        typer.echo(f"device     {device.info.model} ({driver})")
    try:
        with device:
            streams = measure(device, seconds)
            found = _found(device, streams)
    except DeviceError as error:
        if as_json:
            typer.echo(json.dumps({"error": error.problem, "fix": error.remedy}))
        typer.echo(f"error: {error.problem}", err=True)
        typer.echo(f"  fix: {error.remedy}", err=True)
        return _FAILED
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        _show(device, found, streams)
    return 0


def _found(device: Device, streams: Streams) -> dict[str, Any]:
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


def _show(device: Device, found: dict[str, Any], streams: Streams) -> None:
    nominal_hz = device.info.rate_hz
    typer.echo(f"serial     {found['serial']}")
    typer.echo(f"nominal    {nominal_hz:.2f} Hz")
    for name, stream in streams.by_name.items():
        rate_hz = stream.rate_hz
        told = "rate not known, too few came" if rate_hz is None else f"{rate_hz:.2f} Hz"
        typer.echo(f"{name:11}{told} ({stream.readings} readings)")
        nominal = device.info.live and name in _OF_NOMINAL_RATE
        if nominal and rate_hz and abs(rate_hz / nominal_hz - 1.0) > _RATE_TOLERANCE:
            typer.echo(f"{'':11}note: this is not the nominal rate; look at the counters")
        for line in text_of(stream.first):
            typer.echo(f"{'':11}{line}")
    for line in counter_lines(found["counters"]):
        typer.echo(line)


def counter_lines(counters: Mapping[str, int]) -> list[str]:
    """Counters that counted, and the names of those that did not."""
    told = ", ".join(f"{name} {count}" for name, count in sorted(counters.items()) if count)
    zero = ", ".join(name for name, count in sorted(counters.items()) if not count)
    lines = [f"counters   {told or 'none'}"]
    return [*lines, f"    all 0: {zero}"] if zero else lines
