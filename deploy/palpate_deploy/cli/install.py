"""``palpate install`` and ``palpate uninstall``: options and help texts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate.errors import ConfigError
from palpate_deploy.cli.options import example

RootOption = Annotated[
    Path,
    typer.Option(metavar="FOLDER", help="Root of the system: / = this host, else of an image."),
]


def install(
    profile: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="A profile; that of an installed station brings it up to date.",
        ),
    ],
    name: Annotated[
        str, typer.Option(help="Name of the station on its host; default: of the file.")
    ] = "",
    allow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NETWORK",
            help="Hosts that it may talk to, beside those in the profile, e.g. 192.168.1.0/24; "
            "may be repeated.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print the files and what would stop it; write nothing."),
    ] = False,
    rollback: Annotated[
        bool, typer.Option("--rollback", help="Restore what was installed before the last change.")
    ] = False,
    containers: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Write files for docker compose and podman there, and install nothing.",
        ),
    ] = None,
    kubernetes: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Write manifests of a site in a cluster there, likewise."
        ),
    ] = None,
    replicas: Annotated[
        int, typer.Option(min=1, max=64, help="With --kubernetes: pods of each service.")
    ] = 2,
    root: RootOption = Path("/"),
    program: Annotated[
        str,
        typer.Option(
            metavar="PATH", help="The palpate command of its units; default: the one that runs now."
        ),
    ] = "",
) -> None:
    """Run a station as a service of this host: units of systemd, udev rules, folders.

    The same again, by a newer palpate or with another profile, changes what is installed;
    recordings and models stay.
    """
    from palpate_deploy.install.plan import InstallOrder

    if dry_run and rollback:
        raise ConfigError(
            "--dry-run shows what an install would write, not a roll-back",
            remedy="leave out one of them; a second --rollback undoes the first",
        )
    if kubernetes is not None:
        from palpate_deploy.install.kubernetes import write_manifests

        write_manifests(profile, kubernetes, name=name, replicas=replicas)
        return
    order = InstallOrder(profile, name, root, program, tuple(allow or ()))
    if containers is not None:
        from palpate_deploy.install.containers import write_containers

        write_containers(order, containers)
        return
    from palpate_deploy.install import service

    if dry_run:
        service.show_plan(order)
    elif rollback:
        service.roll_back(order.station, root)
    else:
        service.install(order)


def uninstall(
    name: Annotated[str, typer.Argument(help="Name of the station on this host.")],
    purge: Annotated[
        bool,
        typer.Option(
            "--purge", help="Also remove the profile, changed files, recordings and models."
        ),
    ] = False,
    root: RootOption = Path("/"),
) -> None:
    """Remove what `palpate install` wrote; profile, recordings and models stay."""
    from palpate_deploy.install import service

    raise typer.Exit(service.uninstall(name, root, purge=purge))


def register_install(app: typer.Typer) -> None:
    """Add these commands to ``app``."""
    app.command(
        epilog=example(
            "palpate install lab.toml", "palpate install /etc/palpate/lab.toml --rollback"
        )
    )(install)
    app.command(epilog=example("palpate uninstall lab", "palpate uninstall lab --purge"))(uninstall)
