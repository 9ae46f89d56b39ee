"""``palpate gateway``: signatures and help of the commands; their work is in other modules.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from typing import Annotated

import typer

gateway_app = typer.Typer(
    help="Sensors without a station: available drivers and ports, and whether a device answers.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

DriverArgument = Annotated[
    str, typer.Argument(metavar="DRIVER", help="A driver; `palpate gateway list` shows all.")
]
OptionsArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE...",
        help="Its options; values as in TOML, dotted keys for tables.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]


def example(*lines: str) -> str:
    """Examples for the end of a command's help: lines that can be run."""
    return "Example: " + "  or  ".join(lines)


@gateway_app.command("list", epilog=example("palpate gateway list"))
def list_(json_: JsonOption = False) -> None:
    """Drivers and what each needs, serial ports and CAN interfaces of this host."""
    from palpate_gateway.cli.inventory import list_command

    list_command(as_json=json_)


@gateway_app.command(
    epilog=example(
        "palpate gateway probe wrench_kms40 host=192.168.1.30",
        "palpate gateway probe wrench_bota port=/dev/ttyUSB0 mount.carries=indenter",
    )
)
def probe(
    driver: DriverArgument,
    options: OptionsArgument = None,
    seconds: Annotated[
        float, typer.Option(min=0.1, help="Duration of the measurement of the rate [s].")
    ] = 2.0,
    json_: JsonOption = False,
) -> None:
    """Open a device; show its identity, rate, first reading and counters."""
    from palpate_gateway.cli.probe import probe_command

    raise typer.Exit(probe_command(driver, options or [], seconds=seconds, as_json=json_))


@gateway_app.command(
    epilog=example(
        "palpate gateway monitor virtual",
        "palpate gateway monitor biotac_can channel=can0 port=2 --seconds 60 --json",
    )
)
def monitor(
    driver: DriverArgument,
    options: OptionsArgument = None,
    seconds: Annotated[
        float, typer.Option(min=0, help="End after this time [s]; 0 = at Ctrl-C.")
    ] = 0,
    json_: Annotated[bool, typer.Option("--json", help="One line of JSON each second.")] = False,
) -> None:
    """Show a device live: values, rate, age, counters; a lost device is opened again."""
    from palpate_gateway.cli.probe import monitor_command

    raise typer.Exit(monitor_command(driver, options or [], seconds=seconds, as_json=json_))
