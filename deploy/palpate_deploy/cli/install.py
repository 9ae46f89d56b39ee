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

_PODS = 2
_IDLE_BESIDE = {
    "--kubernetes": ("--containers", "--dry-run", "--rollback", "--allow", "--root", "--program"),
    "--containers": ("--dry-run", "--rollback", "--root", "--program", "--replicas"),
    "--rollback": ("--dry-run", "--allow", "--program"),
}
"""Options that would mean nothing beside each."""


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
        int | None,
        typer.Option(
            min=1, max=64, help="With --kubernetes: pods of each service.", show_default=str(_PODS)
        ),
    ] = None,
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

    _check_options(
        {
            "--allow": bool(allow),
            "--dry-run": dry_run,
            "--rollback": rollback,
            "--containers": containers is not None,
            "--kubernetes": kubernetes is not None,
            "--replicas": replicas is not None,
            "--root": root != Path("/"),
            "--program": bool(program),
        }
    )
    if kubernetes is not None:
        from palpate_deploy.install.kubernetes import write_manifests

        write_manifests(profile, kubernetes, name=name, replicas=replicas or _PODS)
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


def _check_options(given: dict[str, bool]) -> None:
    """Refuse options that mean nothing beside the others: whoever gives them expects something.

    Raises:
        ConfigError: There are some.
    """
    for option, others in _IDLE_BESIDE.items():
        if given[option] and (idle := [other for other in others if given[other]]):
            raise ConfigError(
                f"{option} takes no {', '.join(idle)}", remedy="leave out one or the other"
            )
    if given["--replicas"] and not given["--kubernetes"]:
        raise ConfigError(
            "--replicas is of manifests for a cluster only",
            remedy="leave it out, or give --kubernetes FOLDER",
        )


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
