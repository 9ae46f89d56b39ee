"""``palpate train`` and ``palpate data``: the training room's commands, and those that add fem.

The training room needs an extra that a station does not have, so its commands are imported when
one is used. The commands of this module run the experiment: they give the training room the
finite elements.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from palpate.errors import ConfigError, MissingExtraError
from palpate.process import typed_command
from palpate_deploy.cli.options import JsonOption, show_left_out
from palpate_training import EXTRA_MODULES

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from palpate_training.experiment.generate.measured import Dropped, ProcessedExperiment
    from palpate_training.experiment.generate.pipeline import GeneratedExperiment
    from palpate_training.experiment.generate.simulator import OnProgress
    from palpate_training.experiment.plan import EliminatedTrajectory, RobotPlan

twin_app = typer.Typer(add_completion=False, rich_markup_mode=None)

PointsOption = Annotated[int, typer.Option(min=1, help="Points for each indenter.")]
AngledOption = Annotated[int, typer.Option(min=0, max=4, help="Angled paths at each.")]
IndenterOption = Annotated[
    list[str] | None, typer.Option("--indenter", help="May be repeated; none = all nine.")
]
UnitsOption = Annotated[
    Path | None,
    typer.Option("--units", metavar="FILE.json", help="Specimens; none = the three that ship."),
]


class _LazyGroup(typer.core.TyperGroup):
    """A group whose commands are imported when one is used, not when palpate starts."""

    room = ""
    _found: dict[str, Any] | None = None

    @property  # type: ignore[override]
    def commands(self) -> dict[str, Any]:
        """The room's commands, which are put together once.

        Raises:
            MissingExtraError: The training extra is not installed.
        """
        if self._found is None:
            apps = [_app(self.room)] + ([twin_app] if self.room == "data" else [])
            found: dict[str, Any] = {}
            for app in apps:
                found |= typer.main.get_command(app).commands  # type: ignore[attr-defined]
            self._found = found
        return self._found

    @commands.setter
    def commands(self, value: dict[str, Any]) -> None:
        """Typer sets the commands that it knows at the start: none."""


class _TrainGroup(_LazyGroup):
    room = "train"


class _DataGroup(_LazyGroup):
    room = "data"


train = typer.Typer(
    cls=_TrainGroup,
    help="Train, evaluate and export networks (needs palpate[training]).",
    no_args_is_help=True,
)
data = typer.Typer(
    cls=_DataGroup,
    help="Data sets: ingest, split, inspect (needs palpate[training]).",
    no_args_is_help=True,
)
for _app_of_room in (train, data):
    # A group without a callback and with a single command would become that command.
    _app_of_room.callback()(lambda: None)


def _app(room: str) -> typer.Typer:
    """The training room's own app.

    Raises:
        MissingExtraError: The training extra is not installed.
    """
    try:
        from palpate_training.cli import data_app, train_app
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in EXTRA_MODULES:
            raise MissingExtraError(missing, extra="training") from error
        raise
    return train_app if room == "train" else data_app


@twin_app.command(
    "generate",
    epilog="Example: palpate data generate runs/twin  or, small: palpate data generate runs/small"
    " --points 1 --indenter sphere_medium --edge-mm 1.0",
)
def data_generate(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Where all is written; an interrupted run is continued."
        ),
    ],
    points: Annotated[
        int | None, typer.Option(min=1, help="Points for each indenter [default: 10].")
    ] = None,
    angled: Annotated[
        int | None, typer.Option(min=0, max=4, help="Angled paths at each [default: 4].")
    ] = None,
    random: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Instead: so many presses at random points, tilted by up to 40 degrees; some "
            "slide or twist; spheres and cylinders of sizes between the nine's, too.",
        ),
    ] = None,
    fingertips: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="--random: so many fingertips, each with a skin, fill and friction of its own, a "
            "share of the presses and of the specimens, and a folder in FOLDER.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of points, registration and noise.")] = 0,
    registration_seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Of the registration alone: more presses by the robots of another experiment.",
        ),
    ] = None,
    exact_labels: Annotated[
        bool,
        typer.Option(
            "--exact-labels",
            help="Contact locations are where the tip was, not where a robot with a registration "
            "error believes it.",
        ),
    ] = False,
    indenter: IndenterOption = None,
    units: UnitsOption = None,
    units_each: Annotated[
        int, typer.Option(min=0, help="Specimens that execute each trajectory; 0 = all.")
    ] = 0,
    path: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SEGMENTS",
            help="Also at each point: 'press 1.5 mm, slide 1 mm towards +y, unload', as in "
            "palpate fem run --path; may be repeated.",
        ),
    ] = None,
    edge_mm: Annotated[float, typer.Option(help="Edge of the mesh on the pad [mm].")] = 0.6,
    layers: Annotated[int, typer.Option(min=1, help="Elements through the skin.")] = 2,
    strain_stiffening: Annotated[
        float | None,
        typer.Option(
            help="Yeoh's 3 C3 / C1 of the skin, as silicone has it: 0.004 and more; with it "
            "most of the deepest pinches hold [default: neo-Hooke]."
        ),
    ] = None,
    fill_ml: Annotated[
        float | None, typer.Option(help="Fluid under the skin [ml] [default: 0.6].")
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Processes; 0 = one for each core.")
    ] = 0,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Work on a Ray cluster's CPUs: HOST:PORT, auto or local."
        ),
    ] = None,
    device: Annotated[
        list[str] | None,
        typer.Option(
            "--device",
            metavar="NAME",
            help="Solve many trajectories at once on this device: cuda:0, ..., or cpu; repeatable. "
            "With --fingertips each presses a fingertip of its own; with --ray: "
            "cuda = on each GPU of the cluster.",
        ),
    ] = None,
    slots: Annotated[
        int | None,
        typer.Option(min=1, help="--device: trajectories at once [default: 128], 0.22 GB each."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Press indenters on simulated BioTacs; write both of the paper's data sets.

    As the paper does: nine indenters at ten points of three specimens. Or at random, on one
    fingertip or on several.
    """
    from palpate_deploy.experiment import (
        FemSimulator,
        fingertip_settings,
        read_specimens,
        with_indenters_met,
    )
    from palpate_fem.cli.model import workers_for
    from palpate_fem.cli.terminal import progress_bar, stop_on_signal
    from palpate_fem.config import LIMITS
    from palpate_fem.indenter.catalogue import make_indenter
    from palpate_fem.indenter.path import parse_segments, show_segments
    from palpate_fem.population.fingertips import draw_fingertips
    from palpate_fem.service.device_process import check_places
    from palpate_training.experiment.generate.fingertips import (
        FingertipShare,
        SharedExperiment,
        share_out,
    )
    from palpate_training.experiment.generate.pipeline import MIXED
    from palpate_training.experiment.generate.simulator import FLUID_VOLUME_M3, ExperimentSpec

    check_places(device or (), slots, ray)
    fill_m3 = FLUID_VOLUME_M3 if fill_ml is None else fill_ml * 1e-6
    low, high = LIMITS["fluid_volume_m3"]
    if not low < fill_m3 <= high:
        raise typer.BadParameter(f"{fill_ml} ml is not within {low * 1e6:g} to {high * 1e6:g}")
    if random and (points is not None or angled is not None or path):
        raise typer.BadParameter("--random has no --points, --angled or --path")
    if fingertips and (not random or fill_ml is not None):
        raise typer.BadParameter("--fingertips needs --random, and has no --fill-ml")
    specimens = read_specimens(units)
    if units_each > len(specimens):
        raise typer.BadParameter(f"--units-each {units_each}: there are {len(specimens)} specimens")
    spec = ExperimentSpec(
        points=10 if points is None else points,
        angled=4 if angled is None else angled,
        presses=random or 0,
        units_each=units_each,
        seed=seed,
        registration_seed=registration_seed,
        exact_labels=exact_labels,
        edge_m=edge_mm * 1e-3,
        layers=layers,
        strain_stiffening=strain_stiffening,
        fluid_volume_m3=fill_m3,
        indenters=tuple(make_indenter(name).name for name in indenter or ()),
        paths=tuple(show_segments(parse_segments(words)) for words in path or ()),
    )
    shares: Sequence[FingertipShare] = [FingertipShare("", spec, specimens)]
    if fingertips:
        drawn = [fingertip_settings(tip) for tip in draw_fingertips(fingertips, seed)]
        shares = share_out(spec, drawn, specimens)
    shares = [
        replace(share, spec=with_indenters_met(share.spec, share.specimens)) for share in shares
    ]
    count, threads = workers_for(workers)
    experiment = SharedExperiment(
        out,
        FemSimulator(),
        _generated_summary,
        workers=count,
        threads=threads,
        ray=ray,
        devices=tuple(device or ()),
        slots=slots,
        command=typed_command(),
    )
    found: dict[str, dict[str, Any]] = {}
    with stop_on_signal() as stop, progress_bar() as bar:
        stages = _Stages(bar)
        for share, summary in experiment.made(shares, stop, stages.show):
            stages.end(share.name)
            before = {"folder": str(out / share.name), "finished": "before"}
            found[share.name] = before if summary is None else summary
            if summary is not None and not as_json:
                _show_generated(summary)
            elif not as_json:
                typer.echo(f"{out / share.name}: was finished before")
    if len(found) < len(shares):
        typer.echo(f"stopped; {out} keeps what is done: run the command again to go on", err=True)
        raise typer.Exit(1)
    summaries = [found[share.name] for share in shares]
    if as_json:
        typer.echo(json.dumps(summaries if fingertips else summaries[0], indent=1))
    elif fingertips:
        typer.echo(
            f"{fingertips} fingertips; their rows together: palpate data features"
            f" {out}/fingertip-*/{MIXED} features.h5"
        )


class _Stages:
    """Shows each stage of experiments that are being made in a progress bar."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._tasks: dict[tuple[str, str], TaskID] = {}

    def show(self, name: str, stage: str, done: int, total: int, word: str) -> None:
        """Show the progress of a stage of the experiment with that name."""
        if (name, stage) not in self._tasks:
            self._tasks[name, stage] = self._bar.add_task(f"{name} {stage}".strip(), total=total)
        self._bar.update(self._tasks[name, stage], completed=done, total=total, info=word)

    def end(self, name: str) -> None:
        """Take the stages of an experiment away."""
        for key in [key for key in self._tasks if key[0] == name]:
            self._bar.remove_task(self._tasks.pop(key))


@twin_app.command(
    "sample", epilog="Example: palpate data sample runs/twin --dataset sample.h5 --tape twin.npz"
)
def data_sample(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A finished experiment.")],
    dataset: Annotated[Path, typer.Option("--dataset", metavar="FILE.h5", help="To write.")],
    tape: Annotated[Path, typer.Option("--tape", metavar="FILE.npz", help="To write.")],
    rest: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Takes both data sets without what the tape plays."),
    ] = None,
    units: UnitsOption = None,
) -> None:
    """Take a small part of an experiment: a data set for tests, a tape for the virtual finger."""
    from palpate_deploy.experiment import FemSimulator, read_specimens
    from palpate_training.experiment.generate.sample import make_sample

    trajectories, trials = make_sample(
        folder, read_specimens(units), FemSimulator(), dataset, tape, rest
    )
    sizes = [path.stat().st_size / 1e6 for path in (dataset, tape)]
    typer.echo(
        f"{len(trajectories)} trajectories; {dataset}: {trials} trials,"
        f" {sizes[0]:.2f} MB; {tape}: {sizes[1]:.2f} MB"
    )


def _generated_summary(result: GeneratedExperiment) -> dict[str, Any]:
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
        "field_loss_mean_um": mixed.basis.loss_mean * 1e6,
        "field_loss_max_um": mixed.basis.loss_max * 1e6,
        "dropped": [list(pair) for pair in result.data.dropped],
        "seconds": {name: round(value, 1) for name, value in result.seconds.items()},
        "megabytes": {name: round(value / 1e6, 1) for name, value in result.bytes.items()},
    }


def _show_generated(summary: dict[str, Any]) -> None:
    for key, value in summary.items():
        if key != "dropped":
            typer.echo(f"{key:20} {value}")
    dropped = summary["dropped"]
    typer.echo(f"{'left out':20} {len(dropped)} trials of one or both data sets")
    show_left_out(dropped)
    typer.echo(f"look at it: palpate data inspect {summary['folder']}/mixed.h5")


@contextlib.contextmanager
def _progress(what: str) -> Iterator[OnProgress]:
    """A progress bar of one task."""
    from palpate_fem.cli.terminal import progress_bar

    with progress_bar() as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total, word: bar.update(task, completed=done, total=total, info=word)


@twin_app.command(
    "plan",
    epilog="Example: palpate data plan plan.jsonl --store runs/twin/mechanics.sim --registration"
    " registration.json --urdf left=left.urdf --urdf right=right.urdf --tip-frame tip",
)
def data_plan(
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
    points: PointsOption = 10,
    angled: AngledOption = 4,
    seed: Annotated[int, typer.Option(min=0, help="Of the points.")] = 0,
    indenter: IndenterOption = None,
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
    from palpate_deploy.experiment import FemSimulator
    from palpate_fem.cli.terminal import console
    from palpate_fem.indenter.catalogue import make_indenter
    from palpate_training.cli.experiment import arms_of, by_arm
    from palpate_training.experiment.generate.planning import bases_of, plan_experiment
    from palpate_training.experiment.generate.simulator import (
        EDGE_M,
        FLUID_VOLUME_M3,
        ExperimentSpec,
    )
    from palpate_training.experiment.registration import read_registrations
    from palpate_training.experiment.trajectory_file import write_trajectories

    if store is not None and (edge_mm is not None or fill_ml is not None):
        raise ConfigError(
            "--store gives the skin, so --edge-mm and --fill-ml cannot be given too",
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
    bases = bases_of(
        arms_of(by_arm(urdf or (), "--urdf"), tip_frame, tool_mm * 1e-3),
        None if registration is None else read_registrations(registration),
    )
    simulator = FemSimulator()
    opened = None if store is None else simulator.open_store(store)
    with console.status("pressurising the fingertip" if opened is None else "reading the store"):
        fingertip = simulator.fingertip(spec) if opened is None else opened.fingertip()
    with _progress("planning") as on_progress:
        found, eliminated = plan_experiment(
            spec, fingertip, bases, simulator, store=opened, on_progress=on_progress
        )
    if not found.motions:
        raise ConfigError(
            f"all {len(eliminated)} trajectories are eliminated; the first: {eliminated[0].reason}",
            remedy="check registration, URDF, --tip-frame and --tool-mm",
        )
    write_trajectories(found, out)
    if as_json:
        typer.echo(json.dumps(_planned_summary(out, found, eliminated), indent=1))
    else:
        _show_planned(out, found, eliminated)


def _planned_summary(
    out: Path, found: RobotPlan, eliminated: list[EliminatedTrajectory]
) -> dict[str, object]:
    return {
        "plan": str(out),
        "trajectories": len(found.motions),
        "arms": dict(Counter(motion.trajectory.arm for motion in found.motions)),
        "joints": all(motion.joints is not None for motion in found.motions),
        "duration_s": float(found.motions[-1].time_s[-1]),
        "eliminated": [[one.trajectory, one.reason] for one in eliminated],
    }


def _show_planned(out: Path, found: RobotPlan, eliminated: list[EliminatedTrajectory]) -> None:
    arms = Counter(motion.trajectory.arm for motion in found.motions)
    who = ", ".join(f"{arm} {count}" for arm, count in sorted(arms.items()))
    hours = found.motions[-1].time_s[-1] / 3600.0
    typer.echo(f"{out}: {len(found.motions)} trajectories ({who}), {hours:.1f} h")
    typer.echo(f"eliminated: {len(eliminated)}")
    show_left_out([(one.trajectory, one.reason) for one in eliminated])


@twin_app.command(
    "process",
    epilog="Example: palpate data process day1.h5 day2.h5 experiment.h5  or: palpate data process"
    " day1.h5 experiment.h5 --mechanics runs/twin/mechanics.sim --mixed mixed.h5",
)
def data_process(
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
    from palpate_deploy.experiment import FemSimulator
    from palpate_training.experiment.generate.measured import process_files

    with _progress("processing") as on_progress:
        done = process_files(
            trials,
            out,
            FemSimulator(),
            mechanics=mechanics,
            mixed=mixed,
            command=typed_command(),
            on_progress=on_progress,
        )
    if as_json:
        typer.echo(json.dumps(_processed_summary(done, out, mixed), indent=1))
    else:
        _show_processed(done, out, mixed)


def _processed_summary(
    done: ProcessedExperiment, out: Path, mixed: Path | None
) -> dict[str, object]:
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
            "field_loss_mean_um": done.mixed.basis.loss_mean * 1e6,
            "unmixed": [list(pair) for pair in done.unmixed],
        }
    return found


def _show_processed(done: ProcessedExperiment, out: Path, mixed: Path | None) -> None:
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
