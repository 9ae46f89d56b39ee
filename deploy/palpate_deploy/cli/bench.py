"""``palpate bench``: latency and load, compared with a bare implementation (the floor)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_deploy.cli.options import JsonOption, example, finite, group

bench_app = group("Latency and load, compared with a bare implementation (the floor).")


# What cannot be written must be told before a measurement that takes hours.


def _check_history(save: bool) -> bool:
    if save:
        from palpate_deploy.bench.results import history_folder

        history_folder()
    return save


def _check_out(out: Path | None) -> Path | None:
    from palpate.files.outputs import check_output

    check_output(out, "--out", ".json")
    return out


def _check_page(page: Path | None) -> Path | None:
    from palpate.files.outputs import check_output

    check_output(page, "--page", ".md")
    return page


SaveOption = Annotated[
    bool,
    typer.Option(
        "--save",
        help="Append the result to tests/benchmarks/history.jsonl.",
        callback=_check_history,
    ),
]
OutOption = Annotated[
    Path | None, typer.Option(help="Write the result as JSON.", callback=_check_out)
]


@bench_app.command(
    epilog=example("palpate bench e2e --runs 5", "palpate bench e2e --seconds 2 --rounds 3 --json")
)
def e2e(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=0.5, help="Duration of one round [s].")
    ] = 4.0,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of palpate and of the floor.")] = 6,
    runs: Annotated[int, typer.Option(min=1, help="Runs, with new processes each.")] = 1,
    sensors: Annotated[int, typer.Option(min=0, help="Fingers in the load test.")] = 40,
    fields: Annotated[int, typer.Option(min=0, help="Fingers in the load test of fields.")] = 5,
    load_seconds: Annotated[
        float, typer.Option(callback=finite, min=1, help="Duration of the load test [s].")
    ] = 10.0,
    ramp: Annotated[bool, typer.Option(help="Raise the rate until a frame is lost.")] = True,
    bundle: Annotated[str, typer.Option(help="Bundle that is served.")] = "features-virtual",
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Latency from a frame's stamp to the estimate in a client, in turns with the floor."""
    from palpate_deploy.bench.e2e import run_e2e

    run_e2e(
        seconds=seconds,
        rounds=rounds,
        runs=runs,
        sensors=sensors,
        fields=fields,
        load_seconds=load_seconds,
        ramp=ramp,
        bundle=bundle,
        as_json=json_,
        save=save,
        out=out,
    )


@bench_app.command(epilog=example("palpate bench hand --seconds 600"))
def hand(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=2, help="Duration of the measurement [s].")
    ] = 60.0,
    floor_seconds: Annotated[
        float, typer.Option(callback=finite, min=2, help="Duration of the floor's measurement [s].")
    ] = 20.0,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Five BioTacs and two force/torque sensors through one gateway, against bare readers."""
    from palpate_deploy.bench.hand import run_hand

    run_hand(seconds=seconds, floor_seconds=floor_seconds, as_json=json_, save=save)


@bench_app.command(epilog=example("palpate bench alignment --page docs/results/alignment.md"))
def alignment(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=0.5, help="Duration of the measurement [s].")
    ] = 30.0,
    settle_seconds: Annotated[
        float,
        typer.Option(callback=finite, min=0, help="Time for the clocks to settle before it [s]."),
    ] = 10.0,
    page: Annotated[
        Path | None,
        typer.Option(help="Write the result as a page, Markdown.", callback=_check_page),
    ] = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Errors of stamps, and of aligned electrodes, wrenches and poses, for a known signal."""
    from palpate_deploy.bench.alignment import run_alignment

    run_alignment(
        seconds=seconds, settle_seconds=settle_seconds, page=page, as_json=json_, save=save
    )


@bench_app.command(epilog=example("palpate bench swap", "palpate bench swap --sensors 5 --json"))
def swap(
    changes: Annotated[int, typer.Option(min=1, help="Loads; each is rolled back.")] = 20,
    sensors: Annotated[int, typer.Option(min=1, max=40, help="Fingers.")] = 1,
    rate_hz: Annotated[
        float, typer.Option(callback=finite, min=1, max=1000, help="Frames of each [Hz].")
    ] = 100.0,
    hold_seconds: Annotated[
        float, typer.Option(callback=finite, min=0, help="Time between two changes [s].")
    ] = 0.3,
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Load and roll back bundles while frames come: lost frames, mixed estimates, times."""
    from palpate_deploy.bench.swap import run_swap

    code = run_swap(
        changes=changes,
        sensors=sensors,
        rate_hz=rate_hz,
        hold_s=hold_seconds,
        as_json=json_,
        save=save,
        out=out,
    )
    raise typer.Exit(code)


@bench_app.command(epilog=example("palpate bench codec --json"))
def codec(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of all frames.")] = 20,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Time to encode and decode an electrode frame, with all checks."""
    from palpate_deploy.bench.codec import run_codec

    run_codec(rounds, as_json=json_, save=save)


@bench_app.command(epilog=example("palpate bench faults", "palpate bench faults --only disk"))
def faults(
    seconds: Annotated[
        float, typer.Option(callback=finite, min=0.5, help="Duration of a quiet part [s].")
    ] = 5.0,
    only: Annotated[str, typer.Option(help="Only the rows whose name contains this.")] = "",
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Break what is around a station, one thing after another, and measure what is noticed."""
    from palpate_deploy.bench.faults import run_faults

    raise typer.Exit(run_faults(seconds=seconds, only=only, as_json=json_, save=save, out=out))


@bench_app.command(epilog=example("palpate bench status --out docs/results/serving/status.json"))
def status(
    count: Annotated[int, typer.Option(min=1, help="How often to ask.")] = 200,
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Ask for the status of a station whose cores are all loaded; each answer must be complete."""
    from palpate_deploy.bench.census import run_status_bench

    raise typer.Exit(run_status_bench(count=count, as_json=json_, save=save, out=out))


@bench_app.command(epilog=example("palpate bench restart --times 3 --only fem --only metrics"))
def restart(
    times: Annotated[
        int, typer.Option(min=1, help="How often each process, with each fault.")
    ] = 20,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Only this process, also one that is not among the usual ones; repeat."),
    ] = None,
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Kill each process of a station and let it hang; measure when it publishes again."""
    from palpate_deploy.bench.restart import run_restart

    raise typer.Exit(run_restart(times=times, only=only or [], as_json=json_, save=save, out=out))


@bench_app.command(
    epilog=example("palpate bench soak --minutes 30 --out docs/results/serving/soak.json")
)
def soak(
    minutes: Annotated[float, typer.Option(callback=finite, min=1, help="Duration [min].")] = 30.0,
    fingers: Annotated[int, typer.Option(min=1, help="Virtual fingers.")] = 3,
    fem: Annotated[bool, typer.Option(help="With the simulation service.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the result as JSON, and beside it a PNG.", callback=_check_out),
    ] = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Run a whole station for long: memory, threads and descriptors must not grow."""
    from palpate_deploy.bench.soak import run_soak

    raise typer.Exit(
        run_soak(minutes=minutes, fingers=fingers, fem=fem, out=out, as_json=json_, save=save)
    )


@bench_app.command(epilog=example("palpate bench fleet --stations 1 --stations 4 --times 0"))
def fleet(
    stations: Annotated[
        list[int] | None,
        typer.Option(min=1, max=20, help="Stations at once; repeat. Default: 1, 2, 4, 8, 16."),
    ] = None,
    seconds: Annotated[
        float, typer.Option(callback=finite, min=1, help="Duration of each part [s].")
    ] = 8.0,
    times: Annotated[int, typer.Option(min=0, help="How often each fault; 0 = none.")] = 3,
    out: OutOption = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Stations behind a site's router, on network namespaces as hosts: costs and failover; root."""
    from palpate_deploy.bench.fleet import run_fleet

    code = run_fleet(
        stations=stations or [1, 2, 4, 8, 16],
        seconds=seconds,
        times=times,
        as_json=json_,
        save=save,
        out=out,
    )
    raise typer.Exit(code)
