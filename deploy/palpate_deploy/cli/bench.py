"""``palpate bench``: how fast it is, beside the bare floor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_deploy.cli.options import JsonOption, example, group

bench_app = group("How fast it is, beside the bare floor.")

SaveOption = Annotated[
    bool, typer.Option("--save", help="Append the result to tests/benchmarks/history.jsonl.")
]


@bench_app.command(
    epilog=example("palpate bench e2e", "palpate bench e2e --seconds 2 --rounds 3 --json")
)
def e2e(
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of one round [s].")] = 4.0,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of each of the two.")] = 6,
    sensors: Annotated[int, typer.Option(min=1, help="Fingers of the load test.")] = 20,
    load_seconds: Annotated[float, typer.Option(min=1, help="Length of the load test [s].")] = 10.0,
    ramp: Annotated[bool, typer.Option(help="Raise the rate until a frame is lost.")] = True,
    bundle: Annotated[str, typer.Option(help="Bundle that is served.")] = "features-virtual",
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Frame stamp to estimate in a client, over TCP, interleaved with the bare floor."""
    from palpate_deploy.bench.e2e import run_e2e

    run_e2e(
        seconds=seconds,
        rounds=rounds,
        sensors=sensors,
        load_seconds=load_seconds,
        ramp=ramp,
        bundle=bundle,
        as_json=json_,
        save=save,
    )


@bench_app.command(epilog=example("palpate bench hand --seconds 600"))
def hand(
    seconds: Annotated[float, typer.Option(min=2, help="Length of the measurement [s].")] = 60.0,
    floor_seconds: Annotated[float, typer.Option(min=2, help="Length of the floor's [s].")] = 20.0,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Five BioTacs and two force/torque sensors through one gateway, beside bare readers."""
    from palpate_deploy.bench.hand import run_hand

    run_hand(seconds=seconds, floor_seconds=floor_seconds, as_json=json_, save=save)


@bench_app.command(epilog=example("palpate bench alignment --page docs/results/alignment.md"))
def alignment(
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of the measurement [s].")] = 30.0,
    settle_seconds: Annotated[
        float, typer.Option(min=0, help="How long clocks are followed before it [s].")
    ] = 10.0,
    page: Annotated[Path | None, typer.Option(help="Write a page of the result.")] = None,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """How far off stamps are, and electrodes, wrenches and poses apart, against a known signal."""
    from palpate_deploy.bench.alignment import run_alignment

    run_alignment(
        seconds=seconds, settle_seconds=settle_seconds, page=page, as_json=json_, save=save
    )


@bench_app.command(epilog=example("palpate bench codec --json"))
def codec(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; the median of their medians.")] = 20,
    json_: JsonOption = False,
    save: SaveOption = False,
) -> None:
    """Encode and decode of an electrode frame, with all checks."""
    from palpate_deploy.bench.codec import run_codec

    run_codec(rounds, as_json=json_, save=save)
