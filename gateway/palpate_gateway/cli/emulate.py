"""``palpate emulate``: the table that makes the commands, one for each device.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any

import typer

from palpate_gateway.cli.app import example
from palpate_gateway.emulators import FAULTS

emulate_app = typer.Typer(
    help="A device in software, at an address of its own, until Ctrl-C; with faults on demand.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

MULTICAST = "239.74.163.2"
"""python-can's own group for its bus over UDP."""


RDT_PRODUCTS = ("ati_net_ft", "ati_axia", "schunk_ftn", "onrobot_hex")
"""Sensors that speak RDT, by their names in the driver's options."""


@dataclass(frozen=True, slots=True)
class EmulateCommand:
    """One command: help, options in their order, two lines of examples, a remark on its faults."""

    help: str
    options: tuple[Parameter, ...]
    examples: tuple[str, str]
    faults: str = ""


def _option(
    name: str, default: Any, help_: str, *flags: str, type_: Any = None, **limits: Any
) -> Parameter:
    """A parameter of a command; its type is that of the default, if it is not given."""
    option = typer.Option(default, *flags, help=help_, **limits)
    annotation = type_ or type(default)
    return Parameter(name, Parameter.KEYWORD_ONLY, default=option, annotation=annotation)


def _choice(name: str, help_: str, *values: str) -> Parameter:
    """An option that is one of some values; the first is the default."""
    return _option(name, next(iter(enum.StrEnum(name, [(one, one) for one in values]))), help_)


def _many(name: str, metavar: str, help_: str) -> Parameter:
    """An option that can be repeated."""
    return _option(name, None, help_, f"--{name}", type_=list[str] | None, metavar=metavar)


def _baud(default: int, help_: str = "Its speed [bit/s].", **limits: int) -> Parameter:
    return _option("baud", default, help_, **limits)


def _fingers(most: int, help_: str) -> Parameter:
    return _option("fingers", 3, help_, min=1, max=most)


_HOST = _option("host", "127.0.0.1", "Address to listen at.", "--listen", "--host")
_PORT = _option("port", 0, "Port to listen at; 0 = any free one.", min=0, max=65535)
_LINE = "Name of the serial line; else a new one."
_LINK = _option("link", None, _LINE, type_=Path | None, metavar="PATH")
_CHANNEL = _option("channel", MULTICAST, "Name of the bus.")
_LISTEN = _option(
    "listen",
    "127.0.0.1",
    "Of udp_multicast: this host's address in the network that hears it; else only this host does.",
)
_SLOT_RATE = _option(
    "slot_rate_hz", 4400, "Sampled channels each second.", type_=float, min=1, max=10_000
)
_ROUND = (
    _option("pac_first", False, "A round begins with PAC, not with E1.", "--pac-first"),
    _choice("electrodes", "24 = BioTac SP, rounds of 54 slots.", "19", "24"),
)
_PLAY = (
    _choice(
        "play",
        "The digital twin, nothing, or a slow press without physics.",
        *("twin", "idle", "press"),
    ),
    _option("seed", 0, "Seed of the twin; finger N of a line has this one plus N - 1.", min=0),
)
_FINGER = _option(
    "finger", 1, "The finger of the line that it belongs to, with the same seed.", min=1
)
_UNIT = _option("unit", "", "The twin's specimen, a name or number; else another for each seed.")
_END = (
    _many("trajectory", "ID", "A trajectory of the twin; repeatable. Else all."),
    _option(
        "epoch", 0.0, "When the twin's loops begin [s since 1970]; the same for all of a scene."
    ),
    _option(
        "drift_ppm",
        200.0,
        "Excess speed of its clock, during clock_drift [1e-6].",
        min=-100_000,
        max=100_000,
    ),
    _many(
        "fault",
        "NAME@START[+SECONDS]",
        "A fault that starts after so many seconds, once or for a time; repeatable.",
    ),
    _option("seconds", 0, "End after this time [s]; 0 = at Ctrl-C.", type_=float, min=0),
)
_CONNECT = _option(
    "connect", "", "Endpoint of a router, e.g. tcp/127.0.0.1:7447; else it runs its own."
)
_TLS = _option(
    "tls",
    None,
    "Folder of certificates for a router tls/HOST:PORT: ca.pem, cert.pem, key.pem.",
    type_=Path | None,
    metavar="FOLDER",
    envvar="PALPATE_TLS",
)
_DOMAIN = _option("domain", 0, "ROS domain id.", min=0, max=232)
_ON_WRENCH = (*_PLAY, _FINGER, *_END)
_ON_FINGERS = (*_PLAY, _UNIT, *_END)

COMMANDS = {
    "kms40": EmulateCommand(
        "A Weiss KMS 40 over TCP; its client sets the rate.",
        (_HOST, _PORT, _option("serial", 310042, "Its serial number.", min=0), *_ON_WRENCH),
        ("kms40 --port 10000", "kms40 --fault silence@10+3"),
    ),
    "rdt": EmulateCommand(
        "An ATI Net F/T or Axia, a Schunk FTN or an OnRobot HEX over UDP.",
        (
            _choice("product", "Which of them.", *RDT_PRODUCTS),
            _HOST,
            _PORT,
            _option("http_port", 0, "Port of its web page; 0 = any free one.", min=0, max=65535),
            _option(
                "rate_hz",
                0,
                "Records each second; 0 = 1000, of a HEX 100.",
                type_=float,
                min=0,
                max=8000,
            ),
            *_ON_WRENCH,
        ),
        (
            "rdt --product ati_axia --rate-hz 1000",
            "rdt --product onrobot_hex --fault lost@5 --fault overload@8+2",
        ),
    ),
    "robotous": EmulateCommand(
        "A Robotous RFT on a serial line or on CAN; its client sets the rate.",
        (
            _LINK,
            _baud(115200, "Speed of the serial line [bit/s]."),
            _option("interface", "", "python-can's kind of bus; on a serial line without it."),
            _CHANNEL,
            _LISTEN,
            _option("model", "RFT64-SB01", "The model that it reports."),
            _option("serial", "RFT-1", "Its serial number."),
            *_ON_WRENCH,
        ),
        ("robotous --link ./rft", f"robotous --interface udp_multicast --channel {MULTICAST}"),
        faults="; on CAN busoff, not crc",
    ),
    "bota": EmulateCommand(
        "A Bota SensONE or Rokubi on a serial line; its client sets the rate.",
        (_LINK, _baud(460800), *_ON_WRENCH),
        ("bota --link ./bota", "bota --fault restart@20"),
    ),
    "biotac-can": EmulateCommand(
        "BioTacs at SynTouch's CAN interface: one CAN frame for each sampled channel.",
        (
            _option(
                "interface",
                "udp_multicast",
                "python-can's kind of bus; udp_multicast needs no hardware.",
            ),
            _CHANNEL,
            _LISTEN,
            _many("bus", "KEY=VALUE", "More options of python-can; repeatable."),
            _fingers(3, "BioTacs on the bus."),
            _option("can_id", 1, "Identifier of frames.", min=0, max=0x7FF),
            _SLOT_RATE,
            *_ROUND,
            *_ON_FINGERS,
        ),
        (
            "biotac-can --fingers 2",
            "biotac-can --interface socketcan --channel vcan0 --fault absent@10+5",
        ),
    ),
    "biotac-bridge": EmulateCommand(
        "BioTacs behind our own microcontroller bridge, on a serial line.",
        (
            _LINK,
            _baud(460800, min=1),
            _fingers(5, "BioTacs that it samples."),
            _option("source_id", 1, "The bridge's id.", min=0, max=255),
            _SLOT_RATE,
            _option("slots_per_packet", 44, "Slots of a packet, 5 to 10 ms.", min=22, max=44),
            *_ROUND,
            *_ON_FINGERS,
        ),
        ("biotac-bridge --link ./bridge", "biotac-bridge --fingers 1 --fault crc@10+1"),
    ),
    "biotac-pic32": EmulateCommand(
        "A BioTac polled by a PIC32 board, on a serial line; silent until its client starts it.",
        (
            _LINK,
            _baud(230400, min=1),
            _option("electrodes_first", False, "It has the older firmware.", "--electrodes-first"),
            *_ON_FINGERS,
        ),
        ("biotac-pic32 --link ./pic32", "biotac-pic32 --electrodes-first --fault cut@10"),
    ),
    "robot": EmulateCommand(
        "A robot that carries an indenter and publishes the pose of its flange over Zenoh.",
        (
            _option("name", "arm", "Its name on the bus.", "--robot"),
            _CONNECT,
            _TLS,
            _PORT,
            _option("station", "lab", "Station on which it publishes."),
            _option("rate_hz", 250, "Poses each second.", type_=float, min=1, max=2000),
            *_ON_WRENCH,
        ),
        ("robot --rate-hz 1000", "robot --connect tcp/127.0.0.1:7447 --fault restart@20+2"),
    ),
    "ros-hand": EmulateCommand(
        "A hand of BioTacs whose driver of ROS 2 publishes over rmw_zenoh.",
        (
            _choice("message", "What it publishes.", "BiotacAll", "BioTacHand"),
            _option("topic", "/hand/tactile", "Its topic."),
            _CONNECT,
            _TLS,
            _PORT,
            _DOMAIN,
            _fingers(5, "BioTacs that are connected."),
            _option("rate_hz", 100, "Messages each second.", type_=float, min=1, max=2000),
            *_ON_FINGERS,
        ),
        ("ros-hand --message BioTacHand", "ros-hand --connect tcp/127.0.0.1:7447 --fault lost@9+1"),
    ),
    "ros-wrench": EmulateCommand(
        "A force/torque sensor whose driver of ROS 2 publishes over rmw_zenoh.",
        (
            _option("topic", "/ft/wrench", "Its topic."),
            _CONNECT,
            _TLS,
            _PORT,
            _DOMAIN,
            _option("rate_hz", 500, "Messages each second.", type_=float, min=1, max=2000),
            *_ON_WRENCH,
        ),
        ("ros-wrench --rate-hz 1000", "ros-wrench --connect tcp/127.0.0.1:7447 --fault nan@9+1"),
    ),
}
"""The commands by name; ``emulate_devices`` has a maker for each device."""


def _add(name: str, command: EmulateCommand) -> None:
    def run(**values: Any) -> None:
        from palpate_gateway.cli.emulate_devices import make_emulated
        from palpate_gateway.cli.emulate_run import parse_faults, run_emulator

        faults, seconds = values.pop("fault") or [], values.pop("seconds")
        # Before the twin is computed, which takes long.
        on_can = name == "robotous" and values["interface"]
        plan = parse_faults(faults, FAULTS["robotous on CAN" if on_can else name])
        run_emulator(name, make_emulated(name, values), plan, seconds)

    # Typer reads a command's options from the signature of its function.
    vars(run).update(__signature__=Signature(command.options), __doc__=None)
    faults = " ".join(sorted(FAULTS[name])) + command.faults
    lines = [f"palpate emulate {line}" for line in command.examples]
    epilog = f"Faults: {faults}. {example(*lines)}"
    emulate_app.command(name, help=command.help, epilog=epilog)(run)


for _name, _command in COMMANDS.items():
    _add(_name, _command)
