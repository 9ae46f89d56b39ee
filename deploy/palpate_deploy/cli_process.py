"""``palpate data process``: a real experiment's raw trials to the paper's data sets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.command import typed_command
from palpate_deploy.cli.options import JsonOption, show_left_out

if TYPE_CHECKING:
    from palpate_deploy.generate.measured import Dropped, Processed

process_app = typer.Typer(add_completion=False, rich_markup_mode=None)


@process_app.command(
    epilog="Example: palpate data process day1.h5 day2.h5 experiment.h5  or: palpate data process"
    " day1.h5 experiment.h5 --mechanics runs/twin/mechanics.sim --mixed mixed.h5"
)
def process(
    trials: Annotated[
        list[Path], typer.Argument(metavar="TRIALS.h5...", help="Of palpate data ingest.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT.h5", help="Data set to write.")],
    mechanics: Annotated[
        Path | None,
        typer.Option(metavar="STORE.sim", help="Simulation of the same trajectories."),
    ] = None,
    mixed: Annotated[
        Path | None, typer.Option(metavar="MIXED.h5", help="Mixed data set to write.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Process raw trials as the paper does: experimental data set, and mixed with a simulation."""
    from palpate_deploy.generate.measured import process_files
    from palpate_fem.cli.show import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("processing", total=None)

        def on_progress(done: int, total: int, word: str) -> None:
            bar.update(task, completed=done, total=total, info=word)

        done = process_files(
            trials,
            out,
            mechanics=mechanics,
            mixed=mixed,
            command=typed_command(),
            on_progress=on_progress,
        )
    if as_json:
        typer.echo(json.dumps(_summary(done, out, mixed), indent=1))
    else:
        _show(done, out, mixed)


def _summary(done: Processed, out: Path, mixed: Path | None) -> dict[str, object]:
    found: dict[str, object] = {
        "experiment": str(out),
        "units": list(done.experiment.unit_names),
        "trajectories": len(done.experiment.trajectories),
        "trials": done.experiment.trials,
        "rows": len(done.experiment),
        "dropped": [list(pair) for pair in done.dropped],
    }
    if done.mixed is not None:
        found |= {
            "mixed": str(mixed),
            "mixed_trials": done.mixed.experiment.trials,
            "mixed_rows": len(done.mixed),
            "modes": len(done.mixed.basis.modes),
            "field_loss_mean_um": done.mixed.basis.loss_mean_m * 1e6,
            "unmixed": [list(pair) for pair in done.unmixed],
        }
    return found


def _show(done: Processed, out: Path, mixed: Path | None) -> None:
    data = done.experiment
    typer.echo(
        f"{out}: {data.trials} trials of {len(data.trajectories)} trajectories,"
        f" units {', '.join(data.unit_names)}, {len(data)} rows"
    )
    _show_dropped("left out", done.dropped)
    if done.mixed is not None:
        typer.echo(
            f"{mixed}: {done.mixed.experiment.trials} trials, {len(done.mixed)} rows,"
            f" {len(done.mixed.basis.modes)} modes of the field"
        )
        _show_dropped("not mixed", done.unmixed)


def _show_dropped(what: str, dropped: Dropped) -> None:
    if dropped:
        typer.echo(f"{what}: {len(dropped)} trials")
    show_left_out(dropped)
