"""``palpate model``: the bundles that are there, and which of them a station serves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate_deploy.cli.options import (
    DEFAULT_PROFILE,
    ConnectElseOption,
    JsonOption,
    ProfileOption,
    StationElseOption,
    TlsOption,
    example,
    group,
    station_link,
)

if TYPE_CHECKING:
    from palpate.messages import ModelAction

StationProfileOption = Annotated[
    str | None,
    typer.Option(
        "--profile",
        "-p",
        metavar="NAME|FILE",
        help="The station's profile, if its link, name or folders are not the usual ones.",
    ),
]
TokenOption = Annotated[
    Path | None,
    typer.Option("--token", metavar="FILE", help="The station's admin token; default: its own."),
]
ServiceOption = Annotated[
    str | None, typer.Option("--service", help="E.g. features; default: the only one that runs.")
]
ServiceOfBundleOption = Annotated[
    str | None, typer.Option("--service", help="E.g. features; default: by the bundle's task.")
]
AnyServiceOption = Annotated[
    str | None, typer.Option("--service", help="E.g. features; default: each that runs.")
]
OneSensorOption = Annotated[
    str, typer.Option("--sensor", help="Only for this sensor; default: all without one of its own.")
]
BundleArgument = Annotated[str, typer.Argument(metavar="NAME[:VERSION]", help="Default: newest.")]

model_app = group("Bundles of networks: list, verify, import; load and roll back in a station.")


@model_app.command("list", epilog=example("palpate model list"))
def list_(profile: ProfileOption = DEFAULT_PROFILE, json_: JsonOption = False) -> None:
    """Bundles that ship with palpate, and those that were imported."""
    from palpate_deploy.station.models import list_models
    from palpate_deploy.station.profile import load_profile

    list_models(load_profile(profile).models.repository_folder, as_json=json_)


@model_app.command(epilog=example("palpate model verify features-virtual"))
def verify(
    bundle: Annotated[str, typer.Argument(help="Name, name:version or folder.")],
    profile: ProfileOption = DEFAULT_PROFILE,
) -> None:
    """Check digests, contract and golden vectors of a bundle."""
    from palpate_deploy.station.models import verify_model
    from palpate_deploy.station.profile import load_profile

    verify_model(bundle, load_profile(profile).models)


@model_app.command(epilog=example("palpate model card field-twin"))
def card(
    bundle: Annotated[str, typer.Argument(help="Name, name:version or folder.")],
    profile: ProfileOption = DEFAULT_PROFILE,
) -> None:
    """What a bundle estimates, from what it learned and how good it was, as Markdown."""
    from palpate_deploy.station.models import print_card
    from palpate_deploy.station.profile import load_profile

    print_card(bundle, load_profile(profile).models.repository_folder)


@model_app.command("import", epilog=example("palpate model import runs/bundle/2"))
def import_(
    folder: Annotated[Path, typer.Argument(help="Folder of the bundle.")],
    profile: ProfileOption = DEFAULT_PROFILE,
) -> None:
    """Check a bundle and copy it into the repository; nothing serves it until it is loaded."""
    from palpate_deploy.station.models import import_model
    from palpate_deploy.station.profile import load_profile

    import_model(folder, load_profile(profile).models)


@model_app.command(epilog=example("palpate model key lab-signing.key"))
def key(
    file: Annotated[Path, typer.Argument(help="New file of the private key.")],
) -> None:
    """Make a key that signs bundles; stations are told its public half, FILE.pub."""
    from palpate.files.signature import make_signing_key

    public = make_signing_key(file)
    print(f"{file}: keep it secret, off the station")
    print(f'{public}: for each station\'s profile: [models] trusted_keys = ["{public}"]')


@model_app.command(epilog=example("palpate model sign runs/bundle/2 --key lab-signing.key"))
def sign(
    folder: Annotated[Path, typer.Argument(help="Folder of the bundle.")],
    key: Annotated[Path, typer.Option(help="File of the private key.")],
) -> None:
    """Check a bundle and sign it; its signature is copied when it is imported."""
    from palpate_deploy.station.models import sign_model

    sign_model(folder, key)


@model_app.command(epilog=example("palpate model served", "palpate model served --json"))
def served(
    service: AnyServiceOption = None,
    token: TokenOption = None,
    profile: StationProfileOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Which bundle serves which sensor, and what a roll back would serve."""
    from palpate.messages import ModelAction

    _change(ModelAction.LIST, service, token, profile, connect, tls, station, as_json=json_)


@model_app.command(
    epilog=example("palpate model load features-twin:2", "palpate model load mine --sensor finger1")
)
def load(
    bundle: BundleArgument,
    sensor: OneSensorOption = "",
    service: ServiceOfBundleOption = None,
    token: TokenOption = None,
    profile: StationProfileOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Serve another bundle of the repository, without losing a frame."""
    from palpate.messages import ModelAction

    _change(
        ModelAction.LOAD,
        service,
        token,
        profile,
        connect,
        tls,
        station,
        bundle=bundle,
        sensor=sensor,
        as_json=json_,
    )


@model_app.command(epilog=example("palpate model unload --service features --sensor finger1"))
def unload(
    sensor: OneSensorOption = "",
    service: ServiceOption = None,
    token: TokenOption = None,
    profile: StationProfileOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Serve no bundle any more; a sensor then has the bundle of all others again."""
    from palpate.messages import ModelAction

    action = ModelAction.UNLOAD
    _change(action, service, token, profile, connect, tls, station, sensor=sensor, as_json=json_)


@model_app.command(epilog=example("palpate model rollback --service features"))
def rollback(
    sensor: OneSensorOption = "",
    service: ServiceOption = None,
    token: TokenOption = None,
    profile: StationProfileOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Serve again what served before the last change; a second time undoes the first."""
    from palpate.messages import ModelAction

    action = ModelAction.ROLL_BACK
    _change(action, service, token, profile, connect, tls, station, sensor=sensor, as_json=json_)


def _change(
    action: ModelAction,
    service: str | None,
    token: Path | None,
    profile: str | None,
    connect: str | None,
    tls: Path | None,
    station: str | None,
    *,
    bundle: str = "",
    sensor: str = "",
    as_json: bool,
) -> None:
    from palpate.config import check_name
    from palpate_deploy.station.models import change_model
    from palpate_deploy.station.profile import load_profile

    for name, what in ((service, "service"), (sensor, "sensor")):
        if name:
            check_name(name, what)
    link, station = station_link(profile, connect, station, tls)
    change_model(
        link,
        station,
        action,
        token=token,
        profile=None if profile is None else load_profile(profile),
        service=service,
        bundle=bundle,
        sensor=sensor,
        as_json=as_json,
    )
