"""The ``palpate`` command: its options and help texts; the work is done in other modules.

They are imported when a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_deploy.cli import data as training
from palpate_deploy.cli.bench import bench_app
from palpate_deploy.cli.certs import certs_app
from palpate_deploy.cli.files import bundle_app, register
from palpate_deploy.cli.install import register_install
from palpate_deploy.cli.models import StationProfileOption, TokenOption, model_app
from palpate_deploy.cli.options import (
    DEFAULT_CONNECT,
    DEFAULT_PROFILE,
    DEFAULT_STATION,
    ConnectElseOption,
    ConnectOption,
    JsonOption,
    PalpateGroup,
    ProfileOption,
    SensorOption,
    StationElseOption,
    StationOption,
    TlsOption,
    WantedOption,
    client_link,
    example,
    existing_file,
    finite,
    group,
    station_link,
)
from palpate_deploy.station.logs import LogFormat, LogLevel, configure
from palpate_fem.cli.app import fem_app
from palpate_gateway.cli.app import gateway_app
from palpate_gateway.cli.emulate import emulate_app

app = typer.Typer(
    cls=PalpateGroup,
    help="Tactile inference for the SynTouch BioTac: electrodes to features, live and recorded.",
    epilog=example("palpate demo", "palpate up --profile virtual"),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"palpate {version('palpate')}")
        except PackageNotFoundError:
            print("palpate (not installed)")
        raise typer.Exit


@app.callback()
def options(
    log_level: Annotated[
        LogLevel, typer.Option(help="Lowest log level written to stderr.")
    ] = "warning",
    log_format: Annotated[LogFormat, typer.Option(help="Log lines as text or as JSON.")] = ("text"),
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options of every command; they precede its name."""
    configure(log_level, log_format)


@app.command(epilog=example("palpate up --profile virtual", "palpate up --profile virtual --web"))
def up(
    profile: ProfileOption = DEFAULT_PROFILE,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the resolved profile and exit.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the page for browsers, too: [web] listen.")
    ] = False,
) -> None:
    """Start a station's processes and keep them running until Ctrl-C."""
    import tomli_w

    from palpate_deploy.station.profile import load_profile, plain_values

    loaded = load_profile(profile)
    if web and "web" not in loaded.processes:
        loaded = loaded.model_copy(update={"processes": (*loaded.processes, "web")})
    if print_config:
        print(tomli_w.dumps(plain_values(loaded)), end="")
        return
    from palpate_deploy.station.up import run_up

    raise typer.Exit(run_up(loaded, Path(profile).stem))


@app.command(epilog=example("palpate run features --profile virtual"))
def run(
    service: Annotated[str, typer.Argument(help="E.g. gateway, features, field.")],
    profile: ProfileOption = DEFAULT_PROFILE,
) -> None:
    """Run one process of a station in the foreground (`palpate up` starts all of them)."""
    from palpate.process import use_few_resources

    use_few_resources()  # before NumPy is loaded, below
    from palpate_deploy.station.processes import run_service, service_named
    from palpate_deploy.station.profile import load_profile

    run_service(service_named(service), load_profile(profile))


@app.command(epilog=example("palpate status", "palpate status --profile virtual --json"))
def status(
    profile: WantedOption = None,
    alive: Annotated[
        bool,
        typer.Option(
            "--alive", help="Fail only if one is missing or does not answer: for health checks."
        ),
    ] = False,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """What should run at a station and what does; fails if anything is missing or not ready."""
    from palpate_deploy.station.status import show_status

    link, station = station_link(profile, connect, station, tls)
    raise typer.Exit(show_status(link, station, as_json=json_, profile=profile, alive=alive))


@app.command(epilog=example("palpate top", "palpate top --once", "palpate top --json"))
def top(
    period_s: Annotated[
        float, typer.Option(callback=finite, min=0.1, help="Time between two pictures [s].")
    ] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Print one picture and end.")] = False,
    profile: WantedOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Rates, latencies, losses, memory of every process and sensor, live; q quits."""
    from palpate_deploy.station.top import run_top

    link, station = station_link(profile, connect, station, tls)
    raise typer.Exit(
        run_top(link, station, profile=profile, period_s=period_s, once=once, as_json=json_)
    )


@app.command(epilog=example("palpate fleet --connect tls/192.168.1.2:7447 --tls operator"))
def fleet(
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    json_: JsonOption = False,
) -> None:
    """All stations seen from a router, such as a site's; fails if anything is wrong."""
    from palpate_deploy.station.fleet import show_fleet

    raise typer.Exit(show_fleet(client_link(connect, tls), as_json=json_))


@app.command(epilog=example("palpate doctor --profile virtual"))
def doctor(profile: ProfileOption = DEFAULT_PROFILE, json_: JsonOption = False) -> None:
    """Check what a station needs on this host; each check is ok, warn or fail, with a fix."""
    from palpate_deploy.diagnose.doctor import run_doctor

    raise typer.Exit(run_doctor(profile, as_json=json_))


@app.command(epilog=example("palpate tare finger"))
def tare(
    sensor: Annotated[str, typer.Argument(help="Name of the sensor.")] = "finger",
    frames: Annotated[
        int,
        typer.Option(
            min=0, help="Frames (force/torque: readings) to average; 0 = the gateway's setting."
        ),
    ] = 0,
    anyway: Annotated[
        bool,
        typer.Option(
            "--anyway", help="Tare a finger that seems to be held: nothing touches it, it drifted."
        ),
    ] = False,
    timeout_s: Annotated[
        float | None,
        typer.Option(
            callback=finite, min=0, help="Longest time to wait [s]; default: enough for the frames."
        ),
    ] = None,
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    station: StationOption = DEFAULT_STATION,
) -> None:
    """Tare an untouched finger, or zero a force/torque sensor at its present load."""
    from palpate_deploy.station.tare import take_tare

    take_tare(
        client_link(connect, tls),
        station,
        sensor,
        frames=frames,
        anyway=anyway,
        timeout_s=timeout_s,
    )


@app.command(
    epilog=example("palpate calibrate finger", "palpate calibrate finger --from runs/lab.mcap")
)
def calibrate(
    sensor: Annotated[str, typer.Argument(help="Name of the finger.")] = "finger",
    presses: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Presses to record: 6 or more; 0 = none: only --others are used.",
            show_default="20",
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE",
            help="A record (.mcap) or data set (.h5) with presses, instead of recording them.",
        ),
    ] = None,
    others: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="A record or data set with presses of other real fingers; may be repeated. They"
            " help a finger that is like them, most where it has few presses of its own.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the record.", show_default="runs/calibrate")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the bundle; default: features-SERIAL.")] = "",
    serve: Annotated[
        bool | None,
        typer.Option(
            help="Whether the station serves it for this finger.",
            show_default="serve, except with --from",
        ),
    ] = None,
    token: TokenOption = None,
    profile: StationProfileOption = None,
    connect: ConnectElseOption = None,
    tls: TlsOption = None,
    station: StationElseOption = None,
    json_: JsonOption = False,
) -> None:
    """Make a finger's own features bundle: guided presses against its force/torque sensor.

    The bundle estimates the force of this finger alone. How wrong it is, on presses that were held
    out, is printed and kept in the bundle.
    """
    from palpate.config import check_name
    from palpate_deploy.station.calibrate import CalibrationOrder, calibrate_finger
    from palpate_deploy.station.profile import load_profile

    for one, what in ((sensor, "sensor"), (name, "name")):
        if one:
            check_name(one, what)
    link, station = station_link(profile, connect, station, tls)
    calibrate_finger(
        link,
        station,
        CalibrationOrder(
            sensor,
            presses,
            out,
            None if source is None else existing_file(source),
            name,
            serve=source is None if serve is None else serve,
            others=tuple(existing_file(one) for one in others or ()),
        ),
        token=token,
        profile=None if profile is None else load_profile(profile),
        as_json=json_,
    )


_DeviceWords = "'DRIVER KEY=VALUE ...'"


@app.command(
    epilog=example(
        "palpate new-station",
        "palpate new-station --biotac 'biotac_can channel=can0' --serial BT01 "
        "--wrench 'wrench_rdt product=ati_net_ft host=192.168.1.1' --start",
    )
)
def new_station(
    name: Annotated[str, typer.Option(help="Name of the station and of its profile.")] = "lab",
    biotac: Annotated[
        str | None,
        typer.Option(metavar=_DeviceWords, help="The BioTac, as `palpate gateway probe` reads it."),
    ] = None,
    wrench: Annotated[
        str | None, typer.Option(metavar=_DeviceWords, help="The force/torque sensor, likewise.")
    ] = None,
    pose: Annotated[
        str | None, typer.Option(metavar=_DeviceWords, help="The robot's poses, likewise.")
    ] = None,
    serial: Annotated[
        str, typer.Option(help="Serial number of the BioTac, if it sends none.")
    ] = "",
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Where the station's router listens.",
            show_default=DEFAULT_CONNECT,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The profile; default: NAME.toml.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing; take the only BioTac that is found.")
    ] = False,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write the profile although a device is silent.")
    ] = False,
    start: Annotated[
        bool,
        typer.Option(
            "--start", help="Go on: run the station, tare, look, calibrate, serve; until Ctrl-C."
        ),
    ] = False,
    presses: Annotated[int, typer.Option(min=6, help="Presses to calibrate with.")] = 20,
    look_s: Annotated[
        float, typer.Option(callback=finite, min=0, help="How long the signals are shown [s].")
    ] = 5.0,
) -> None:
    """Find what is connected, try it, and write a profile; with --start as far as estimates.

    Run it again to go on: a profile that is there is kept, a station that runs is used, a finger
    with a bundle of its own keeps it.
    """
    from palpate_deploy.station.new_station import (
        FINGER,
        INDENTER,
        WRENCH_SENSOR,
        StationWanted,
        make_station,
        next_commands,
    )

    named = {FINGER: biotac, WRENCH_SENSOR: wrench, INDENTER: pose}
    wanted = StationWanted(
        name,
        Path(f"{name}.toml") if out is None else out,
        {sensor: words for sensor, words in named.items() if words is not None},
        serial,
        listen,
        yes=yes,
        anyway=anyway,
    )
    make_station(wanted)
    if not start:
        print(next_commands(wanted))
        return
    from palpate_deploy.station.first_hour import WalkOrder, walk

    walk(WalkOrder(wanted.path, presses, look_s, Path("runs/calibrate")))


@app.command(epilog=example("palpate demo --seconds 20 --out runs/demo"))
def demo(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=1, help="Duration after the first estimates [s].")
    ] = 20,
    out: Annotated[Path, typer.Option(help="Folder for record, view and picture.")] = Path(
        "runs/demo"
    ),
) -> None:
    """Touch a virtual finger: estimates against the truth, live, then a record and pictures."""
    from palpate_deploy.demo.demo import run_demo

    raise typer.Exit(run_demo(seconds, out))


topic_app = group("Streams on the bus: list, rates, messages.")

TopicArgument = Annotated[str, typer.Argument(metavar="TOPIC", help="E.g. electrodes, features.")]


@topic_app.command("list", epilog=example("palpate topic list"))
def list_(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=0.1, help="How long to listen [s].")
    ] = 1.5,
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """All streams, and which of them have messages now."""
    from palpate_deploy.diagnose.topics import list_topics

    list_topics(client_link(connect, tls), station, seconds, as_json=json_)


@topic_app.command(
    epilog=example("palpate topic hz electrodes", "palpate topic hz features --sensor finger")
)
def hz(
    topic: TopicArgument = "electrodes",
    sensor: SensorOption = "*",
    seconds: Annotated[
        float, typer.Option(callback=finite, min=0, help="Duration [s]; 0 = until Ctrl-C.")
    ] = 0,
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """Rate, jitter, bandwidth and losses of a stream, once a second."""
    from palpate_deploy.diagnose.topics import measure

    raise typer.Exit(
        measure(client_link(connect, tls), station, topic, sensor, seconds, as_json=json_)
    )


@topic_app.command(epilog=example("palpate topic echo features --count 3"))
def echo(
    topic: TopicArgument = "features",
    sensor: SensorOption = "*",
    count: Annotated[int, typer.Option(min=0, help="Number of messages; 0 = until Ctrl-C.")] = 0,
    timeout_s: Annotated[
        float,
        typer.Option(callback=finite, min=0, help="Stop if no message comes for this long [s]."),
    ] = 10.0,
    connect: ConnectOption = DEFAULT_CONNECT,
    tls: TlsOption = None,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """Print the messages of a stream."""
    from palpate_deploy.diagnose.topics import echo_topic

    echo_topic(
        client_link(connect, tls),
        station,
        topic,
        sensor,
        count=count,
        timeout_s=timeout_s,
        as_json=json_,
    )


probe_app = group("Health checks for a cluster: exit status 0 = yes, 1 = no.")


@probe_app.command(epilog=example("palpate probe live"))
def live() -> None:
    """Whether the process of this container beats; a hung one does not."""
    from palpate_deploy.station.probe import why_not_live

    _answer(why_not_live())


@probe_app.command(epilog=example("palpate probe ready fem --profile virtual"))
def ready(
    service: Annotated[str, typer.Argument(help="E.g. router, fem.")],
    profile: ProfileOption = DEFAULT_PROFILE,
) -> None:
    """Whether a process of this profile serves, as the router sees it."""
    from palpate_deploy.station.probe import why_not_ready
    from palpate_deploy.station.profile import load_profile

    _answer(why_not_ready(service, load_profile(profile)))


def _answer(why_not: str) -> None:
    if why_not:
        print(why_not)
        raise typer.Exit(1)


app.add_typer(probe_app, name="probe")
app.add_typer(topic_app, name="topic")
app.add_typer(model_app, name="model")
app.add_typer(bundle_app, name="bundle")
app.add_typer(certs_app, name="certs")
app.add_typer(bench_app, name="bench")
register(app)
register_install(app)
app.add_typer(fem_app, name="fem")
app.add_typer(gateway_app, name="gateway")
app.add_typer(emulate_app, name="emulate")
app.add_typer(training.train, name="train")
app.add_typer(training.data, name="data")
