"""``palpate record``, ``replay``, ``review``, ``info``, ``recover``; and making bundles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate.errors import ConfigError
from palpate_deploy.cli.options import (
    DEFAULT_CONNECT,
    DEFAULT_STATION,
    ConnectOption,
    JsonOption,
    ReplayPace,
    SensorOption,
    StationOption,
    TlsOption,
    client_link,
    example,
    existing_file,
    finite,
    group,
)

RecordArgument = Annotated[Path, typer.Argument(metavar="FILE.mcap", help="A palpate record.")]


def record(
    out: Annotated[Path, typer.Option(help="Folder of the record.")] = Path("runs"),
    duration_s: Annotated[
        float, typer.Option(callback=finite, min=0, help="Duration [s]; 0 = until Ctrl-C.")
    ] = 0,
    topic: Annotated[
        list[str] | None, typer.Option("--topic", help="Record only this topic; may be repeated.")
    ] = None,
    sensor: SensorOption = "*",
    rrd: Annotated[bool, typer.Option(help="Also write a Rerun view.")] = True,
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    station: StationOption = DEFAULT_STATION,
) -> None:
    """Record a running station, independently of its own recorder."""
    from palpate_deploy.diagnose.records import record_station

    record_station(
        client_link(connect, tls),
        station,
        {"out": str(out), "topics": tuple(topic or ()), "sensor": sensor, "rrd": rrd},
        duration_s=duration_s,
    )


def replay(
    file: Annotated[
        Path,
        typer.Argument(
            help="A vendor's text log (plain or .gz), a palpate .mcap, or a bag of ROS (.bag, or "
            "the folder of ROS 2)."
        ),
    ],
    pace: Annotated[
        ReplayPace,
        typer.Option(help="fast = without loss as fast as possible; recorded = in real time."),
    ] = ReplayPace.FAST,
    out: Annotated[Path, typer.Option(help="Folder of the new record.")] = Path("runs/replay"),
    bundle: Annotated[
        str, typer.Option(help="Bundle by name, name:version or folder.")
    ] = "features-virtual",
    rrd: Annotated[bool, typer.Option(help="Also write a Rerun view.")] = True,
    json_: JsonOption = False,
) -> None:
    """Send a file through gateway, features and recorder, and check that nothing is lost.

    A log or bag of one finger is played as sensor finger, one of several as finger-1, finger-2 and
    so on, by their ports.
    """
    from palpate_deploy.diagnose.replay import run_replay

    raise typer.Exit(
        run_replay(
            existing_file(file, or_folder=True), pace.value, out, bundle, rrd=rrd, as_json=json_
        )
    )


def review(
    path: Annotated[
        Path, typer.Argument(metavar="FILE.mcap|STORE.sim", help="A record, or simulations.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="The .rrd to write; default: next to the input.")
    ] = None,
    png: Annotated[
        Path | None,
        typer.Option(
            help="Also draw a PNG: of a record truth against estimate; of a store an overview, or "
            "with one --trajectory its last step."
        ),
    ] = None,
    foxglove: Annotated[
        Path | None,
        typer.Option(
            metavar="NAME.mcap",
            help="Of a record: write a file for Foxglove instead, with forces and skin in 3D.",
        ),
    ] = None,
    trajectory: Annotated[
        list[str] | None,
        typer.Option(
            "--trajectory",
            metavar="ID",
            help="Of a store: only this one, e.g. 'cube/*'; may be repeated.",
        ),
    ] = None,
    most: Annotated[
        int, typer.Option(min=1, help="Of a store: largest number of trajectories, evenly chosen.")
    ] = 8,
    bundle: Annotated[
        list[str] | None,
        typer.Option(
            help="Of a record: a bundle with the mesh of its fields, in addition to the packaged "
            "ones; may be repeated."
        ),
    ] = None,
) -> None:
    """Make a Rerun view of a record, or of a store of simulations; or a record for Foxglove."""
    from palpate_deploy.diagnose.records import review_path, write_foxglove

    named = tuple(trajectory or ())
    if foxglove is not None:
        if out is not None or png is not None or named:
            raise ConfigError(
                "--foxglove writes one file, of a record",
                remedy="leave out --out, --png and --trajectory",
            )
        write_foxglove(existing_file(path), foxglove, bundles=tuple(bundle or ()))
        return
    review_path(path, out, png, trajectories=named, most=most, bundles=tuple(bundle or ()))


def info(file: RecordArgument, json_: JsonOption = False) -> None:
    """Contents of a record: streams, counts, rates, duration."""
    from palpate_deploy.diagnose.records import show_info

    show_info(existing_file(file), as_json=json_)


def recover(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE.mcap[.part]", help="A cut-off or damaged record."),
    ],
) -> None:
    """Write the whole messages of a cut-off or damaged record to NAME.recovered.mcap.

    A .part of which only the end is missing is removed then; one that is damaged otherwise becomes
    NAME.mcap.damaged. A file of another name stays. Prints what could not be read.
    """
    from palpate_deploy.diagnose.records import recover_record

    recover_record(existing_file(file))


def register(app: typer.Typer) -> None:
    """Add these commands to ``app``."""
    for command, lines in (
        (record, ("palpate record --out runs --duration-s 60",)),
        (replay, ("palpate replay data.btd.gz", "palpate replay runs/lab.mcap --pace recorded")),
        (review, ("palpate review lab.mcap", "palpate review lab.mcap --foxglove f.mcap")),
        (info, ("palpate info runs/lab.mcap",)),
        (recover, ("palpate recover runs/lab.mcap.part",)),
    ):
        app.command(epilog=example(*lines))(command)


bundle_app = group("Make bundles.")


@bundle_app.command(epilog=example("palpate bundle virtual --out runs/bundle/1 --frames 20000"))
def virtual(
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write; default: the next version of the packaged bundle."),
    ] = None,
    frames: Annotated[int, typer.Option(min=1000, help="Frames of the virtual finger.")] = 160_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the finger and of the training.")] = 1,
) -> None:
    """Train the features bundle of the demo on the virtual finger (needs palpate[training])."""
    from palpate_deploy.demo.bundles import make_virtual_bundle

    make_virtual_bundle(out, frames=frames, seed=seed)


@bundle_app.callback()
def _group() -> None:
    """Keep ``virtual`` a subcommand although it is the only one."""
