"""Emulators with the options of the driver that reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.errors import ConfigError
from palpate.extras import require
from palpate_gateway.cli.key_values import parse_key_values
from palpate_gateway.emulators.emulator import Emulator, WrenchSource

if TYPE_CHECKING:
    from palpate_gateway.emulators.biotac_slots import CountSource

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


def kms40(source: WrenchSource, *, host: str, port: int, serial: int, drift_ppm: float) -> Emulated:
    """A KMS 40 over TCP."""
    from palpate_gateway.emulators.kms40 import Kms40Emulator

    emulator = Kms40Emulator(source, host=host, port=port, serial=serial, drift_ppm=drift_ppm)
    return Emulated(
        "kms40",
        emulator,
        "wrench_kms40",
        lambda: [("wrench", {**_host_port(emulator), "rate_hz": emulator.rate_hz})],
    )


def rdt(source: WrenchSource, product: str, **options: Any) -> Emulated:
    """One of the products that speak RDT, by the driver's name; options of its emulator."""
    from palpate_gateway.emulators.rdt import RdtEmulator

    kinds = {"ati_net_ft": "netft", "ati_axia": "axia", "schunk_ftn": "axia", "onrobot_hex": "hex"}
    emulator = RdtEmulator(kinds[product], source, **options)

    def sensors() -> list[tuple[str, Options]]:
        told: Options = {"product": product, **_host_port(emulator)}
        if product != "onrobot_hex":
            told["http_port"] = emulator.page.port
        return [("wrench", {**told, "rate_hz": emulator.rate_hz})]

    return Emulated("rdt", emulator, "wrench_rdt", sensors)


def robotous_serial(
    source: WrenchSource, link: Path | None, baud: int, *, model: str, **options: Any
) -> Emulated:
    """An RFT on a serial line; options of its emulator.

    Raises:
        ConfigError: There is no such model or speed, or the link cannot be made.
    """
    from palpate_gateway.emulators.robotous import RobotousSerial

    _check_model(model)
    _check_baud(baud, (921600, 460800, 230400, 115200, 57600))
    emulator = RobotousSerial(source, baud, _checked_link(link), model=model, **options)
    return Emulated(
        "robotous",
        emulator,
        "wrench_robotous",
        lambda: [("wrench", {"port": emulator.address, "baud": baud, "rate_hz": 200})],
    )


def robotous_can(
    source: WrenchSource, interface: str, channel: str, *, model: str, **options: Any
) -> Emulated:
    """An RFT on CAN; options of its emulator.

    Raises:
        ConfigError: There is no such model.
        MissingExtraError: python-can is not installed.
    """
    from palpate_gateway.emulators.robotous import RobotousCan

    _check_model(model)
    emulator = RobotousCan(source, interface=interface, channel=channel, model=model, **options)
    return Emulated(
        "robotous",
        emulator,
        "wrench_robotous",
        lambda: [("wrench", {"interface": interface, "channel": channel, "rate_hz": 200})],
        _can_failures(),
    )


def bota(source: WrenchSource, link: Path | None, baud: int, *, drift_ppm: float) -> Emulated:
    """A SensONE on a serial line.

    Raises:
        ConfigError: There is no such speed, or the link cannot be made.
    """
    from palpate_gateway.emulators.bota import BAUDS, Bota

    # At the slowest of its speeds not even its lowest rate gets through.
    _check_baud(baud, [one for one in BAUDS if one > 9600])
    emulator = Bota(source, baud=baud, path=_checked_link(link), drift_ppm=drift_ppm)
    rate_hz = 400.0 if baud >= 230400 else 100.0
    return Emulated(
        "bota",
        emulator,
        "wrench_bota",
        lambda: [("wrench", {"port": emulator.address, "baud": baud, "rate_hz": rate_hz})],
    )


def biotac_can(
    source: CountSource,
    interface: str,
    channel: str,
    bus: Sequence[str],
    *,
    fingers: int,
    can_id: int,
    slot_rate_hz: float,
    pac_first: bool,
    electrodes: int,
    drift_ppm: float,
) -> Emulated:
    """BioTacs at a CAN interface.

    Raises:
        ConfigError: An option of the bus is not KEY=VALUE.
        MissingExtraError: python-can is not installed.
    """
    from palpate_gateway.emulators.biotac_can import BiotacCanEmulator

    options = parse_key_values(bus)
    emulator = BiotacCanEmulator(
        interface,
        channel,
        fingers=fingers,
        counts=source,
        can_id=can_id,
        slot_rate_hz=slot_rate_hz,
        pac_first=pac_first,
        electrodes=electrodes,
        drift_ppm=drift_ppm,
        options=options,
    )
    shared: Options = {"interface": interface, "channel": channel}
    if options:
        shared["bus_options"] = options
    shared |= {"can_id": can_id, "fingers": fingers, "slot_rate_hz": slot_rate_hz}
    shared |= _sequence(electrodes, pac_first=pac_first)
    return Emulated(
        "biotac-can", emulator, "biotac_can", lambda: _ports(shared, fingers), _can_failures()
    )


def biotac_bridge(
    source: CountSource,
    link: Path | None,
    baud: int,
    *,
    fingers: int,
    source_id: int,
    pac_first: bool,
    electrodes: int,
    **options: Any,
) -> Emulated:
    """BioTacs behind a bridge; options of its emulator.

    Raises:
        ConfigError: A terminal knows no such speed, or the link cannot be made.
    """
    from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator
    from palpate_gateway.emulators.serial_line import speeds

    _check_baud(baud, speeds())
    emulator = BiotacBridgeEmulator(
        fingers=fingers,
        counts=source,
        source=source_id,
        baud=baud,
        path=_checked_link(link),
        pac_first=pac_first,
        electrodes=electrodes,
        **options,
    )

    def sensors() -> list[tuple[str, Options]]:
        shared: Options = {"line": emulator.address, "baud": baud, "source": source_id}
        return _ports(shared | _sequence(electrodes, pac_first=pac_first), fingers)

    return Emulated("biotac-bridge", emulator, "biotac_bridge", sensors)


def biotac_pic32(
    source: CountSource,
    link: Path | None,
    baud: int,
    *,
    electrodes_first: bool,
    drift_ppm: float,
) -> Emulated:
    """A BioTac at a PIC32 board.

    Raises:
        ConfigError: A terminal knows no such speed, or the link cannot be made.
    """
    from palpate_gateway.emulators.biotac_pic32 import BiotacPic32Emulator
    from palpate_gateway.emulators.serial_line import speeds

    _check_baud(baud, speeds())
    emulator = BiotacPic32Emulator(
        counts=source,
        electrodes_first=electrodes_first,
        baud=baud,
        path=_checked_link(link),
        drift_ppm=drift_ppm,
    )
    layout = "electrodes_first" if electrodes_first else "pac_first"
    return Emulated(
        "biotac-pic32",
        emulator,
        "biotac_pic32",
        lambda: [("finger", {"port": emulator.address, "baud": baud, "layout": layout})],
    )


def _ports(shared: Options, fingers: int) -> list[tuple[str, Options]]:
    """Each finger of a line is a sensor."""
    return [(f"finger{port}", {**shared, "port": port}) for port in range(1, fingers + 1)]


def _sequence(electrodes: int, *, pac_first: bool) -> Options:
    """The order of sampling, where it is not the one that most have."""
    kind = {19: "biotac", 24: "biotac_sp"}[electrodes]
    return {"sequence": f"{kind}_pac_first"} if pac_first else {}


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
    from palpate_gateway.emulators.robotous import TORQUE_DIVISORS

    if model not in TORQUE_DIVISORS:
        raise ConfigError(
            f"--model {model}: there is no such sensor",
            remedy=f"one of {', '.join(TORQUE_DIVISORS)}",
        )


def _check_baud(baud: int, known: Sequence[int]) -> None:
    if baud not in known:
        told = ", ".join(str(one) for one in sorted(known))
        raise ConfigError(f"--baud {baud}: the device knows no such speed", remedy=f"one of {told}")
