"""``palpate emulate``: the commands and the ends of their helps."""

from __future__ import annotations

from collections.abc import Callable

import typer

from palpate_gateway.cli import emulate_biotac, emulate_robot, emulate_wrench
from palpate_gateway.cli.emulate_options import MULTICAST, epilog

emulate_app = typer.Typer(
    help="A device in software, at an address of its own, until Ctrl-C; with faults on demand.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_COMMANDS: dict[str, tuple[Callable[..., None], str, str]] = {
    "kms40": (
        emulate_wrench.kms40,
        "palpate emulate kms40 --port 10000",
        "palpate emulate kms40 --fault silence@10+3",
    ),
    "rdt": (
        emulate_wrench.rdt,
        "palpate emulate rdt --product ati_axia --rate-hz 1000",
        "palpate emulate rdt --product onrobot_hex --fault lost@5 --fault overload@8+2",
    ),
    "robotous": (
        emulate_wrench.robotous,
        "palpate emulate robotous --link ./rft",
        f"palpate emulate robotous --interface udp_multicast --channel {MULTICAST}",
    ),
    "bota": (
        emulate_wrench.bota,
        "palpate emulate bota --link ./bota",
        "palpate emulate bota --fault restart@20",
    ),
    "biotac-can": (
        emulate_biotac.biotac_can,
        "palpate emulate biotac-can --fingers 2",
        "palpate emulate biotac-can --interface socketcan --channel vcan0 --fault absent@10+5",
    ),
    "biotac-bridge": (
        emulate_biotac.biotac_bridge,
        "palpate emulate biotac-bridge --link ./bridge",
        "palpate emulate biotac-bridge --fingers 1 --fault crc@10+1",
    ),
    "biotac-pic32": (
        emulate_biotac.biotac_pic32,
        "palpate emulate biotac-pic32 --link ./pic32",
        "palpate emulate biotac-pic32 --electrodes-first --fault cut@10",
    ),
    "robot": (
        emulate_robot.robot,
        "palpate emulate robot --rate-hz 1000",
        "palpate emulate robot --connect tcp/127.0.0.1:7447 --fault restart@20+2",
    ),
}

for _name, (_command, *_lines) in _COMMANDS.items():
    emulate_app.command(_name, epilog=epilog(_name, *_lines))(_command)
