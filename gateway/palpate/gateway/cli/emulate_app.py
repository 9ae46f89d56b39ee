"""``palpate emulate``: signatures and help only; each command's work is in its own module.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from palpate.gateway.cli.app import example

emulate_app = typer.Typer(
    help="A device in software, at an address of its own, until Ctrl-C; with faults on demand.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

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


class Product(enum.StrEnum):
    """Sensors that speak RDT, as the driver calls them."""

    NET_FT = "ati_net_ft"
    AXIA = "ati_axia"
    FTN = "schunk_ftn"
    HEX = "onrobot_hex"


@emulate_app.command(
    epilog=example(
        "palpate emulate kms40 --port 10000", "palpate emulate kms40 --fault silence@10+3"
    )
)
def kms40(
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    serial: Annotated[int, typer.Option(min=0, help="Its serial number.")] = 310042,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Weiss KMS 40 over TCP; its client sets the rate."""
    from palpate.gateway.cli import emulated
    from palpate.gateway.cli.emulate import emulate_command

    emulate_command(emulated.kms40(host, port, serial), fault or [], seconds)


@emulate_app.command(
    epilog=example(
        "palpate emulate rdt --product ati_axia --rate-hz 1000",
        "palpate emulate rdt --product onrobot_hex --fault lost@5 --fault overload@8+2",
    )
)
def rdt(
    product: Annotated[Product, typer.Option(help="Which of them.")] = Product.NET_FT,
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    http_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of its web page; 0 = any free one.")
    ] = 0,
    rate_hz: Annotated[
        float, typer.Option(min=0, max=8000, help="Records each second; 0 = 1000, of a HEX 100.")
    ] = 0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """An ATI Net F/T or Axia, a Schunk FTN or an OnRobot HEX over UDP."""
    from palpate.gateway.cli import emulated
    from palpate.gateway.cli.emulate import emulate_command

    device = emulated.rdt(product.value, host, port, http_port, rate_hz)
    emulate_command(device, fault or [], seconds)


@emulate_app.command(
    epilog=example(
        "palpate emulate robotous --link ./rft",
        f"palpate emulate robotous --interface udp_multicast --channel {MULTICAST}",
    )
)
def robotous(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(help="Speed of the serial line [bit/s].")] = 115200,
    interface: Annotated[
        str, typer.Option(help="python-can's kind of bus; on a serial line without it.")
    ] = "",
    channel: Annotated[str, typer.Option(help="Which bus.")] = MULTICAST,
    model: Annotated[str, typer.Option(help="What it says that it is.")] = "RFT64-SB01",
    serial: Annotated[str, typer.Option(help="Its serial number.")] = "RFT-1",
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Robotous RFT on a serial line or on CAN; its client sets the rate."""
    from palpate.gateway.cli import emulated
    from palpate.gateway.cli.emulate import emulate_command

    if interface:
        device = emulated.robotous_can(interface, channel, model, serial)
    else:
        device = emulated.robotous_serial(link, baud, model, serial)
    emulate_command(device, fault or [], seconds)


@emulate_app.command(
    epilog=example("palpate emulate bota --link ./bota", "palpate emulate bota --fault restart@20")
)
def bota(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(help="Its speed [bit/s].")] = 460800,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Bota SensONE or Rokubi on a serial line; its client sets the rate."""
    from palpate.gateway.cli import emulated
    from palpate.gateway.cli.emulate import emulate_command

    emulate_command(emulated.bota(link, baud), fault or [], seconds)


@emulate_app.command(
    "biotac-can",
    epilog=example(
        "palpate emulate biotac-can --fingers 2",
        "palpate emulate biotac-can --interface socketcan --channel vcan0 --fault absent@10+5",
    ),
)
def biotac_can(
    interface: Annotated[
        str, typer.Option(help="python-can's kind of bus; udp_multicast needs no hardware.")
    ] = "udp_multicast",
    channel: Annotated[str, typer.Option(help="Which bus.")] = MULTICAST,
    bus: Annotated[
        list[str] | None,
        typer.Option("--bus", metavar="KEY=VALUE", help="More of python-can's; repeatable."),
    ] = None,
    fingers: Annotated[int, typer.Option(min=1, max=3, help="BioTacs on the bus.")] = 3,
    can_id: Annotated[int, typer.Option(min=0, max=0x7FF, help="Identifier of frames.")] = 1,
    slot_rate_hz: Annotated[
        float, typer.Option(min=1, max=10_000, help="Frames each second.")
    ] = 4400,
    pac_first: Annotated[
        bool, typer.Option("--pac-first", help="A sampling round begins with PAC, not with E1.")
    ] = False,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """BioTacs at SynTouch's CAN interface, untouched: one CAN frame for each sampled channel."""
    from palpate.gateway.cli import emulated
    from palpate.gateway.cli.emulate import emulate_command

    device = emulated.biotac_can(
        interface,
        channel,
        bus or [],
        fingers=fingers,
        can_id=can_id,
        slot_rate_hz=slot_rate_hz,
        pac_first=pac_first,
    )
    emulate_command(device, fault or [], seconds)
