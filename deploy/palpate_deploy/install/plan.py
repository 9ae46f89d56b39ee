"""What is to be installed: an order, checked against the profile and this host."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath

from palpate.config import is_name
from palpate.errors import ConfigError
from palpate_deploy.install.needs import (
    UNSEEN_FOLDERS,
    check_environment_is_plain,
    hidden,
    needs_of,
)
from palpate_deploy.install.units import ServicePlan
from palpate_deploy.station import profile as profiles
from palpate_deploy.station.processes import check_packages

_LONGEST_NAME = 40
_UNPLAIN = frozenset(" \t\n%\"'\\$;")
"""Characters that mean something in a line of a unit."""


@dataclass(frozen=True, slots=True)
class InstallOrder:
    """What is to be installed.

    Attributes:
        profile: Name or path of the profile.
        name: Name of the station on its host; empty = that of the profile's file.
        root: Root of the system to install into; ``/`` = this host.
        program: The `palpate` command that the units run; empty = the one that runs now.
        allowed: Networks that may be reached beside what the profile names.
    """

    profile: str
    name: str = ""
    root: Path = Path("/")
    program: str = ""
    allowed: tuple[str, ...] = ()

    @property
    def station(self) -> str:
        """Name of the station on its host.

        Raises:
            ConfigError: It cannot be part of a unit's name.
        """
        return checked_name(self.name or Path(self.profile).stem)


def checked_name(name: str) -> str:
    """A name that can be part of the names of units and folders.

    Raises:
        ConfigError: It cannot.
    """
    if not is_name(name) or len(name) > _LONGEST_NAME:
        raise ConfigError(
            f"station {name!r} cannot be part of the name of a unit",
            remedy=f"name it otherwise (--name): 1 to {_LONGEST_NAME} of a-z, 0-9, '-', '_', "
            "starting with a letter or digit",
        )
    return name


def present_version() -> str:
    """Version of the palpate that runs."""
    try:
        return version("palpate")
    except PackageNotFoundError:
        return "0"


def make_plan(order: InstallOrder, state: PurePosixPath, program: str) -> tuple[ServicePlan, str]:
    """The plan of a service, and its profile's text.

    Args:
        order: What is wanted.
        state: The station's own folder.
        program: The `palpate` command that starts its processes.

    Raises:
        ConfigError: The profile is wrong, or cannot be that of a service.
        MissingExtraError: A process needs a package that is not installed.
    """
    check_environment_is_plain()
    path = profiles.profile_path(order.profile)
    values = profiles.read_toml(path)
    text = path.read_text(encoding="utf-8")
    # A command that root gives and the service must mean the same folders.
    models = {"folder": f"{state}/models", "state": f"{state}/state/palpate"}
    given = values.get("models", models)
    if isinstance(given, dict) and (missing := models.keys() - given.keys()):
        raise ConfigError(
            f"{path}: [models] names no {' and no '.join(sorted(missing))}",
            remedy=", ".join(f'{key} = "{models[key]}"' for key in sorted(missing)),
        )
    if "models" not in values:
        values["models"] = models
        text = (
            f"{text.rstrip()}\n\n# The bundles of this station, and what it serves.\n[models]\n"
            + "".join(f'{key} = "{folder}"\n' for key, folder in models.items())
        )
    profile = profiles.parse_profile(values, where=str(path))
    check_packages(profile)
    _check_folders(profile, state)
    return ServicePlan(order.station, profile, needs_of(profile, order.allowed), program), text


def _check_folders(profile: profiles.Profile, state: PurePosixPath) -> None:
    """Check that what the processes write goes into the station's own folder."""
    folders = {"state of [models]": (profile.models.memory_folder, f"{state}/state/palpate")}
    if "recorder" in profile.processes:
        folders["out of [recorder]"] = (profile.recorder.out, "runs")
    for key, (folder, instead) in folders.items():
        if not Path(os.path.normpath(Path(state) / folder)).is_relative_to(state):
            raise ConfigError(
                f"{key}, {str(folder)!r}: a service writes into {state} only",
                remedy=f"write {instead!r}; for a disk of its own see docs/install.md",
            )


def program_of(order: InstallOrder) -> str:
    """The `palpate` command that the units run."""
    return order.program or str(Path(sys.prefix) / "bin" / "palpate")


def check_program(order: InstallOrder) -> None:
    """Check that a service can run the `palpate` command of its units.

    Raises:
        ConfigError: It cannot.
    """
    if order.program:
        if not order.program.startswith("/") or _UNPLAIN & set(order.program):
            raise ConfigError(
                f"program {order.program!r} is not the plain path of a command",
                remedy="name it as that system sees it, e.g. /opt/palpate/bin/palpate",
            )
        return
    program = Path(program_of(order))
    if not program.is_file() or _UNPLAIN & set(str(program)):
        raise ConfigError(
            f"{program} is no command that a unit can run",
            remedy="install palpate into /opt/palpate, a virtual environment, and run that one",
        )
    python = Path(sys.executable).resolve()
    for what, place in (("", program), ("'s Python", python), ("'s code", Path(__file__))):
        if hidden(place):
            raise ConfigError(
                f"palpate{what} lies in {place.parent}, and a service does not see "
                f"{UNSEEN_FOLDERS}",
                remedy="install it into /opt/palpate, an environment of the system's Python, and "
                "run that one: /opt/palpate/bin/palpate",
            )
