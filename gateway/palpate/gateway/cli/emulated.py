"""Emulators with the options of the driver that reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.gateway.cli.key_values import parse_key_values
from palpate.gateway.emulators.emulator import Emulator
from palpate.protos.errors import ConfigError
from palpate.protos.extras import require

Options = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Emulated:
    """A device in software, not yet started.

    Attributes:
        name: What the command calls it.
        emulator: It.
        driver: The driver that reads it.
        sensors: Name and driver's options of each sensor; asked for once it runs, for only then are
            its ports known.
        failures: What its start raises where its address is taken or no such bus is there.
    """

    name: str
    emulator: Emulator
    driver: str
    sensors: Callable[[], list[tuple[str, Options]]]
    failures: tuple[type[Exception], ...] = (OSError,)


def kms40(host: str, port: int, serial: int) -> Emulated:
    """A KMS 40 over TCP."""
    from palpate.gateway.emulators.kms40 import Kms40Emulator

    emulator = Kms40Emulator(host=host, port=port, serial=serial)
    return Emulated(
        "kms40",
        emulator,
        "wrench_kms40",
        lambda: [("wrench", {**_host_port(emulator), "rate_hz": emulator.rate_hz})],
    )


def rdt(product: str, host: str, port: int, http_port: int, rate_hz: float) -> Emulated:
    """One of the products that speak RDT, by the driver's name."""
    from palpate.gateway.emulators.rdt import RdtEmulator

    kinds = {"ati_net_ft": "netft", "ati_axia": "axia", "schunk_ftn": "axia", "onrobot_hex": "hex"}
    emulator = RdtEmulator(
        kinds[product], rate_hz=rate_hz, host=host, port=port, http_port=http_port
    )

    def sensors() -> list[tuple[str, Options]]:
        options: Options = {"product": product, **_host_port(emulator)}
        if product != "onrobot_hex":
            options["http_port"] = emulator.page.port
        return [("wrench", {**options, "rate_hz": emulator.rate_hz})]

    return Emulated("rdt", emulator, "wrench_rdt", sensors)


def robotous_serial(link: Path | None, baud: int, model: str, serial: str) -> Emulated:
    """An RFT on a serial line.

    Raises:
        ConfigError: There is no such model or speed, or the link cannot be made.
    """
    from palpate.gateway.emulators.robotous import RobotousSerial

    _check_model(model)
    _check_baud(baud, (921600, 460800, 230400, 115200, 57600))
    emulator = RobotousSerial(baud=baud, path=_checked_link(link), model=model, serial=serial)
    return Emulated(
        "robotous",
        emulator,
        "wrench_robotous",
        lambda: [("wrench", {"port": emulator.address, "baud": baud, "rate_hz": 200})],
    )


def robotous_can(interface: str, channel: str, model: str, serial: str) -> Emulated:
    """An RFT on CAN.

    Raises:
        ConfigError: There is no such model.
        MissingExtraError: python-can is not installed.
    """
    from palpate.gateway.emulators.robotous import RobotousCan

    _check_model(model)
    emulator = RobotousCan(interface=interface, channel=channel, model=model, serial=serial)
    return Emulated(
        "robotous",
        emulator,
        "wrench_robotous",
        lambda: [("wrench", {"interface": interface, "channel": channel, "rate_hz": 200})],
        _can_failures(),
    )


def bota(link: Path | None, baud: int) -> Emulated:
    """A SensONE on a serial line.

    Raises:
        ConfigError: There is no such speed, or the link cannot be made.
    """
    from palpate.gateway.emulators.bota import BAUDS, Bota

    # At the slowest of its speeds not even its lowest rate gets through.
    _check_baud(baud, [one for one in BAUDS if one > 9600])
    emulator = Bota(baud=baud, path=_checked_link(link))
    rate_hz = 400.0 if baud >= 230400 else 100.0
    return Emulated(
        "bota",
        emulator,
        "wrench_bota",
        lambda: [("wrench", {"port": emulator.address, "baud": baud, "rate_hz": rate_hz})],
    )


def biotac_can(
    interface: str,
    channel: str,
    bus: Sequence[str],
    *,
    fingers: int,
    can_id: int,
    slot_rate_hz: float,
    pac_first: bool,
) -> Emulated:
    """BioTacs at a CAN interface.

    Raises:
        ConfigError: An option of the bus is not KEY=VALUE.
        MissingExtraError: python-can is not installed.
    """
    from palpate.gateway.emulators.biotac_can import BiotacCanEmulator

    options = parse_key_values(bus)
    emulator = BiotacCanEmulator(
        interface,
        channel,
        fingers=fingers,
        can_id=can_id,
        slot_rate_hz=slot_rate_hz,
        pac_first=pac_first,
        options=options,
    )
    shared: Options = {"interface": interface, "channel": channel}
    if options:
        shared["bus_options"] = options
    shared |= {"can_id": can_id, "fingers": fingers, "slot_rate_hz": slot_rate_hz}
    if pac_first:
        shared["sequence"] = "biotac_pac_first"
    return Emulated(
        "biotac-can",
        emulator,
        "biotac_can",
        lambda: [(f"finger{port}", {**shared, "port": port}) for port in range(1, fingers + 1)],
        _can_failures(),
    )


def _host_port(emulator: Emulator) -> Options:
    host, _, port = emulator.address.rpartition(":")
    return {"host": host, "port": int(port)}


def _can_failures() -> tuple[type[Exception], ...]:
    return (OSError, ValueError, TypeError, require("can", extra="gateway").CanError)


def _checked_link(link: Path | None) -> str:
    """Where to put the line's name; nothing but an earlier line's name is replaced."""
    if link is None:
        return ""
    if link.exists() and not link.is_symlink():
        raise ConfigError(f"--link {link}: a file of this name is there", remedy="name another")
    if not link.parent.is_dir():
        raise ConfigError(
            f"--link {link}: there is no folder {link.parent}", remedy="make it, or name another"
        )
    return str(link.absolute())


def _check_model(model: str) -> None:
    from palpate.gateway.emulators.robotous import TORQUE_DIVISORS

    if model not in TORQUE_DIVISORS:
        raise ConfigError(
            f"--model {model}: there is no such sensor",
            remedy=f"one of {', '.join(TORQUE_DIVISORS)}",
        )


def _check_baud(baud: int, known: Sequence[int]) -> None:
    if baud not in known:
        told = ", ".join(str(one) for one in sorted(known))
        raise ConfigError(f"--baud {baud}: the device knows no such speed", remedy=f"one of {told}")
