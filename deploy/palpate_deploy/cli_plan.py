"""``palpate data plan``: the paper's trajectories as a file that a robot executes."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.errors import ConfigError
from palpate_deploy.cli.options import JsonOption, show_left_out

if TYPE_CHECKING:
    from palpate_training.experiment.plan import Eliminated, Plan

plan_app = typer.Typer(add_completion=False, rich_markup_mode=None)


@plan_app.command(
    epilog="Example: palpate data plan plan.jsonl --store runs/twin/mechanics.sim --registration"
    " registration.json --urdf left=left.urdf --urdf right=right.urdf --tip-frame tip"
)
def plan(
    out: Annotated[Path, typer.Argument(metavar="OUT.jsonl", help="Trajectory file to write.")],
    store: Annotated[
        Path | None,
        typer.Option(metavar="STORE.sim", help="Simulation to mix with later; gives the skin."),
    ] = None,
    edge_mm: Annotated[
        float | None, typer.Option(help="Instead of a store: edge of the mesh on the pad [mm].")
    ] = None,
    fill_ml: Annotated[
        float | None, typer.Option(help="Instead of a store: fluid under the skin [ml].")
    ] = None,
    points: Annotated[int, typer.Option(min=1, help="Points for each indenter.")] = 10,
    angled: Annotated[int, typer.Option(min=0, max=4, help="Angled paths at each.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Of the points.")] = 0,
    indenter: Annotated[
        list[str] | None, typer.Option("--indenter", help="May be repeated; none = all nine.")
    ] = None,
    registration: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Of palpate data register; none = stand-in arms."),
    ] = None,
    urdf: Annotated[
        list[str] | None,
        typer.Option("--urdf", metavar="ARM=FILE", help="Kinematics; none = poses, no joints."),
    ] = None,
    tip_frame: Annotated[
        str | None, typer.Option(metavar="NAME", help="Frame of the URDF that carries the tool.")
    ] = None,
    tool_mm: Annotated[
        float, typer.Option(help="From that frame along its z to the tip [mm].")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Plan nine indenters x ten points x (one normal, four angled presses) for one or two arms."""
    from palpate_deploy.generate.mechanics import fingertip_of
    from palpate_deploy.generate.planning import plan_experiment, stations_of
    from palpate_deploy.generate.spec import EDGE_M, FLUID_VOLUME_M3, ExperimentSpec
    from palpate_fem.cli.show import console, progress_bar
    from palpate_fem.indenter.catalogue import make_indenter
    from palpate_fem.store.read import SimulationStore
    from palpate_training.cli.experiment import arms_of, by_arm
    from palpate_training.experiment.registration import read_registrations
    from palpate_training.experiment.trajectory_file import write_trajectories

    if store is not None and (edge_mm is not None or fill_ml is not None):
        raise ConfigError(
            "--store gives the skin, so --edge-mm and --fill-ml have no say",
            remedy="leave them out, or the store",
        )
    spec = ExperimentSpec(
        points=points,
        angled=angled,
        seed=seed,
        edge_m=EDGE_M if edge_mm is None else edge_mm * 1e-3,
        fluid_volume_m3=FLUID_VOLUME_M3 if fill_ml is None else fill_ml * 1e-6,
        indenters=tuple(make_indenter(name).name for name in indenter or ()),
    )
    stations = stations_of(
        arms_of(by_arm(urdf or (), "--urdf"), tip_frame, tool_mm * 1e-3),
        None if registration is None else read_registrations(registration),
    )
    opened = None if store is None else SimulationStore.open(store)
    with console.status("pressurising the fingertip" if opened is None else "reading the store"):
        fingertip = fingertip_of(spec) if opened is None else opened.fingertip()
    with progress_bar() as bar:
        task = bar.add_task("planning", total=None)

        def on_progress(done: int, total: int, word: str) -> None:
            bar.update(task, completed=done, total=total, info=word)

        found, eliminated = plan_experiment(
            spec, fingertip, stations, store=opened, on_progress=on_progress
        )
    if not found.motions:
        raise ConfigError(
            f"all {len(eliminated)} trajectories are eliminated; the first: {eliminated[0].reason}",
            remedy="check registration, URDF, --tip-frame and --tool-mm",
        )
    write_trajectories(found, out)
    if as_json:
        typer.echo(json.dumps(_summary(out, found, eliminated), indent=1))
    else:
        _show(out, found, eliminated)


def _summary(out: Path, found: Plan, eliminated: list[Eliminated]) -> dict[str, object]:
    return {
        "plan": str(out),
        "trajectories": len(found.motions),
        "arms": dict(Counter(motion.trajectory.arm for motion in found.motions)),
        "joints": all(motion.joints is not None for motion in found.motions),
        "duration_s": float(found.motions[-1].time_s[-1]),
        "eliminated": [[one.trajectory, one.reason] for one in eliminated],
    }


def _show(out: Path, found: Plan, eliminated: list[Eliminated]) -> None:
    arms = Counter(motion.trajectory.arm for motion in found.motions)
    who = ", ".join(f"{arm} {count}" for arm, count in sorted(arms.items()))
    hours = found.motions[-1].time_s[-1] / 3600.0
    typer.echo(f"{out}: {len(found.motions)} trajectories ({who}), {hours:.1f} h")
    typer.echo(f"eliminated: {len(eliminated)}")
    show_left_out([(one.trajectory, one.reason) for one in eliminated])
