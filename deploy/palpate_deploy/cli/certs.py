"""``palpate certs``: certificates of a lab, by role."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate_deploy.cli.options import JsonOption, example, group

if TYPE_CHECKING:
    from palpate_deploy.station.certificates import DamagedCertificate, IssuedCertificate

certs_app = group("Certificates of a lab, for stations that other hosts reach.")

FolderArgument = Annotated[Path, typer.Argument(help="Folder of the lab's authority.")]


@certs_app.command(epilog=example("palpate certs ca lab-certs"))
def ca(
    folder: FolderArgument,
    name: Annotated[str, typer.Option(help="Name of the lab, in the certificate.")] = "lab",
    days: Annotated[int, typer.Option(min=1, max=36500, help="Validity [days].")] = 3650,
) -> None:
    """Make the lab's authority: ca.pem for everybody, ca.key for whoever issues."""
    from palpate.process import require

    require("cryptography", extra="security")
    from palpate_deploy.station.certificates import AUTHORITY_KEY, make_authority

    make_authority(folder, name, days=days)
    print(f"{folder}: authority {name!r}, {days} days")
    print(f"keep {folder / AUTHORITY_KEY} secret: whoever has it can issue any role")
    print(f"next: palpate certs issue {folder} --role router --host ADDRESS-OF-THE-STATION")


@certs_app.command(
    epilog=example(
        "palpate certs issue lab-certs --role router --host 192.168.1.10",
        "palpate certs issue lab-certs --role robot --name arm1",
    )
)
def issue(
    folder: FolderArgument,
    role: Annotated[
        str, typer.Option(help="What the holder may do: router, gateway, service, robot, operator.")
    ],
    name: Annotated[
        str, typer.Option(help="Name of the holder and of its folder; default: the role.")
    ] = "",
    host: Annotated[
        list[str] | None,
        typer.Option(help="Name or address at which the holder listens, beside loopback."),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=36500, help="Validity [days].")] = 365,
) -> None:
    """Issue a certificate for one role: a folder with ca.pem, cert.pem, key.pem."""
    from palpate.config import Role, TlsConfig
    from palpate.errors import ConfigError
    from palpate.process import require

    require("cryptography", extra="security")
    from palpate_deploy.station.certificates import issue as make
    from palpate_deploy.station.certificates import read_certificate

    if role not in set(Role):
        raise ConfigError(f"{role!r} is no role", remedy=f"one of: {', '.join(Role)}")
    target = make(folder, Role(role), name, host or (), days=days)
    made = read_certificate(TlsConfig.of_folder(target))
    print(f"{made.folder}: {role}, valid until {made.until:%Y-%m-%d}, for {', '.join(made.hosts)}")
    if made.problem:
        print(f"it does not hold: {made.problem}")
        raise typer.Exit(1)


@certs_app.command(epilog=example("palpate certs show lab-certs"))
def show(folder: FolderArgument, json_: JsonOption = False) -> None:
    """What the certificates in a folder say; fails if one of them does not hold."""
    from palpate.process import require

    require("cryptography", extra="security")
    from palpate_deploy.station.certificates import list_certificates

    found = list_certificates(folder)
    if json_:
        print(json.dumps([_plain(one) for one in found], indent=2))
    else:
        _print_table(found)
    if any(one.problem for one in found):
        raise typer.Exit(1)


def _plain(one: IssuedCertificate | DamagedCertificate) -> dict[str, object]:
    from palpate_deploy.station.certificates import DamagedCertificate

    row: dict[str, object] = {
        "folder": str(one.folder),
        "role": None,
        "name": one.folder.name,
        "hosts": (),
        "until": None,
        "problem": one.problem,
    }
    if not isinstance(one, DamagedCertificate):
        row |= {
            "role": one.role,
            "name": one.name,
            "hosts": one.hosts,
            "until": one.until.isoformat(),
        }
    return row


def _print_table(found: Sequence[IssuedCertificate | DamagedCertificate]) -> None:
    from rich.console import Console
    from rich.table import Table

    from palpate_deploy.station.certificates import DamagedCertificate
    from palpate_deploy.station.logs import cell

    table = Table()
    for column in ("folder", "role", "name", "hosts", "until", ""):
        table.add_column(column, overflow="fold")
    for one in found:
        if isinstance(one, DamagedCertificate):
            table.add_row(cell(one.folder.name), "[red]none[/]", "", "", "", cell(one.problem))
            continue
        table.add_row(
            cell(one.folder.name),
            one.role or "[red]none[/]",
            cell(one.name),
            cell(", ".join(one.hosts)),
            f"{one.until:%Y-%m-%d}",
            cell(one.problem) or f"{one.days_left:.0f} days",
        )
    Console().print(table)
