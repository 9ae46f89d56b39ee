"""``palpate new-station``: what is connected, whether it answers, and a profile for it.

The devices come from the command line, or from questions with what this host has as their choices.
Each is read before the profile is written: a profile whose sensor is silent helps nobody. A device
is named by the words of ``palpate gateway probe``: ``biotac_can channel=can0 port=1``.
"""

from __future__ import annotations

import os
import shlex
import sys
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer

from palpate.config import DEFAULT_ROUTER, check_name
from palpate.errors import ConfigError, DeviceError, printable
from palpate.messages import COUNTS_MAX
from palpate.process import check_installed
from palpate_deploy.station.profile import changed, load_profile, parse_profile, read_toml
from palpate_gateway.cli.inventory import can_buses, serial_ports
from palpate_gateway.cli.key_values import (
    command_words,
    parse_key_values,
    sensor_toml,
    text_keys,
    toml_value,
)
from palpate_gateway.cli.streams import DeviceStreams, measure, text_of
from palpate_gateway.device import BusDevice, Device
from palpate_gateway.drivers import load_driver, make_device
from palpate_gateway.readings import ElectrodeReading, WrenchReading

FINGER = "finger"
"""Name of the BioTac in the profile."""

WRENCH_SENSOR = "wrench"
"""Name of the force/torque sensor."""

INDENTER = "indenter"
"""Name of the sensor that gives the indenter's pose."""

ROLES = {FINGER: "BioTac", WRENCH_SENSOR: "force/torque sensor", INDENTER: "robot pose"}
"""What each name stands for."""

_STREAMS = {FINGER: "electrodes", WRENCH_SENSOR: "wrench", INDENTER: "pose"}
_OPTIONS = {FINGER: "--biotac", WRENCH_SENSOR: "--wrench", INDENTER: "--pose"}
_PROBE_S = 2.0

_Place = tuple[str, dict[str, Any]]
# Where a device may be: a line for people, and the driver's options for it.

_RATE_WRONG = 0.2
"""A rate that differs by more from the nominal one is another setting of the device."""

_MOUNT = {
    "mount": {"carries": "biotac", "orientation_wxyz": (1.0, 0.0, 0.0, 0.0), "origin_m": (0, 0, 0)}
}
"""Written out, because a lab has to replace it."""


@dataclass(frozen=True, slots=True)
class StationWanted:
    """What the command line says of a new station.

    Attributes:
        name: Name of the station.
        path: Where its profile is written.
        devices: Words for a device, by the sensor's name; what is not named is asked for.
        serial: Serial number of the BioTac, where it sends none; empty = unknown.
        listen: Where its router listens; None = the default, or what the profile there says.
        yes: Ask nothing, take what is found if there is no choice.
        anyway: Write the profile although a device does not answer.
    """

    name: str
    path: Path
    devices: Mapping[str, str]
    serial: str = ""
    listen: str | None = None
    yes: bool = False
    anyway: bool = False


@dataclass(frozen=True, slots=True)
class WantedDevice:
    """A device that the profile shall name: sensor, driver, the driver's options."""

    sensor: str
    driver: str
    options: dict[str, Any]


@dataclass(slots=True)
class ProbedDevice:
    """What a device has shown.

    Attributes:
        device: The device.
        about: Its model, rate and serial number, in one line.
        reading: Its first reading, in lines.
        troubles: What is wrong, and what to check.
    """

    device: WantedDevice
    about: str
    reading: list[str] = field(default_factory=list)
    troubles: list[tuple[str, str]] = field(default_factory=list)


def make_station(wanted: StationWanted) -> None:
    """Find, probe and write; a profile that is there already, with these devices, stays as it is.

    Raises:
        ConfigError: A device is named wrongly or not at all, several could be meant, or the file
            is there and says something else.
        DeviceError: A device does not answer as it should; nothing is written.
        MissingExtraError: A device needs a package that is not installed.
    """
    check_name(wanted.name, "name")
    if wanted.path.suffix != ".toml":
        raise ConfigError(
            f"{wanted.path} is no name for a profile", remedy=f"write --out {wanted.path}.toml"
        )
    given = {sensor: _parsed(sensor, words) for sensor, words in wanted.devices.items()}
    if wanted.serial and FINGER in given:
        given[FINGER].options["serial"] = wanted.serial
    if wanted.listen is not None:
        # Here, since a PALPATE_ROUTER__LISTEN of today would hide it when the profile is parsed.
        changed(parse_profile({}, where="--listen"), router={"listen": [wanted.listen]})
    if wanted.path.exists():
        _check_same(wanted, given.values())
        print(f"{wanted.path} is there: it stays as it is")
        return
    if not wanted.path.parent.is_dir():
        raise ConfigError(
            f"there is no folder {wanted.path.parent}", remedy="make it, or name another: --out"
        )
    asks = sys.stdin.isatty() and not wanted.yes
    devices = _asked(given) if asks else _unasked(given, yes=wanted.yes)
    finger = devices[0].options
    if wanted.serial:
        finger["serial"] = wanted.serial
    if asks and devices[0].driver.startswith("biotac") and "serial" not in finger:
        finger["serial"] = typer.prompt("Serial number on the BioTac, if it sends none", default="")
    probed = []
    for device in devices:
        print(f"{ROLES[device.sensor]}: {device.driver} is read for {_PROBE_S:g} s")
        probed.append(probe(device))
        _show(probed[-1])
    _check_all_answer(probed, anyway=wanted.anyway)
    write_new(wanted.path, profile_text(wanted, probed))
    print(f"written: {wanted.path}")


def _parsed(sensor: str, words: str) -> WantedDevice:
    """A device from the words of ``palpate gateway probe``."""
    try:
        driver, *pairs = shlex.split(words)
    except ValueError as error:
        raise ConfigError(
            f"{_OPTIONS[sensor]} {words!r} names no device",
            remedy='give the words of palpate gateway probe, e.g. "biotac_can channel=can0 port=1"',
        ) from error
    options = parse_key_values(pairs, text_keys(load_driver(driver).options_class))
    make_device(driver, options, where=_OPTIONS[sensor])
    return WantedDevice(sensor, driver, options)


def _check_same(wanted: StationWanted, given: Iterable[WantedDevice]) -> None:
    """Raise a ``ConfigError`` if the profile that is there is not the one that is wanted."""
    there = load_profile(wanted.path)
    known = {sensor.name: sensor for sensor in there.gateway.sensors}
    other = [] if there.station == wanted.name else [f"station {there.station!r}"]
    if wanted.serial and FINGER not in wanted.devices:
        driver = known[FINGER].driver if FINGER in known else ""
        given = [*given, WantedDevice(FINGER, driver, {"serial": wanted.serial})]
    for device in given:
        sensor = known.get(device.sensor)
        if sensor is None:
            other.append(f"no sensor {device.sensor!r}")
        elif sensor.driver != device.driver:
            other.append(f"{device.sensor!r} with driver {sensor.driver!r}")
        else:
            other += [
                f"{device.sensor!r} with {key} = {sensor.options.get(key)!r}"
                for key, value in device.options.items()
                if sensor.options.get(key) != value
            ]
    # As the file says it: PALPATE_ROUTER__LISTEN is of today.
    listen = read_toml(wanted.path).get("router", {}).get("listen", [DEFAULT_ROUTER])
    if wanted.listen is not None and listen != [wanted.listen]:
        other.append(f"a router that listens at {', '.join(listen)}")
    if other:
        raise ConfigError(
            f"{wanted.path} is there and says otherwise: {', '.join(other)}",
            remedy="go on with it by --name and --start alone, or write another file: --out",
        )


def _unasked(given: Mapping[str, WantedDevice], *, yes: bool) -> list[WantedDevice]:
    """The devices without a question: what was named, else the only BioTac that can be meant."""
    if FINGER in given:
        return [given[sensor] for sensor in ROLES if sensor in given]
    if not yes:
        raise ConfigError(
            "no device is named, and nobody can be asked: standard input is no terminal",
            remedy="name the BioTac, e.g. --biotac 'biotac_can channel=can0', or take what is "
            "found: --yes",
        )
    buses, ports = _found()
    if len(buses) == 1:
        finger = WantedDevice(FINGER, "biotac_can", buses[0][1])
        return [finger, *(given[sensor] for sensor in ROLES if sensor in given)]
    if buses:
        raise ConfigError(
            f"{len(buses)} CAN interfaces are there: {', '.join(name for name, _ in buses)}",
            remedy=f"say which: --biotac 'biotac_can {command_words(buses[0][1])}'",
        )
    listed = ", ".join(name for name, _ in ports)
    raise ConfigError(
        "no CAN interface is there" + (f"; serial ports: {listed}" if ports else ", nor any port"),
        remedy=f"say what is at which: --biotac 'biotac_bridge line={ports[0][1]['port']}'"
        if ports
        else "plug the adapter in; ip link set can0 type can bitrate 1000000 restart-ms 100; "
        "ip link set can0 up; see it in: palpate gateway list",
    )


def _found() -> tuple[list[_Place], list[_Place]]:
    """CAN interfaces and serial ports of this host."""
    for module in ("can", "serial"):
        check_installed(module, extra="gateway")
    buses, ports = can_buses(), serial_ports()
    found_buses = []
    for bus in [] if isinstance(buses, str) else buses:
        options: dict[str, Any] = {"channel": bus["channel"]}
        if bus["interface"] != "socketcan":
            # The system sets up no other one.
            options |= {"interface": bus["interface"], "bitrate": 1_000_000}
        found_buses.append((f"{bus['interface']} {bus['channel']}", options))
    found_ports = []
    for port in [] if isinstance(ports, str) else ports:
        at = port["by_id"] or port["port"]
        found_ports.append((f"{at} {port['what']}".strip(), {"port": at}))
    return found_buses, found_ports


def _asked(given: Mapping[str, WantedDevice]) -> list[WantedDevice]:
    """The devices, each asked for that was not named."""
    buses, ports = _found() if FINGER not in given or WRENCH_SENSOR not in given else ([], [])
    devices = []
    for sensor, offer, needed in (
        (FINGER, _biotacs(buses, ports), True),
        (WRENCH_SENSOR, _wrenches(ports), False),
        (INDENTER, [], False),
    ):
        device = given.get(sensor) or _choose(sensor, offer, needed=needed)
        if device is not None:
            devices.append(device)
    return devices


@dataclass(frozen=True, slots=True)
class _Offer:
    """A device that may be there.

    Attributes:
        text: What the question says.
        driver: Its driver.
        options: The driver's options.
        asks: Options that only the lab knows: key, question, default.
    """

    text: str
    driver: str
    options: Mapping[str, Any]
    asks: tuple[tuple[str, str, Any], ...] = ()


def _biotacs(buses: Sequence[_Place], ports: Sequence[_Place]) -> list[_Offer]:
    place = ("port", "Which finger of the line, from 1", 1)
    offers = [_Offer(f"on CAN: {name}", "biotac_can", bus, (place,)) for name, bus in buses]
    for name, at in ports:
        line = {"line": at["port"]}
        offers.append(_Offer(f"behind our bridge: {name}", "biotac_bridge", line, (place,)))
        offers.append(_Offer(f"at a PIC32 board: {name}", "biotac_pic32", at))
    return [*offers, _Offer("none: a virtual finger", "virtual", {})]


def _wrenches(ports: Sequence[_Place]) -> list[_Offer]:
    rate = ("rate_hz", "Records each second, as set on its web page", 1000.0)
    offers = [
        _Offer(name, "wrench_rdt", {"product": product}, (_address("192.168.1.1"), *more))
        for name, product, more in (
            ("ATI Net F/T", "ati_net_ft", (rate,)),
            ("ATI Ethernet Axia", "ati_axia", (rate,)),
            ("Schunk FTN-AXIA", "schunk_ftn", (rate,)),
            ("OnRobot HEX", "onrobot_hex", ()),
        )
    ]
    offers.append(_Offer("Weiss KMS 40", "wrench_kms40", {}, (_address("192.168.1.30"),)))
    for name, at in ports:
        offers.append(_Offer(f"Robotous RFT: {name}", "wrench_robotous", at))
        offers.append(_Offer(f"Bota SensONE or Rokubi: {name}", "wrench_bota", at))
    return offers


def _address(default: str) -> tuple[str, str, str]:
    return "host", "Its address", default


def _choose(sensor: str, offers: Sequence[_Offer], *, needed: bool) -> WantedDevice | None:
    """Ask which device; None = there is none."""
    print(f"\nWhich {ROLES[sensor]}?")
    texts = [] if needed else ["none"]
    texts += [offer.text for offer in offers]
    texts.append("another: the words of palpate gateway probe")
    for number, text in enumerate(texts, 1):
        print(f"  {number}  {printable(text)}")
    # Of several that may be there none is the likely one; the last offer is the virtual finger.
    default = 1 if not needed or len(offers) == 2 else None
    number = typer.prompt("Number", type=int, default=default)
    while not 1 <= number <= len(texts):
        number = typer.prompt(f"A number from 1 to {len(texts)}", type=int, default=default)
    if number == len(texts):
        return _parsed(sensor, typer.prompt("DRIVER KEY=VALUE ..."))
    if texts[number - 1] == "none":
        return None
    offer = offers[number - 1 - (not needed)]
    answers = {key: typer.prompt(text, default=value) for key, text, value in offer.asks}
    options = {**offer.options, **answers}
    make_device(offer.driver, options, where="the answers")
    return WantedDevice(sensor, offer.driver, options)


def probe(wanted: WantedDevice) -> ProbedDevice:
    """Read a device for a moment.

    Raises:
        ConfigError: An option is wrong.
        MissingExtraError: The driver needs a package that is not installed.
    """
    device = make_device(wanted.driver, wanted.options, where=_OPTIONS[wanted.sensor])
    found = ProbedDevice(wanted, device.info.model)
    if isinstance(device, BusDevice) and not wanted.options.get("connect"):
        found.about += ": comes over this station's router, so it is seen once that runs"
        return found
    try:
        with device:
            streams = measure(device, _PROBE_S)
            found.about += f", serial number {device.identity.serial}"
    except DeviceError as error:
        found.troubles.append((error.problem, error.remedy))
        return found
    _judge(found, device, streams)
    return found


def _judge(found: ProbedDevice, device: Device, streams: DeviceStreams) -> None:
    """Add rate and reading of the device, and what is not plausible about them."""
    name = _STREAMS[found.device.sensor]
    stream = streams.by_name.get(name)
    if stream is None:
        came = ", ".join(streams.by_name)
        found.troubles.append(
            (
                f"{found.device.driver} gives no {name}, but {came}",
                f"name it by the option for it, not by {_OPTIONS[found.device.sensor]}",
            )
        )
        return
    nominal_hz = device.info.rate_hz
    rate_hz = stream.rate_hz or 0.0
    found.about += f", {rate_hz:.1f} readings/s"
    found.reading = text_of(stream.last)
    if abs(rate_hz / nominal_hz - 1.0) > _RATE_WRONG:
        expected = f"{rate_hz:.1f} readings come each second, {nominal_hz:g} were expected"
        remedy = "look at the counters: palpate gateway probe"
        if name != "electrodes":
            remedy = "give the rate that the device is set to as the option rate_hz"
        found.troubles.append((expected, remedy))
    if isinstance(stream.last, ElectrodeReading):
        found.troubles += _implausible_counts(stream.last)
    elif isinstance(stream.last, WrenchReading) and stream.last.overload:
        found.troubles.append(("its range is exceeded", "take the load off, and check its cable"))


def _implausible_counts(reading: ElectrodeReading) -> list[tuple[str, str]]:
    counts = reading.electrodes.tolist()
    invalid = [f"E{k + 1}" for k in range(len(counts)) if not reading.validity >> k & 1]
    ends = [f"E{k + 1}" for k, count in enumerate(counts) if count in (0, COUNTS_MAX)]
    troubles = []
    if invalid:
        troubles.append(
            (f"not valid: {', '.join(invalid)}", "check the cable between BioTac and its sender")
        )
    if ends:
        troubles.append(
            (
                f"at an end of the converter's range: {', '.join(ends)}",
                "let go of the finger; if it stays, its fluid or an electrode is gone",
            )
        )
    return troubles


def _show(found: ProbedDevice) -> None:
    print(f"  {printable(found.about)}")
    for line in found.reading:
        print(f"  {printable(line)}")
    for problem, remedy in found.troubles:
        print(f"  wrong: {printable(problem)}\n  check: {printable(remedy)}")


def _check_all_answer(probed: Sequence[ProbedDevice], *, anyway: bool) -> None:
    wrong = [one for one in probed if one.troubles]
    if not wrong:
        return
    names = " and ".join(ROLES[one.device.sensor] for one in wrong)
    if anyway:
        print(f"{names}: written all the same")
        return
    problem, remedy = wrong[0].troubles[0]
    raise DeviceError(
        f"{names}: no answer as it should be, so nothing is written; {problem}",
        remedy=f"{remedy}; or write the profile all the same: --anyway",
    )


def profile_text(wanted: StationWanted, probed: Sequence[ProbedDevice]) -> str:
    """The profile as TOML, with comments.

    Raises:
        ConfigError: It would be refused when it is read.
    """
    day = time.strftime("%Y-%m-%d")
    parts = [
        f"# Station {wanted.name!r}, made by `palpate new-station` on {day}. Keys that are not here"
        f"\n# have their defaults: palpate up --profile {wanted.path.name} --print-config\n"
        f'station = "{wanted.name}"\n'
        'processes = ["router", "gateway", "features", "recorder"]\n',
        "[router]\n"
        "# Robots and commands join here. For other hosts: docs/security.md.\n"
        f"listen = {toml_value([wanted.listen or DEFAULT_ROUTER])}\n",
    ]
    for one in probed:
        device = one.device
        options = dict(device.options)
        comments = [f"# {ROLES[device.sensor]}: {printable(one.about)}"]
        comments += [f"# Not as it should be: {printable(problem)}" for problem, _ in one.troubles]
        if device.sensor == FINGER and device.driver.startswith("biotac"):
            comments += [
                "# `serial` tells this finger from others: a bundle is made for one of them.",
            ]
        elif device.sensor == WRENCH_SENSOR:
            if "mount" in load_driver(device.driver).options_class.model_fields:
                options = {**_MOUNT, **options}
            comments += [
                "# `of`: its readings belong to that finger. `mount`: what is fixed to its",
                '# measuring side ("biotac" or "indenter"), and its axes and origin [m] in the',
                "# sensor frame (docs/conventions.md); REPLACE these, estimates follow them.",
            ]
        elif device.sensor == INDENTER:
            comments += [
                "# `of`: the pose is that of the indenter at this finger; where both sit at the",
                "# robot is said by the options (docs/devices/robot-pose.md).",
            ]
        of = "" if device.sensor == FINGER else FINGER
        table = sensor_toml(device.sensor, device.driver, options, of=of)
        parts.append("\n".join([*comments, table]))
    parts += [
        "[features]\n"
        "# Made for simulated fingers: flagged UNCALIBRATED on yours until `palpate calibrate`\n"
        "# has made and loaded a bundle of its own, which a station remembers.\n"
        'bundle = "features-twin"\n',
        '[recorder]\n# The oldest records are removed after 20 GiB or 14 days.\nout = "runs"\n',
    ]
    text = "\n".join(parts)
    parse_profile(tomllib.loads(text), where=str(wanted.path))
    return text


def write_new(path: Path, text: str) -> None:
    """Write a file that appears complete or not at all, and replaces none.

    Raises:
        ConfigError: It is there already, or cannot be written.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_text(text, encoding="utf-8")
        os.link(aside, path)
    except FileExistsError as error:
        raise ConfigError(f"{path} is there already", remedy="name another: --out") from error
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be written: {error.strerror or error}",
            remedy="check the folder's rights and free space, or name another: --out",
        ) from error
    finally:
        aside.unlink(missing_ok=True)


def next_commands(wanted: StationWanted) -> str:
    """What to type next, line by line."""
    profile = load_profile(wanted.path)
    join = "" if profile.station == "lab" else f" --station {profile.station}"
    router = profile.link.connect[0]
    join += "" if router == DEFAULT_ROUTER else f" --connect {router}"
    path = shlex.quote(str(wanted.path))
    zero = [f"palpate tare {WRENCH_SENSOR}{join}"] * any(
        s.name == WRENCH_SENSOR for s in profile.gateway.sensors
    )
    lines = [
        f"palpate up --profile {path}",
        *zero,
        f"palpate tare {FINGER}{join}",
        f"palpate top{join}",
        f"palpate calibrate {FINGER} --profile {path}",
    ]
    return "\n".join(
        [
            "next, the first in a terminal of its own; or all of it: palpate new-station --start",
            *(f"  {line}" for line in lines),
        ]
    )
