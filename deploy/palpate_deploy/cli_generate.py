"""``palpate data generate``: the experiment on the twin, from parameters to data sets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.command import typed_command
from palpate_deploy.cli.options import JsonOption, show_left_out
from palpate_fem.config import LIMITS

if TYPE_CHECKING:
    from palpate_deploy.generate.pipeline import Generated

generate_app = typer.Typer(add_completion=False, rich_markup_mode=None)
sample_app = typer.Typer(add_completion=False, rich_markup_mode=None)


@generate_app.command(
    epilog="Example: palpate data generate runs/twin  or, small: palpate data generate runs/small"
    " --points 1 --indenter sphere_medium --edge-mm 1.0"
)
def generate(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="Takes all; goes on if begun.")],
    points: Annotated[int, typer.Option(min=1, help="Points for each indenter.")] = 10,
    angled: Annotated[int, typer.Option(min=0, max=4, help="Angled paths at each.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Of points, registration and noise.")] = 0,
    indenter: Annotated[
        list[str] | None, typer.Option("--indenter", help="May be repeated; none = all nine.")
    ] = None,
    units: Annotated[
        Path | None,
        typer.Option("--units", metavar="FILE.json", help="Population; none = the shipped three."),
    ] = None,
    edge_mm: Annotated[float, typer.Option(help="Edge of the mesh on the pad [mm].")] = 0.6,
    fill_ml: Annotated[float, typer.Option(help="Fluid under the skin [ml].")] = 0.6,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Processes; 0 = one for each core.")
    ] = 0,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Work on a Ray cluster: HOST:PORT, auto or local."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Press nine indenters on three simulated BioTacs; write both of the paper's data sets."""
    from palpate_deploy.generate.pipeline import generate as run
    from palpate_deploy.generate.spec import ExperimentSpec
    from palpate_fem.cli.model import workers_for
    from palpate_fem.cli.show import progress_bar
    from palpate_fem.cli.stopping import stop_on_signal
    from palpate_fem.indenter.catalogue import make_indenter
    from palpate_fem.population.member import read_population

    low, high = LIMITS["fluid_volume_m3"]
    if not low < fill_ml * 1e-6 <= high:
        raise typer.BadParameter(f"{fill_ml} ml is not within {low * 1e6:g} to {high * 1e6:g}")
    members = read_population(units)
    spec = ExperimentSpec(
        points=points,
        angled=angled,
        seed=seed,
        edge_m=edge_mm * 1e-3,
        fluid_volume_m3=fill_ml * 1e-6,
        indenters=tuple(make_indenter(name).name for name in indenter or ()),
    )
    count, threads = workers_for(workers)
    with stop_on_signal() as stop, progress_bar() as bar:
        tasks = {}

        def on_stage(stage: str, done: int, total: int, word: str) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total, info=word)

        result = run(
            out,
            spec,
            members,
            workers=count,
            threads=threads,
            ray=ray,
            stop=stop,
            on_stage=on_stage,
            command=typed_command(),
        )
    if result is None:
        typer.echo(f"stopped; {out} keeps what is done: run the command again to go on")
        raise typer.Exit(1)
    if as_json:
        typer.echo(json.dumps(_summary(result), indent=1))
    else:
        _show(result)


@sample_app.command(
    epilog="Example: palpate data sample runs/twin --dataset sample.h5 --tape twin.npz"
)
def sample(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A finished experiment.")],
    dataset: Annotated[Path, typer.Option("--dataset", metavar="FILE.h5", help="To write.")],
    tape: Annotated[Path, typer.Option("--tape", metavar="FILE.npz", help="To write.")],
    rest: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Takes both data sets without what the tape plays."),
    ] = None,
    units: Annotated[
        Path | None,
        typer.Option("--units", metavar="FILE.json", help="Population; none = the shipped three."),
    ] = None,
) -> None:
    """Take a small part of an experiment: a data set for tests, a tape for the virtual finger."""
    from palpate_deploy.generate.sample import make_sample
    from palpate_fem.population.member import read_population

    done = make_sample(folder, read_population(units), dataset, tape, rest)
    typer.echo(
        f"{len(done.trajectories)} trajectories; {dataset}: {done.trials} trials,"
        f" {done.dataset_bytes / 1e6:.2f} MB; {tape}: {done.tape_bytes / 1e6:.2f} MB"
    )


def _summary(result: Generated) -> dict[str, object]:
    experiment, mixed = result.data.experiment, result.data.mixed
    return {
        "folder": str(result.folder),
        "provenance_sha256": result.provenance_sha256,
        "trajectories": len(experiment.trajectories),
        "trials": len(experiment.trial_unit),
        "rows": len(experiment),
        "mixed_trials": len(mixed.experiment.trial_unit),
        "mixed_rows": len(mixed),
        "modes": len(mixed.basis.modes),
        "field_loss_mean_um": mixed.basis.loss_mean_m * 1e6,
        "field_loss_max_um": mixed.basis.loss_max_m * 1e6,
        "dropped": [list(pair) for pair in result.data.dropped],
        "seconds": {name: round(value, 1) for name, value in result.seconds.items()},
        "megabytes": {name: round(value / 1e6, 1) for name, value in result.bytes.items()},
    }


def _show(result: Generated) -> None:
    summary = _summary(result)
    dropped = result.data.dropped
    for key, value in summary.items():
        if key != "dropped":
            typer.echo(f"{key:20} {value}")
    typer.echo(f"{'left out':20} {len(dropped)} trials of one or both data sets")
    show_left_out(dropped)
    typer.echo(f"look at it: palpate data inspect {result.folder / 'mixed.h5'}")
