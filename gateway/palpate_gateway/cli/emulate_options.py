"""Options that the commands of ``palpate emulate`` share, and the faults that their helps name."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate_gateway.cli.app import example

if TYPE_CHECKING:
    from palpate_gateway.cli.playing import Playing

MULTICAST = "239.74.163.2"
"""python-can's own group for its bus over UDP."""

HostOption = Annotated[str, typer.Option("--host", help="Address to listen at.")]
PortOption = Annotated[
    int, typer.Option("--port", min=0, max=65535, help="Port to listen at; 0 = any free one.")
]
LinkOption = Annotated[
    Path | None,
    typer.Option("--link", metavar="PATH", help="Name of the serial line; else a new one."),
]
FaultOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="NAME@START[+SECONDS]",
        help="A fault so many seconds after the start, once or for a time; repeatable.",
    ),
]
SecondsOption = Annotated[
    float, typer.Option(min=0, help="End after this time [s]; 0 = at Ctrl-C.")
]


class Play(enum.StrEnum):
    """What an emulated device measures."""

    TWIN = "twin"
    IDLE = "idle"
    PRESS = "press"


PlayOption = Annotated[
    Play, typer.Option(help="The digital twin, nothing, or a slow press without physics.")
]
SeedOption = Annotated[
    int, typer.Option(min=0, help="The twin's; finger N of a line has this one plus N - 1.")
]
TrajectoryOption = Annotated[
    list[str] | None,
    typer.Option("--trajectory", metavar="ID", help="A press of the twin; repeatable. Else all."),
]
EpochOption = Annotated[
    float,
    typer.Option(
        "--epoch", help="When the twin's loops begin [s since 1970]; the same for all of a scene."
    ),
]
UnitOption = Annotated[
    str, typer.Option(help="The twin's unit, a name or number; else another for each seed.")
]
FingerOption = Annotated[
    int, typer.Option(min=1, help="The finger of the line that it is under, with the same seed.")
]
DriftOption = Annotated[
    float,
    typer.Option(
        "--drift-ppm", min=-100_000, max=100_000, help="Of its clock, during clock_drift [1e-6]."
    ),
]


SlotRateOption = Annotated[
    float, typer.Option(min=1, max=10_000, help="Sampled channels each second.")
]
PacFirstOption = Annotated[
    bool, typer.Option("--pac-first", help="A sampling round begins with PAC, not with E1.")
]


class Electrodes(enum.StrEnum):
    """Which BioTac."""

    BIOTAC = "19"
    BIOTAC_SP = "24"


ElectrodesOption = Annotated[Electrodes, typer.Option(help="24 = BioTac SP, rounds of 54 slots.")]


class Product(enum.StrEnum):
    """Sensors that speak RDT, as the driver calls them."""

    NET_FT = "ati_net_ft"
    AXIA = "ati_axia"
    FTN = "schunk_ftn"
    HEX = "onrobot_hex"


FAULTS = {
    "kms40": "clock_drift cut error junk lost nan overload repeated restart silence stopped stuck "
    "unplug",
    "rdt": "clock_drift cut deaf error junk late latched lost overload repeated restart silence "
    "stuck unplug",
    "robotous": "clock_drift crc cut junk lost overload repeated restart silence stuck unplug; "
    "on CAN busoff, not crc",
    "bota": "clock_drift crc cut error junk late lost nan overload raw repeated restart silence "
    "stuck unplug",
    "biotac-can": "absent bus_error busoff clock_drift error_word foreign lost parity repeated "
    "restart saturated short silence stuck unplug",
    "biotac-bridge": "absent clock_drift crc cut error_word junk lost overrun parity repeated "
    "restart saturated silence stuck unplug",
    "biotac-pic32": "absent clock_drift cut end high_bits junk lost repeated restart saturated "
    "silence stuck unplug",
    "robot": "clock_drift late long lost nan repeated restart silence stuck unplug wrong_time",
}
"""Faults of each device, for people; the emulators say what each does."""


def epilog(name: str, *lines: str) -> str:
    """The end of a command's help."""
    return f"Faults: {FAULTS[name]}. {example(*lines)}"


def playing(
    play: Play, seed: int, trajectory: list[str] | None, epoch_s: float, unit: str = ""
) -> Playing:
    """What is wanted, from the options of a command."""
    from palpate_gateway.cli.playing import Playing

    return Playing(play.value, seed, tuple(trajectory or ()), epoch_s, unit)
