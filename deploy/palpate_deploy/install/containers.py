"""A station in containers: files for ``docker compose`` and for podman under systemd (quadlets).

They come from the same plan as the units: the same processes, the same memory, the same devices.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from palpate.errors import ConfigError
from palpate_deploy.install.plan import InstallOrder, make_plan, present_version
from palpate_deploy.install.units import FEM, ServicePlan, processes_value, profile_path

STATE = PurePosixPath("/var/lib/palpate")
"""The station's folder in its container, owned by the image's user."""

USER = 10001
"""User and group of the image."""

_DIALOUT = 20
"""Group of serial lines in Debian."""

_TASKS = 1024
_FILES = 4096


@dataclass(frozen=True, slots=True)
class _Container:
    """One container of a station."""

    name: str
    what: str
    command: tuple[str, ...]
    environment: dict[str, str]
    memory_mb: int
    stop_s: int
    profile: str
    writable: dict[str, str]
    devices: tuple[str, ...]
    gpu: bool
    check: tuple[str, ...]


def _containers(plan: ServicePlan) -> list[_Container]:
    file = str(profile_path(plan.name))
    made = []
    for solver in (False, True):
        if not (plan.solves if solver else plan.supervised):
            continue
        run = ("run", FEM) if solver else ("up",)
        own = (FEM,) if solver else plan.supervised
        environment = {
            "HOME": str(STATE),
            "XDG_STATE_HOME": f"{STATE}/state",
            "MPLCONFIGDIR": "/tmp",
        }
        if solver:
            environment = {"HOME": "/tmp", "XDG_CACHE_HOME": "/var/cache/palpate"}
        name = f"palpate-fem-{plan.name}" if solver else f"palpate-{plan.name}"
        place = "/var/cache/palpate" if solver else str(STATE)
        made.append(
            _Container(
                name=name,
                what="finite elements" if solver else "station",
                command=(*run, "--profile", file),
                environment={**environment, "PALPATE_PROCESSES": processes_value(own)},
                memory_mb=plan.solver_memory_mb if solver else plan.memory_mb,
                stop_s=15 if solver else plan.stop_s,
                profile=file,
                writable={name: place},
                devices=() if solver else plan.needs.serial,
                gpu=solver and plan.needs.gpu,
                # Not whether all is well: no new start of the station plugs a finger in.
                check=("palpate", "status", "--alive", "--profile", file),
            )
        )
    return made


def container_files(plan: ServicePlan, profile: str, version: str) -> dict[str, str]:
    """Texts by the names of the files.

    Raises:
        ConfigError: The profile has certificates.
    """
    if plan.profile.link.has_tls:
        raise ConfigError(
            "[link]: certificates in containers are secrets of the engine",
            remedy="install it as a service, or write these files from a profile without them",
        )
    image = f"palpate:{version}"
    containers = _containers(plan)
    texts = {f"{plan.name}.toml": profile, "compose.yaml": _compose(plan, containers, image)}
    for one in containers:
        texts[f"{one.name}.container"] = _quadlet(plan, one, image)
    return texts


def write_containers(order: InstallOrder, folder: Path) -> None:
    """Write the files into a folder; files that are there stay.

    Raises:
        ConfigError: The profile is wrong, or another file lies there.
        MissingExtraError: A process needs a package that is not installed.
    """
    plan, profile = make_plan(order, STATE, "/opt/palpate/bin/palpate")
    texts = container_files(plan, profile, present_version())
    write_files(folder, texts)
    print("next, with docker:")
    print(f"  docker compose --file {folder / 'compose.yaml'} up --detach")
    print("or with podman 5 or newer, as root:")
    print(f"  cp {folder}/*.container /etc/containers/systemd/")
    print(f"  install -D -m 644 {folder / plan.name}.toml {profile_path(plan.name)}")
    print(f"  systemctl daemon-reload && systemctl start palpate-{plan.name}")


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Write texts by the names of their files, and say so; none if another file lies there.

    Raises:
        ConfigError: One does.
    """
    for name, text in texts.items():
        file = folder / name
        if file.exists() and file.read_text(encoding="utf-8") != text:
            raise ConfigError(f"{file} is there, and is another one", remedy="name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        print(f"wrote   {folder / name}")


def _compose(plan: ServicePlan, containers: Sequence[_Container], image: str) -> str:
    # Every string is written as JSON, which is YAML, too.
    lines = [
        "# Written by palpate install --containers. To start it: docker compose up --detach",
        f"name: {json.dumps(f'palpate-{plan.name}')}",
        "services:",
    ]
    for one in containers:
        lines += [
            f"  {one.name}:",
            f"    image: {json.dumps(image)}",
            f"    command: {json.dumps(list(one.command))}",
            "    # The router listens on this host's loopback, and sensors are in its networks.",
            "    network_mode: host",
            "    init: true",
            "    read_only: true",
            f'    user: "{USER}:{USER}"',
            "    cap_drop: [ALL]",
            "    security_opt: [no-new-privileges:true]",
            f"    mem_limit: {one.memory_mb}m",
            f"    pids_limit: {_TASKS}",
            f"    ulimits: {{nofile: {_FILES}, core: 0}}",
            "    tmpfs: [/tmp]",
            "    environment:",
            *(f"      {key}: {json.dumps(value)}" for key, value in one.environment.items()),
            "    volumes:",
            f"      - {json.dumps(f'./{plan.name}.toml:{one.profile}:ro')}",
            *(f"      - {json.dumps(f'{key}:{place}')}" for key, place in one.writable.items()),
        ]
        if one.devices:
            lines += [
                f'    group_add: ["{_DIALOUT}"]',
                f"    devices: {json.dumps([f'{line}:{line}' for line in one.devices])}",
            ]
        if one.gpu:
            lines += ["    # Not tried with a GPU.", "    gpus: all"]
        lines += [
            "    restart: unless-stopped",
            f"    stop_grace_period: {one.stop_s}s",
            "    healthcheck:",
            f"      test: {json.dumps(['CMD', *one.check])}",
            "      interval: 30s",
            "      timeout: 20s",
            "      start_period: 120s",
        ]
    lines += ["volumes:", *(f"  {name}: {{}}" for one in containers for name in one.writable)]
    return "\n".join(lines) + "\n"


def _quadlet(plan: ServicePlan, one: _Container, image: str) -> str:
    station = f"palpate-{plan.name}.service"
    relations = ["After=network.target time-sync.target"]
    if one.what == "finite elements" and plan.supervised:
        relations.append(f"PartOf={station}")
    elif plan.solves and plan.supervised:
        relations.append(f"Wants=palpate-fem-{plan.name}.service")
    main = one.what == "station" or not plan.supervised
    lines = [
        "# Written by palpate install --containers; goes into /etc/containers/systemd/",
        "[Unit]",
        f"Description=palpate station {plan.name}"
        + ("" if one.what == "station" else f", {one.what}"),
        *relations,
        "",
        "[Container]",
        f"Image=localhost/{image}",
        f"ContainerName={one.name}",
        f"Exec={shlex.join(one.command)}",
        "Network=host",
        "RunInit=true",
        "ReadOnly=true",
        f"User={USER}",
        f"Group={USER}",
        "DropCapability=all",
        "NoNewPrivileges=true",
        f"PodmanArgs=--memory={one.memory_mb}m",
        f"PidsLimit={_TASKS}",
        f"Ulimit=nofile={_FILES}",
        "Ulimit=core=0",
        "Tmpfs=/tmp",
        *(f"Environment={shlex.quote(f'{k}={v}')}" for k, v in one.environment.items()),
        f"Volume={one.profile}:{one.profile}:ro",
        *(f"Volume={key}:{place}" for key, place in one.writable.items()),
        *([f"GroupAdd={_DIALOUT}"] if one.devices else []),
        *(f"AddDevice=-{line}" for line in one.devices),
        *(["# Not tried with a GPU.", "AddDevice=nvidia.com/gpu=all"] if one.gpu else []),
        "# Up when everything answers; a station that hangs is killed, and started again below.",
        "Notify=healthy",
        f"HealthCmd={shlex.join(one.check)}",
        "HealthInterval=30s",
        "HealthTimeout=20s",
        "HealthRetries=3",
        "HealthStartPeriod=120s",
        "HealthOnFailure=kill",
        f"StopTimeout={one.stop_s}",
        "",
        "[Service]",
        "Restart=on-failure",
        "RestartSec=1",
        "TimeoutStartSec=180",
        *(["", "[Install]", "WantedBy=multi-user.target"] if main else []),
    ]
    return "\n".join(lines) + "\n"
