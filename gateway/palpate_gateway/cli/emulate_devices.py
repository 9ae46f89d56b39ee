"""Emulators for ``palpate emulate``, with the driver's options that read them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from palpate.config import TlsConfig, check_name, endpoint_host_port
from palpate.errors import ConfigError
from palpate.process import require
from palpate_gateway.cli.key_values import parse_key_values
from palpate_gateway.emulators.emulator import Emulator, WrenchSource, no_load, slow_press
from palpate_gateway.ports.multicast import LOOPBACK, MULTICAST

if TYPE_CHECKING:
    from palpate_gateway.emulators.biotac_slots import CountSource
    from palpate_gateway.emulators.robot import TipSource
    from palpate_gateway.emulators.ros import RosEmulator
    from palpate_gateway.emulators.twin import TwinLoop

Options = dict[str, Any]
Sensors = Callable[[], list[tuple[str, Options]]]
Failures = tuple[type[Exception], ...]

_PATIENCE_S = 2.0
"""Time between two messages on the progress of the twin [s]."""


class EmulatedDevice(NamedTuple):
    """A device in software, not yet started.

    Attributes:
        emulator: The emulator.
        driver: The driver that reads it.
        sensors: Gives name and driver's options of each sensor; only valid once the emulator runs,
            because its ports are not known before.
        failures: Errors of its start if its address is in use or there is no such bus.
    """

    emulator: Emulator
    driver: str
    sensors: Sensors
    failures: Failures = (OSError,)


@dataclass(frozen=True, slots=True)
class EmulatedScene:
    """What the emulated devices measure.

    Its attributes are options of the commands. Its methods raise ``ConfigError`` if the twin has no
    such specimen or trajectory.
    """

    play: str
    seed: int
    trajectory: Sequence[str] | None
    epoch: float
    unit: str = ""
    finger: int = 1

    def counts(self, fingers: int) -> CountSource:
        """Counts of BioTacs."""
        from palpate_gateway.emulators.biotac_slots import idle_counts, press_counts

        if self.play != "twin":
            return idle_counts if self.play == "idle" else press_counts
        from palpate_gateway.emulators.twin import TwinCounts

        return TwinCounts([self._loop(finger, fingers) for finger in range(fingers)], self.epoch)

    def wrench(self) -> WrenchSource:
        """The wrench on the finger."""
        if self.play != "twin":
            return no_load if self.play == "idle" else slow_press
        from palpate_gateway.emulators.twin import TwinWrench

        return TwinWrench(self._loop(self.finger - 1).wrench, self.epoch)

    def tip(self) -> tuple[TipSource, str]:
        """The pose of the indenter on the finger, and the name of the first indenter."""
        from palpate_gateway.emulators.robot import above_the_pad, slow_approach

        if self.play != "twin":
            return above_the_pad if self.play == "idle" else slow_approach, "sphere_7mm"
        from palpate_gateway.emulators.twin import TwinTip

        loop = self._loop(self.finger - 1)
        return TwinTip(loop.tips, self.epoch), loop.indenters[0]

    def _loop(self, finger: int, fingers: int = 1) -> TwinLoop:
        from palpate_gateway.emulators.twin import loop_options, make_loop

        shown_s = time.monotonic()

        def progress(share: float) -> None:
            nonlocal shown_s
            if time.monotonic() > shown_s + _PATIENCE_S:
                shown_s = time.monotonic()
                of = f" of finger {finger + 1} of {fingers}" if fingers > 1 else ""
                typer.echo(f"the twin is computed: {100 * share:.0f} %{of}", err=True)

        unit = int(self.unit) if self.unit.isdecimal() else self.unit
        options = loop_options(
            finger, unit=unit or 0, trajectories=self.trajectory or (), seed=self.seed
        )
        return make_loop(options, progress)


def make_emulated(name: str, values: Mapping[str, Any]) -> EmulatedDevice:
    """The device of a command.

    Raises:
        ConfigError: An option is wrong.
        MissingExtraError: A package is not installed.
    """
    fields = EmulatedScene.__dataclass_fields__
    scene = EmulatedScene(**{key: value for key, value in values.items() if key in fields})
    own = {key: value for key, value in values.items() if key not in fields}
    return _MAKERS[name](scene, **own)


def _kms40(scene: EmulatedScene, **options: Any) -> EmulatedDevice:
    from palpate_gateway.emulators.kms40 import Kms40Emulator

    emulator = Kms40Emulator(scene.wrench(), **options)
    return EmulatedDevice(
        emulator,
        "wrench_kms40",
        lambda: [("wrench", {**_host_port(emulator), "rate_hz": emulator.rate_hz})],
    )


def _rdt(scene: EmulatedScene, *, product: str, **options: Any) -> EmulatedDevice:
    from palpate_gateway.emulators.rdt import RdtEmulator

    kinds = {"ati_net_ft": "netft", "ati_axia": "axia", "schunk_ftn": "axia", "onrobot_hex": "hex"}
    emulator = RdtEmulator(kinds[product], scene.wrench(), **options)

    def sensors() -> list[tuple[str, Options]]:
        sensor: Options = {"product": str(product), **_host_port(emulator)}
        if product != "onrobot_hex":
            sensor["http_port"] = emulator.page.port
        return [("wrench", {**sensor, "rate_hz": emulator.rate_hz})]

    return EmulatedDevice(emulator, "wrench_rdt", sensors)


def _robotous(
    scene: EmulatedScene,
    *,
    link: Path | None,
    baud: int,
    interface: str,
    channel: str,
    listen: str,
    **options: Any,
) -> EmulatedDevice:
    from palpate_gateway.emulators import robotous

    if options["model"] not in robotous.TORQUE_DIVISORS:
        raise ConfigError(
            f"--model {options['model']}: there is no such sensor",
            remedy=f"one of {', '.join(robotous.TORQUE_DIVISORS)}",
        )
    if interface:
        where: Options = {"interface": interface, "channel": channel}
        more = _bus_options({}, interface, listen)
        emulator = robotous.RobotousCanEmulator(scene.wrench(), **where, options=more, **options)
        where |= {"bus_options": more} if more else {}
        sensor = ("wrench", {**where, "rate_hz": 200})
        return EmulatedDevice(emulator, "wrench_robotous", lambda: [sensor], _can_failures())
    _check_baud(baud, sorted(robotous.MOST_HZ))
    line = robotous.RobotousSerialEmulator(scene.wrench(), baud, _checked_link(link), **options)
    return EmulatedDevice(
        line,
        "wrench_robotous",
        lambda: [("wrench", {"port": line.address, "baud": baud, "rate_hz": 200})],
    )


def _bota(scene: EmulatedScene, *, link: Path | None, baud: int, **options: Any) -> EmulatedDevice:
    from palpate_gateway.emulators.bota import BAUDS, BotaEmulator

    # The lowest speed is too slow even for the lowest rate.
    _check_baud(baud, [speed for speed in BAUDS if speed > 9600])
    emulator = BotaEmulator(scene.wrench(), baud=baud, path=_checked_link(link), **options)
    rate_hz = 400.0 if baud >= 230400 else 100.0
    return EmulatedDevice(
        emulator,
        "wrench_bota",
        lambda: [("wrench", {"port": emulator.address, "baud": baud, "rate_hz": rate_hz})],
    )


def _biotac_can(
    scene: EmulatedScene,
    *,
    bus: Sequence[str] | None,
    fingers: int,
    electrodes: str,
    listen: str,
    **options: Any,
) -> EmulatedDevice:
    from palpate_gateway.emulators.biotac_can import BiotacCanEmulator

    more = _bus_options(parse_key_values(bus or []), options["interface"], listen)
    emulator = BiotacCanEmulator(
        **options,
        counts=scene.counts(fingers),
        fingers=fingers,
        electrodes=int(electrodes),
        options=more,
    )
    shared: Options = {key: options[key] for key in ("interface", "channel")}
    if more:
        shared["bus_options"] = more
    shared |= {"can_id": options["can_id"], "fingers": fingers}
    shared |= {"slot_rate_hz": options["slot_rate_hz"]}
    shared |= _sequence(electrodes, pac_first=options["pac_first"])
    return EmulatedDevice(emulator, "biotac_can", lambda: _ports(shared, fingers), _can_failures())


def _biotac_bridge(
    scene: EmulatedScene,
    *,
    link: Path | None,
    fingers: int,
    source_id: int,
    electrodes: str,
    **options: Any,
) -> EmulatedDevice:
    from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator
    from palpate_gateway.emulators.lines import speeds

    _check_baud(options["baud"], speeds())
    emulator = BiotacBridgeEmulator(
        **options,
        counts=scene.counts(fingers),
        fingers=fingers,
        source=source_id,
        path=_checked_link(link),
        electrodes=int(electrodes),
    )

    def sensors() -> list[tuple[str, Options]]:
        shared = {"line": emulator.address, "baud": options["baud"], "source": source_id}
        return _ports(shared | _sequence(electrodes, pac_first=options["pac_first"]), fingers)

    return EmulatedDevice(emulator, "biotac_bridge", sensors)


def _biotac_pic32(scene: EmulatedScene, *, link: Path | None, **options: Any) -> EmulatedDevice:
    from palpate_gateway.emulators.biotac_pic32 import BiotacPic32Emulator
    from palpate_gateway.emulators.lines import speeds

    _check_baud(options["baud"], speeds())
    emulator = BiotacPic32Emulator(counts=scene.counts(1), path=_checked_link(link), **options)
    layout = "electrodes_first" if options["electrodes_first"] else "pac_first"

    def sensors() -> list[tuple[str, Options]]:
        line = {"port": emulator.address, "baud": options["baud"]}
        return [("finger", {**line, "layout": layout})]

    return EmulatedDevice(emulator, "biotac_pic32", sensors)


def _robot(scene: EmulatedScene, *, name: str, **options: Any) -> EmulatedDevice:
    from palpate_gateway.emulators.robot import BASE_SENSOR, FLANGE_INDENTER, RobotEmulator

    check_name(name, "robot")
    check_name(options["station"], "station")
    _check_endpoint(options["connect"])
    certificates = _certificates(options)
    tip, indenter = scene.tip()
    emulator = RobotEmulator(tip, robot=name, **options)

    def sensors() -> list[tuple[str, Options]]:
        sensor: Options = {
            "robot": emulator.robot,
            "connect": emulator.address,
            "station": emulator.station,
            "rate_hz": emulator.rate_hz,
            "indenter": indenter,
            **certificates,
        }
        for key, pose in (("base_sensor", BASE_SENSOR), ("flange_indenter", FLANGE_INDENTER)):
            sensor[key] = {"position_m": pose.position, "orientation_wxyz": pose.orientation}
        return [("robot", sensor)]

    return EmulatedDevice(emulator, "pose_zenoh", sensors)


def _ros_hand(
    scene: EmulatedScene, *, message: str, topic: str, fingers: int, **options: Any
) -> EmulatedDevice:
    from palpate.ros.rmw_zenoh import check_topic_name
    from palpate_gateway.emulators.ros import RosHandEmulator

    _check_endpoint(options["connect"])
    certificates = _certificates(options)
    emulator = RosHandEmulator(
        scene.counts(fingers),
        whole_frames=message == "BioTacHand",
        fingers=fingers,
        topic=check_topic_name(topic),
        **options,
    )
    package = "biotac_sensors" if emulator.whole_frames else "sr_robot_msgs"

    def sensors() -> list[tuple[str, Options]]:
        shared = {**_topic_of(emulator), "message": f"{package}/{message}", **certificates}
        return [(f"finger{k}", {**shared, "finger": k}) for k in range(1, fingers + 1)]

    return EmulatedDevice(emulator, "ros_biotac", sensors)


def _ros_wrench(scene: EmulatedScene, *, topic: str, **options: Any) -> EmulatedDevice:
    from palpate.ros.rmw_zenoh import check_topic_name
    from palpate_gateway.emulators.ros import RosWrenchEmulator

    _check_endpoint(options["connect"])
    certificates = _certificates(options)
    emulator = RosWrenchEmulator(scene.wrench(), topic=check_topic_name(topic), **options)

    def sensors() -> list[tuple[str, Options]]:
        return [("wrench", {**_topic_of(emulator), "rate_hz": emulator.rate_hz, **certificates})]

    return EmulatedDevice(emulator, "ros_wrench", sensors)


_MAKERS: dict[str, Callable[..., EmulatedDevice]] = {
    "kms40": _kms40,
    "rdt": _rdt,
    "robotous": _robotous,
    "bota": _bota,
    "biotac-can": _biotac_can,
    "biotac-bridge": _biotac_bridge,
    "biotac-pic32": _biotac_pic32,
    "robot": _robot,
    "ros-hand": _ros_hand,
    "ros-wrench": _ros_wrench,
}


def _ports(shared: Options, fingers: int) -> list[tuple[str, Options]]:
    """Each finger of a line is a sensor."""
    return [(f"finger{port}", {**shared, "port": port}) for port in range(1, fingers + 1)]


def _sequence(electrodes: str, *, pac_first: bool) -> Options:
    """The order of a round, if it is not the default one."""
    kind = {"19": "biotac", "24": "biotac_sp"}[electrodes]
    return {"sequence": f"{kind}_pac_first"} if pac_first else {}


def _topic_of(emulator: RosEmulator) -> Options:
    domain = {"domain": emulator.domain} if emulator.domain else {}
    return {"topic": emulator.topic, "connect": emulator.address, **domain}


def _certificates(options: Options) -> Options:
    """The option of a driver that joins the same router; the emulator's own has no certificates."""
    if not options["connect"] or options["tls"] is None:
        return {}
    return {"tls": TlsConfig.of_folder(options["tls"]).model_dump(mode="json")}


def _check_endpoint(connect: str) -> None:
    if not connect:
        return
    try:
        endpoint_host_port(connect)
    except ValueError as error:
        raise ConfigError(
            f"--connect: {error}", remedy="name the router as palpate status shows it"
        ) from error


def _host_port(emulator: Emulator) -> Options:
    host, _, port = emulator.address.rpartition(":")
    return {"host": host, "port": int(port)}


def _bus_options(more: Options, interface: str, listen: str) -> Options:
    """python-can's options, and where its bus over UDP is heard, if not on this host alone."""
    elsewhere = interface == MULTICAST and listen != LOOPBACK
    return {**more, "listen": listen} if elsewhere else more


def _can_failures() -> Failures:
    return (OSError, ValueError, TypeError, require("can", extra="gateway").CanError)


def _checked_link(link: Path | None) -> str:
    """Path for the name of the line; only the name of an earlier line is replaced."""
    from palpate_gateway.emulators.lines import reserve

    if link is None:
        return ""
    if not link.parent.is_dir():
        raise ConfigError(
            f"--link {link}: there is no folder {link.parent}", remedy="make it, or name another"
        )
    reserve(link).close()  # what is wrong with it is told before the twin is computed
    return str(link.absolute())


def _check_baud(baud: int, known: Sequence[int]) -> None:
    if baud not in known:
        listed = ", ".join(str(speed) for speed in sorted(known))
        raise ConfigError(f"--baud {baud}: not a speed of the device", remedy=f"one of {listed}")
