"""``palpate model``: bundles of the repository, and which of them a station serves."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from palpate.admin import read_token, token_file
from palpate.bus import Session, endpoints
from palpate.client.models import ModelAdmin
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError, PalpateError, printable
from palpate.files.bundle import Bundle, read_manifest
from palpate.files.card import model_card
from palpate.files.signature import sign_bundle
from palpate.messages import ModelAction, ModelInventory, ServedModel
from palpate_deploy.station.logs import cell
from palpate_deploy.station.profile import Profile
from palpate_services.config import ModelsConfig
from palpate_services.inference.model import load
from palpate_services.inference.repository import Repository
from palpate_services.inference.trial import proven

SERVICES = ("features", "field", "synthesis")
"""The services that have models; each is named like the task of its bundles."""

_SHOWN_METRICS = (
    "force_magnitude_n_median",
    "force_angle_rad_median",
    "location_distance_m_median",
)
"""Metrics that the table shows; --json and the manifest have all."""


def list_models(folder: Path, *, as_json: bool) -> None:
    """Print every bundle that ships with palpate or is in ``folder``; of a broken one the error."""
    repository = Repository(folder)
    rows: list[dict[str, Any]] = []
    for name in repository.available():
        where = repository.resolve(name)
        try:
            bundle = repository.read(where)
        except PalpateError as error:
            rows.append({"bundle": name, "error": str(error)})
            continue
        manifest = bundle.manifest
        rows.append(
            {
                "bundle": name,
                "task": manifest.task,
                "sha256": bundle.sha256.hex(),
                "folder": str(where),
                "imported": where.is_relative_to(folder),
                "trained_on": manifest.trained_on,
                "metrics": dict(manifest.metrics),
            }
        )
    if as_json:
        print(json.dumps({"repository": str(folder), "bundles": rows}, indent=2))
        return
    table = Table(title=cell(f"with palpate, and in {folder}"), title_justify="left")
    for column in ("bundle", "task", "sha256", "trained on", "metrics"):
        table.add_column(column, overflow="fold")
    for row in rows:
        name = cell(str(row["bundle"]))
        if "error" in row:
            table.add_row(name, "[red]broken[/]", "", cell(str(row["error"])), "")
            continue
        table.add_row(
            name,
            str(row["task"]),
            str(row["sha256"])[:12],
            cell(str(row["trained_on"])),
            "\n".join(
                f"{key} {value:.4g}"
                for key, value in row["metrics"].items()
                if key in _SHOWN_METRICS
            ),
        )
    Console().print(table)


def verify_model(name: str, kept: ModelsConfig) -> None:
    """Check a bundle as a service does before it serves it, and describe it.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: It breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
    """
    repository = Repository.of_config(kept)
    bundle = _checked(repository, repository.resolve(name))
    manifest = bundle.manifest
    rows = next(iter(bundle.golden.values())).shape[0]
    where = printable(str(bundle.folder))
    print(f"ok  {manifest.name}:{manifest.version}  task {manifest.task}  {where}")
    print(f"    digest {bundle.sha256.hex()}")
    print(f"    {rows} golden rows reproduced; trained on {manifest.trained_on}")


def print_card(name: str, folder: Path) -> None:
    """Print the model card of a bundle.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: It is damaged.
    """
    repository = Repository(folder)
    bundle = repository.read(repository.resolve(name))
    print(model_card(bundle.manifest, bundle.sha256), end="")


def import_model(source: Path, kept: ModelsConfig) -> None:
    """Check a bundle and copy it into the user's repository; nothing serves it yet.

    Raises:
        BundleError: It breaks its contract, or another one has its name and version.
        ConfigError: It cannot be copied.
    """
    repository = Repository.of_config(kept)
    label, where = repository.add(source, lambda copy: _checked(repository, copy))
    print(f"{label}  {printable(str(where))}")
    print(f"serve it: palpate model load {label}")


def sign_model(folder: Path, key: Path) -> None:
    """Sign a bundle, which is checked before.

    Raises:
        BundleError: It breaks its contract.
        ConfigError: The key or the folder cannot be used.
    """
    bundle = _checked(Repository(None), folder)
    print(f"{sign_bundle(bundle, key)}  {bundle.manifest.name}:{bundle.manifest.version}")


def _checked(repository: Repository, folder: Path) -> Bundle:
    bundle = repository.read(folder)
    load(proven(bundle, bundle.manifest.task), bundle.manifest.task)
    return bundle


def change_model(
    link: LinkConfig,
    station: str,
    action: ModelAction,
    *,
    token: Path | None,
    profile: Profile | None,
    service: str | None,
    bundle: str = "",
    sensor: str = "",
    as_json: bool,
) -> None:
    """Give a command to the service that ``service`` names, and print what it serves then.

    ``service`` None means that of the bundle's task; for ``LIST`` every service that runs; else the
    only one that runs. ``token`` None is that of the station, as the ``profile`` or the default
    says where.

    Raises:
        ConfigError: The token cannot be read, the bundle's task is not known here, or several
            services run and none is named.
        LinkError: The service does not run.
        StreamTimeout: The service does not answer in time.
        RemoteError: The service refuses.
    """
    kept = ModelsConfig() if profile is None else profile.models
    secret = read_token(token_file(kept.memory_folder, station) if token is None else token)
    with Session.open(link, station=station) as session:
        admin = ModelAdmin(session, secret)
        wrong: dict[str, PalpateError] = {}
        if action is ModelAction.LIST:
            found, wrong = _served(admin, SERVICES if service is None else (service,))
        else:
            name = service or (_service_of(bundle, kept) if bundle else _only_service(admin))
            if action is ModelAction.LOAD:
                found = {name: admin.load(name, bundle, sensor=sensor)}
            elif action is ModelAction.UNLOAD:
                found = {name: admin.unload(name, sensor=sensor)}
            else:
                found = {name: admin.roll_back(name, sensor=sensor)}
        named = action is ModelAction.LOAD and sensor != ""
        absent = named and not session.serves(endpoints.TARE, sensor=sensor)
    if found:
        _show(found, as_json=as_json)
    for error in wrong.values():
        raise error
    if absent:  # it may come later; but a name may be misspelt, too
        sys.stderr.write(
            f"note: no gateway has sensor {sensor!r} at present; it will have this bundle when one "
            "does\n"
        )


def _service_of(bundle: str, kept: ModelsConfig) -> str:
    """The service for a bundle's task, by the repository of this host."""
    return read_manifest(Repository(kept.repository_folder).resolve(bundle)).task


def _served(
    admin: ModelAdmin, services: tuple[str, ...]
) -> tuple[dict[str, tuple[ModelInventory, ...]], dict[str, PalpateError]]:
    """What serves at each service that runs; and of those that run and do not tell it, why."""
    found, wrong, absent = {}, {}, None
    for service in services:
        try:
            found[service] = admin.served(service)
        except LinkError as error:
            absent = error
        except PalpateError as error:
            wrong[service] = error
    if not found and not wrong and absent is not None:
        if len(services) == 1:
            raise absent
        # Which of them the station should have is not known here.
        raise LinkError(f"none of the services {', '.join(services)} answers", remedy=absent.remedy)
    return found, wrong


def _only_service(admin: ModelAdmin) -> str:
    """The service with models that runs; which of several is meant has to be said."""
    found, wrong = _served(admin, SERVICES)
    running = [service for service in SERVICES if service in {*found, *wrong}]
    if len(running) == 1:
        return running[0]
    if not found:
        raise next(iter(wrong.values()))
    raise ConfigError(
        f"the services {', '.join(running)} run, and the command does not say which it is for",
        remedy=f"name one: --service {' | '.join(running)}",
    )


def _show(found: dict[str, tuple[ModelInventory, ...]], *, as_json: bool) -> None:
    if as_json:
        rows = {
            service: [
                asdict(one) | {"served": [_plain(served) for served in one.served]} for one in all_
            ]
            for service, all_ in found.items()
        }
        print(json.dumps(rows, indent=2))
        return
    table = Table()
    for column in ("service", "sensor", "bundle", "sha256", "before"):
        table.add_column(column, overflow="fold")
    for service, inventories in found.items():
        for one in inventories:
            name = service if one.instance == service else f"{service}/{one.instance}"
            for served in one.served:
                bundle = cell(f"{served.name}:{served.version}") if served.name else "[red]none[/]"
                table.add_row(
                    name,
                    served.sensor or "all others",
                    bundle,
                    served.bundle_sha256.hex()[:12],
                    cell(served.previous or "-"),
                )
    Console().print(table)
    for inventories in found.values():
        for one in inventories:
            if one.change_s:
                print(f"{one.instance}: changed in {one.change_s * 1e3:.1f} ms")


def _plain(served: ServedModel) -> dict[str, Any]:
    return asdict(served) | {"bundle_sha256": served.bundle_sha256.hex()}
