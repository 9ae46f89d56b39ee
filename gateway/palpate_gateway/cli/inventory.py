"""``palpate gateway list``: drivers, serial ports and CAN interfaces of this host."""

from __future__ import annotations

import importlib.util
import json
import logging
import re
import sys
from pathlib import Path
from types import ModuleType

import typer

from palpate.errors import MissingExtraError, PalpateError
from palpate.process import require
from palpate_gateway.drivers import driver_names, find_driver

BY_ID = Path("/dev/serial/by-id")
"""Names of serial ports that do not depend on the USB socket."""

_DISTRIBUTION = {"can": "python-can", "serial": "pyserial", "rosbags": "rosbags"}

_NOT_HARDWARE = frozenset({"virtual", "udp_multicast", "serial", "socketcand"})
"""Interfaces without hardware, or that python-can finds only by seconds of network traffic."""

_DETECT_S = 2.0


def list_command(*, as_json: bool) -> None:
    """Print drivers, serial ports and CAN interfaces."""
    drivers = [_about(name) for name in driver_names()]
    found = {"drivers": drivers, "serial_ports": serial_ports(), "can_interfaces": can_buses()}
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    typer.echo("drivers")
    width = max(len(str(driver["name"])) for driver in drivers)
    for driver in drivers:
        missing = driver["missing"]
        state = f"not installed: {missing}" if missing else "ready"
        typer.echo(f"  {driver['name']:{width}}  {driver['about']}  [{state}]")
    typer.echo("\nserial ports")
    _show(found["serial_ports"], ("by_id", "port", "what"))
    typer.echo("\nCAN interfaces")
    _show(found["can_interfaces"], ("interface", "channel", "more"))


def _show(found: list[dict[str, str]] | str, keys: tuple[str, ...]) -> None:
    if isinstance(found, str):
        typer.echo(f"  {found}")
    elif not found:
        typer.echo("  none found")
    else:
        for one in found:
            typer.echo("  " + "  ".join(one[key] for key in keys if one[key]))


def _about(name: str) -> dict[str, str]:
    """Name of a driver, its description, and its missing packages."""
    try:
        device = find_driver(name)
    except PalpateError as error:
        return {"name": name, "about": error.problem, "missing": error.remedy}
    line = (sys.modules[device.__module__].__doc__ or "").strip().partition("\n")[0]
    missing = [one for one in device.needs if importlib.util.find_spec(one) is None]
    names = ", ".join(_DISTRIBUTION[one] for one in sorted(missing))
    return {
        "name": name,
        # The reference of the protocol is of no use in a list of drivers.
        "about": re.sub(r" \([^()]*hardware reference[^()]*\)", "", line).rstrip("."),
        "missing": f'{names}; pip install "palpate[gateway]"' if missing else "",
    }


def serial_ports() -> list[dict[str, str]] | str:
    """Ports with their names by id; a message if they cannot be listed."""
    try:
        list_ports = require("serial.tools.list_ports", extra="gateway")
    except MissingExtraError as error:
        return str(error)
    steady = {link.resolve(): link for link in sorted(BY_ID.glob("*"))} if BY_ID.is_dir() else {}
    ports = []
    for port in sorted(list_ports.comports(), key=lambda one: str(one.device)):
        link = steady.get(Path(port.device).resolve())
        what = "" if port.description == "n/a" else str(port.description)
        ports.append({"by_id": str(link or ""), "port": str(port.device), "what": what})
    return ports


def can_buses() -> list[dict[str, str]] | str:
    """Adapters that python-can finds; a message if they cannot be listed."""
    try:
        can = require("can", extra="gateway")
    except MissingExtraError as error:
        return str(error)
    # Each kind without its vendor's library logs a warning, which is of no use here.
    log = logging.getLogger("can")
    before = log.level
    log.setLevel(logging.CRITICAL)
    found = []
    try:
        for kind in sorted(set(can.VALID_INTERFACES) - _NOT_HARDWARE):
            found += _configs(can, kind)
    finally:
        log.setLevel(before)
    return found


def _configs(can: ModuleType, kind: str) -> list[dict[str, str]]:
    try:
        configs = can.detect_available_configs(kind, timeout=_DETECT_S)
    except Exception:
        # A vendor's driver may raise anything; then it has no adapter to offer.
        return []
    out = []
    for config in configs:
        more = {key: value for key, value in config.items() if key not in ("interface", "channel")}
        listed = " ".join(f"{key}={value}" for key, value in more.items())
        channel = str(config.get("channel", ""))
        out.append({"interface": kind, "channel": channel, "more": listed})
    return out
