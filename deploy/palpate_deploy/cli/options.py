"""Options and output that several commands share."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.errors import PalpateError
from palpate_deploy.station.logs import exit_code, print_error

if TYPE_CHECKING:
    from palpate.config import LinkConfig, TlsConfig

DEFAULT_CONNECT = "tcp/127.0.0.1:7447"  # as palpate.config.DEFAULT_ROUTER, whose import is slow
DEFAULT_STATION = "lab"

ProfileOption = Annotated[
    str, typer.Option("--profile", "-p", metavar="NAME|FILE", help="A profile by name or path.")
]
WantedOption = Annotated[
    str | None,
    typer.Option(
        "--profile",
        "-p",
        metavar="NAME|FILE",
        help="Profile that lists what should run; default: what the station's supervisor lists.",
    ),
]
ConnectOption = Annotated[
    str,
    typer.Option(
        "--connect", metavar="ENDPOINT", envvar="PALPATE_CONNECT", help="The station's router."
    ),
]
StationOption = Annotated[
    str, typer.Option("--station", envvar="PALPATE_STATION", help="Name of the station.")
]
ConnectElseOption = Annotated[
    str | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        envvar="PALPATE_CONNECT",
        help="The station's router.",
        show_default=f"of the profile, else {DEFAULT_CONNECT}",
    ),
]
"""As ``ConnectOption``, beside ``--profile``: what is given holds, be it the default."""
StationElseOption = Annotated[
    str | None,
    typer.Option(
        "--station",
        envvar="PALPATE_STATION",
        help="Name of the station.",
        show_default=f"of the profile, else {DEFAULT_STATION}",
    ),
]
TlsOption = Annotated[
    Path | None,
    typer.Option(
        "--tls",
        metavar="FOLDER",
        envvar="PALPATE_TLS",
        help="Certificates for a router tls/HOST:PORT: ca.pem, cert.pem, key.pem.",
    ),
]
SensorOption = Annotated[str, typer.Option("--sensor", help="Name of a sensor; * = all.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]

DEFAULT_PROFILE = "virtual"
ROUTER_WAIT_S = 2.0
"""How long a command waits for the station's router [s]."""


class ReplayPace(enum.StrEnum):
    """How fast a file is replayed."""

    RECORDED = "recorded"
    FAST = "fast"


class PalpateGroup(typer.core.TyperGroup):
    """Commands whose ``PalpateError`` ends in two lines and an exit code."""

    def invoke(self, ctx: typer.Context) -> object:  # type: ignore[override]
        """Run the command that was given."""
        try:
            return super().invoke(ctx)
        except PalpateError as error:
            print_error(error)
            raise typer.Exit(exit_code(error)) from error


def group(help_text: str) -> typer.Typer:
    """A group of commands: shows its help when called alone."""
    return typer.Typer(
        help=help_text, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None
    )


def example(*lines: str) -> str:
    """The end of a command's help: runnable lines."""
    return "Example: " + "  or  ".join(lines)


def finite(value: float | None) -> float | None:
    """The number of an option; infinity and NaN, which a least value does not stop, are refused."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not finite.")
    return value


def client_link(connect: str, tls: TlsConfig | Path | None = None) -> LinkConfig:
    """Link of a command to a running station, with a short wait for its router."""
    from palpate.config import joining_link

    return joining_link(connect, wait_s=ROUTER_WAIT_S, tls=tls)


def station_link(
    profile: str | None, connect: str | None, station: str | None, tls: Path | None = None
) -> tuple[LinkConfig, str]:
    """Link and name of a station: those of a profile where they are not given."""
    if profile is None:
        connect = DEFAULT_CONNECT if connect is None else connect
        return client_link(connect, tls), DEFAULT_STATION if station is None else station
    from palpate.config import Role, TlsConfig
    from palpate_deploy.station.profile import load_profile

    loaded = load_profile(profile)
    link = loaded.link
    if tls is not None and not link.has_tls and connect is None and len(link.connect) == 1:
        connect = link.connect[0]  # as if it were given: whether the two fit is checked
    if tls is not None and link.has_tls:  # another role than the operator's, or another folder
        link = link.model_copy(update={"tls": TlsConfig.of_folder(tls), "certificates": None})
    link = link.as_role(Role.OPERATOR)
    link = link.model_copy(update={"wait_for_router_s": ROUTER_WAIT_S})
    if connect is not None:
        link = client_link(connect, tls or (link.tls if connect.startswith("tls/") else None))
    return link, loaded.station if station is None else station


def existing_file(path: Path, *, or_folder: bool = False) -> Path:
    """The path of an existing file, ``or_folder``; otherwise a ``ConfigError``."""
    from palpate.config import looking_at
    from palpate.errors import ConfigError

    with looking_at(path):
        if not (path.is_file() or (or_folder and path.is_dir())):
            if path.exists():
                kind = "a folder" if path.is_dir() else "no regular file"
                raise ConfigError(f"{path} is {kind}", remedy="give a file")
            raise ConfigError(f"{path} does not exist", remedy="check the path")
    return path


SHOWN = 10
"""Number of lines that are printed without ``--json``."""


def show_left_out(pairs: Sequence[tuple[str, str]]) -> None:
    """Print names with their reasons."""
    for name, why in pairs[:SHOWN]:
        typer.echo(f"  {name}: {why}")
    if len(pairs) > SHOWN:
        typer.echo(f"  ... {len(pairs) - SHOWN} more; all of them: --json")
