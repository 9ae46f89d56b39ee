"""``palpate fem run``, ``export`` and ``serve``: simulate one indentation, a set, or on request."""

from __future__ import annotations

import hashlib
import json
import math
import statistics
import uuid
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer

from palpate.config import joining_link, parse_config
from palpate.errors import ConfigError
from palpate.files.outputs import check_folder, check_output
from palpate.files.simulation_store import SUFFIX
from palpate.process import stop_on_signals, typed_command
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.result import without_nan
from palpate_fem.calibration.runs import PlannedPath
from palpate_fem.cli.model import FingertipModel, workers_for
from palpate_fem.cli.terminal import console, print_lines, print_table, progress_bar, stop_on_signal
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.outline import outline_of
from palpate_fem.indenter.path import POSES_MOST, parse_segments, read_path
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.batch import (
    FAILED,
    BatchReport,
    TrajectoryPlan,
    sweep_into_store,
)
from palpate_fem.service.device_process import check_places, wanted_device
from palpate_fem.service.fingertips import check_start, skin_of
from palpate_fem.store.content import StoredFingertip, TrajectorySummary
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import check_free, export
from palpate_fem.trajectory import (
    Campaign,
    angled_direction,
    pad_point,
    points_first,
    press_path,
    segment_path,
)

DEFAULT_INDENTER = "sphere_medium"
GOOD = ("complete", "force limit")
"""Outcomes that answer the question: to the end, or to where the skin is pinched on the core."""

EXPORT_SUFFIX = ".h5"
_ROUTER_WAIT_S = 5.0
_NAME_THE_DEVICE = "name the device, e.g. --device cuda:0"
_COLUMNS = (
    "pose", "force", "torque", "centre_of_pressure", "fluid_pressure_pa", "contact_area_m2",
)  # fmt: skip
_SHOWN_EARLY = 40


_PRESS = "a single press"
_OF_WAYS = {
    "depth_mm": (_PRESS,),
    "angle_deg": (_PRESS,),
    "azimuth_deg": (_PRESS,),
    "at_mm": (_PRESS, "--path"),
    "steps": (_PRESS, "--sweep"),
    "step_mm": ("--path",),
    "points": ("--sweep",),
    "angled": ("--sweep",),
    "seed": ("--sweep",),
}
"""What each option is for, by the name of the command's parameter."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of ``palpate fem run``, in SI, with the names that they have there.

    ``given``: names of the command's parameters that were given, not left at their defaults.
    """

    indenters: tuple[str, ...]
    depth_m: float
    at_m: tuple[float, float]
    angle_deg: float
    azimuth_deg: float
    steps: int
    path: str | None
    step_m: float
    poses: Path | None
    sweep: bool
    points: int
    angled: int
    seed: int
    store: Path | None
    stress: bool
    png: Path | None
    limit_s: float
    as_json: bool
    devices: tuple[str, ...] = ()
    slots: int | None = None
    ray: str | None = None
    given: frozenset[str] = frozenset()

    def check(self) -> None:
        """Refuse what can be refused before a fingertip is built.

        Raises:
            ConfigError: An option makes no sense.
        """
        for name in self.indenters:
            make_indenter(name)
        numbers = {
            "--depth-mm": (self.depth_m * 1e3,),
            "--at-mm": tuple(value * 1e3 for value in self.at_m),
            "--angle-deg": (self.angle_deg,),
            "--azimuth-deg": (self.azimuth_deg,),
            "--step-mm": (self.step_m * 1e3,),
            "--limit-s": (self.limit_s,),
        }
        for name, values in numbers.items():
            if not all(map(math.isfinite, values)):
                given = " ".join(f"{value:g}" for value in values)
                raise ConfigError(f"{name} {given} is not finite", remedy="give finite numbers")
        for name in ("--depth-mm", "--step-mm"):
            (length_mm,) = numbers[name]
            if length_mm <= 0.0:
                raise ConfigError(f"{name} {length_mm:g} is no length", remedy="give more than 0")
        if self.steps >= POSES_MOST:
            raise ConfigError(
                f"--steps {self.steps}: at most {POSES_MOST:,} poses are simulated",
                remedy=f"give 1 to {POSES_MOST - 1}",
            )
        ways = {"--sweep": self.sweep, "--path": self.path, "--poses": self.poses}
        chosen = [name for name, value in ways.items() if value]
        if len(chosen) > 1:
            raise ConfigError(f"{' and '.join(chosen)} exclude each other", remedy="give one")
        way = chosen[0] if chosen else _PRESS
        for name, belongs_to in _OF_WAYS.items():
            if name in self.given and way not in belongs_to:
                raise ConfigError(
                    f"--{name.replace('_', '-')} has no effect with {way}",
                    remedy=f"leave it out; it is for {' and '.join(belongs_to)}",
                )
        if self.stress and self.store is None:
            raise ConfigError(
                "--stress is kept in a store, which is not given",
                remedy="add --store NAME.sim, or leave --stress out",
            )
        if self.sweep and self.store is None:
            raise ConfigError(
                "a sweep takes long and its results must be stored", remedy="give --store NAME.sim"
            )
        places = {"--device": self.devices, "--slots": self.slots, "--ray": self.ray}
        for name, value in places.items():
            if value and not self.sweep:
                raise ConfigError(
                    f"{name} without --sweep: it pays for many trajectories only",
                    remedy="add --sweep, or leave it out",
                )
        check_places(self.devices, self.slots, self.ray)
        check_output(self.png, "--png", ".png")
        if self.store is not None and self.store.suffix != SUFFIX:
            raise ConfigError(
                f"--store {self.store} does not end in {SUFFIX}",
                remedy=f"call it {self.store.stem}{SUFFIX}",
            )
        if self.store is not None:
            check_folder(self.store, "--store")
        if not self.sweep and len(self.indenters) > 1:
            raise ConfigError(
                "several indenters without --sweep", remedy="add --sweep, or name one"
            )
        if not 0.0 <= self.angle_deg < 90.0:
            raise ConfigError(
                f"--angle-deg {self.angle_deg:g} does not lead into the skin",
                remedy="give 0 to 89 degrees to the inward normal",
            )
        if self.path is not None:
            if Path(self.path).suffix in (".csv", ".json", ".npz"):
                raise ConfigError(
                    f"--path {self.path} is a file", remedy="give a file of poses as --poses"
                )
            parse_segments(self.path)
        if self.poses is not None:
            read_path(self.poses)

    @property
    def places(self) -> tuple[str, ...]:
        """Where many trajectories are solved, for the summary; empty = in processes of the CPU."""
        if self.ray is None:
            return self.devices
        return (f"the {'GPUs' if 'cuda' in self.devices else 'CPUs'} of the Ray cluster",)

    @property
    def swept(self) -> tuple[str, ...]:
        """The indenters of a sweep, each once, as one may have several names."""
        named = dict.fromkeys(make_indenter(name).name for name in self.indenters)
        return tuple(named) or indenter_names()

    def plans(self, fingertip: StoredFingertip) -> Sequence[TrajectoryPlan]:
        """The trajectories to run on a fingertip."""
        skin = skin_of(fingertip)
        if self.sweep:
            return points_first(
                Campaign(skin, self.swept, self.points, self.seed, self.steps, angled=self.angled)
            )
        indenter = make_indenter((self.indenters or (DEFAULT_INDENTER,))[0])
        if self.poses is not None:
            path = read_path(self.poses)
            check_start(fingertip, indenter.name, path[0])
            return [_named("poses", indenter.name, path)]
        target, normal = pad_point(skin, *self.at_m)
        if self.path is not None:
            segments = parse_segments(self.path)
            path = segment_path(indenter, target, normal, segments, skin, step_m=self.step_m)
        else:
            direction = angled_direction(
                normal, math.radians(self.angle_deg), math.radians(self.azimuth_deg)
            )
            path = press_path(
                indenter, target, direction, skin, depth_m=self.depth_m, steps=self.steps
            )
        return [_named("press" if self.path is None else "path", indenter.name, path)]


def _named(kind: str, indenter: str, path: Floats) -> PlannedPath:
    """A path with a name of its own, so that a store runs it once."""
    digest = hashlib.sha256(path.tobytes()).hexdigest()[:10]
    return PlannedPath(f"{indenter}/{kind}-{digest}", indenter, path)


def run_command(options: RunOptions, model: FingertipModel, *, workers: int) -> int:
    """Run, show, draw.

    Returns:
        0, or 1 if a trajectory, of those that were there already, too, neither completed nor ended
        at the force limit, or is run by another process.
    """
    options.check()
    sweep, store = options.sweep, options.store
    make_batch, packers = model.batch(
        workers,
        jobs=None if sweep else 1,
        limit_s=options.limit_s,
        indenters=options.swept,
        devices=options.devices,
        slots=options.slots,
        ray=options.ray,
    )
    done: list[IndentationResult] = []
    held: list[TrajectorySummary] = []
    present = earlier = elsewhere = 0
    with (
        stop_on_signal() as stop,
        make_batch() as batch,
        progress_bar() as bar,
    ):
        task = bar.add_task("pressurise", total=None)
        fingertip = batch.fingertip(stop)
        if fingertip is None:
            if options.as_json:
                stopped = BatchReport(0, stopped=True)
                write_json(None, [], stopped, 0, options.places, elsewhere=0)
            return 1
        bar.update(task, description="plan")
        plans = options.plans(fingertip)
        total = len(plans) if sweep else len(plans[0].path) - 1
        bar.update(task, description="simulate", total=total, completed=0)

        def on_report(report: BatchReport) -> None:
            steps = report.done if sweep else sum(report.running.values())
            if not sweep and report.done:  # it does not run any more
                steps = total
            bar.update(task, completed=steps + present, info=_outcomes(report))

        if store is None:
            report = batch.run(
                plans,
                len(plans),
                stop=stop,
                on_trajectory=lambda _, trajectory: done.append(trajectory),
                on_report=on_report,
            )
        else:
            report, present = sweep_into_store(
                batch,
                plans,
                store,
                stop=stop,
                on_report=on_report,
                stress=options.stress,
                command=typed_command(),
                packers=packers,
            )
    if store is not None:
        opened = SimulationStore.open(store)
        there = set(opened.ids())
        held = [opened.summary(plan.name) for plan in plans if plan.name in there]
        new = {early.name for early in report.early}
        earlier = sum(one.outcome.value not in GOOD for one in held if one.id not in new)
        if not report.stopped:
            elsewhere = sum(plan.name not in there | new for plan in plans)
        if not sweep:
            done = [opened.trajectory(one.id) for one in held]
    if options.as_json:
        told = [_summary_json(one) for one in held] if sweep else [_whole_json(one) for one in done]
        write_json(fingertip, told, report, present, options.places, elsewhere=elsewhere)
    else:
        if sweep:
            show_summaries(held, title=str(store))
        for trajectory in done:
            show_trajectory(fingertip, trajectory)
        show_report(report, present, store, options.places, earlier=earlier, elsewhere=elsewhere)
    if options.png is not None:
        _draw(options.png, fingertip, done, store if sweep else None)
    failed = earlier or elsewhere or any(early.how not in GOOD for early in report.early)
    return 1 if report.stopped or failed else 0


def export_command(store: Path, out: Path) -> None:
    """Check a store against its checksums, copy it into one file and print what is in it."""
    if out.suffix != EXPORT_SUFFIX:
        raise ConfigError(
            f"{out} does not end in {EXPORT_SUFFIX}", remedy=f"call it {out.stem}{EXPORT_SUFFIX}"
        )
    check_free(out)  # before the store is checked, which takes long
    opened = SimulationStore.open(store)
    with progress_bar() as bar:
        task = bar.add_task("check", total=None)
        # Copying would take damaged bytes over unnoticed, and the receiver could not repair them.
        opened.fingertip()
        opened.check()
        bar.update(task, description="copy")
        count = export(
            opened,
            out,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            command=typed_command(),
        )
    print_lines(f"{out}: {count} trajectories, {out.stat().st_size / 1e6:.1f} MB")


def serve_command(
    model: FingertipModel,
    *,
    connect: str,
    tls: Path | None,
    station: str,
    sensor: str,
    workers: int,
    device: str | None,
    slots: int | None,
    waiting: int,
    max_deadline_s: float,
) -> None:
    """Serve until ``SIGINT`` or ``SIGTERM``.

    Raises:
        ConfigError: An option makes no sense, or there is no such device.
    """
    # Only this command needs the bus.
    from palpate_fem.service import node
    from palpate_fem.service.config import WORKERS_MOST, FemConfig

    if slots is not None and device is None:
        raise ConfigError("--slots without --device", remedy=_NAME_THE_DEVICE)
    device = wanted_device(device)
    count = workers or min(workers_for(0)[0], WORKERS_MOST)
    config = parse_config(
        FemConfig,
        {
            "sensor": sensor,
            "workers": count,
            "device": device,
            **({} if slots is None else {"slots": slots}),
            "waiting": waiting,
            "max_deadline_s": max_deadline_s,
            "factory": model.factory,
            "options": dict(model.options),
            "fingertip": asdict(model.parameters),
        },
        where="command line",
    )
    link = joining_link(connect, wait_s=_ROUTER_WAIT_S, tls=tls)
    stop = stop_on_signals()
    print_lines(
        f"fem serves {sensor!r} at station {station!r} through {connect}: {count} workers, "
        + (f"{config.slots} slots on {device}, " if device else "")
        + f"{waiting} may wait",
        "it says when it is ready; Ctrl-C stops it",
        to=console,
    )
    node.run(
        config,
        link,
        station,
        stop,
        # Callers choose a service by this name, so no other at the station may have it.
        instance=f"{node.SERVICE}-{uuid.uuid4().hex[:8]}",
        on_ready=lambda: print_lines("ready for requests", to=console),
        on_refusal=lambda refusal: print_lines(f"does not serve: {refusal}", to=console),
    )


def show_trajectory(fingertip: StoredFingertip, trajectory: IndentationResult) -> None:
    """Print the steps of a trajectory, one in a row."""
    ending = trajectory.outcome.value + (f": {trajectory.reason}" if trajectory.reason else "")
    places = np.array([trajectory.path[0], *(step.pose for step in trajectory.steps)])
    travel = path_lengths(places)[1:] * 1e3
    print_table(
        ("step", "travel mm", "|F| N", "Fx", "Fy", "Fz", "p kPa", "area mm²", "iterations"),
        [
            (
                str(number + 1),
                f"{travel[number]:.3f}",
                f"{np.linalg.norm(step.force):.3f}",
                *(f"{component:.3f}" for component in step.force),
                f"{step.fluid_pressure_pa / 1e3:.2f}",
                f"{step.contact_area_m2 * 1e6:.2f}",
                str(step.convergence.iterations),
            )
            for number, step in enumerate(trajectory.steps)
        ],
        title=f"{trajectory.indenter}: {ending}",
        caption=f"{len(fingertip.mesh.nodes):,} nodes, "
        f"fluid {fingertip.fluid_pressure_pa / 1e3:.1f} kPa, "
        f"{fingertip.total_thickness_m * 1e3:.2f} mm thick; {trajectory.seconds:.1f} s",
        numbers_from=0,
    )


def show_summaries(summaries: Sequence[TrajectorySummary], *, title: str) -> None:
    """Print trajectories, one row for each indenter."""
    groups: dict[str, list[TrajectorySummary]] = defaultdict(list)
    for summary in summaries:
        groups[summary.indenter].append(summary)
    rows = []
    for indenter, found in groups.items():
        complete, limit = (
            sum(summary.outcome is how for summary in found)
            for how in (IndentationOutcome.COMPLETE, IndentationOutcome.FORCE_LIMIT)
        )
        peaks = [np.linalg.norm(s.force, axis=1).max() for s in found if len(s.force)]
        rows.append(
            (
                indenter,
                str(len(found)),
                str(complete),
                str(limit),
                str(len(found) - complete - limit),
                f"{min(peaks):.2f} - {max(peaks):.2f}" if peaks else "",
                f"{statistics.median(summary.seconds for summary in found):.1f}",
            )
        )
    headings = ("indenter", "run", "complete", "force limit", "other", "peak |F| N", "s each")
    print_table(headings, rows, title=title, numbers_from=1)


def show_report(
    report: BatchReport,
    present: int,
    store: Path | None,
    places: Sequence[str] = (),
    *,
    earlier: int = 0,
    elsewhere: int = 0,
) -> None:
    """Print every early end, and a summary; with places also how quick these were.

    Of the ``present`` ones, ``earlier`` ended otherwise than in ``GOOD``; ``elsewhere`` were
    claimed by another process.
    """
    if report.early:
        more = len(report.early) - _SHOWN_EARLY
        print_table(
            ("trajectory", "how", "steps", "why"),
            [
                (early.name, early.how, f"{early.steps} of {early.steps_total}", early.reason)
                for early in report.early[:_SHOWN_EARLY]
            ],
            title="did not complete",
            caption=f"and {more} more" if more > 0 else "",
        )
    outcomes = ", ".join(f"{count} {how}" for how, count in sorted(report.outcomes.items()))
    parts = [f"{report.done} of {report.total} run" + (f": {outcomes}" if outcomes else "")]
    if present:
        parts.append(
            f"{present} were there already"
            + (f", of which {earlier} did not complete" if earlier else "")
        )
    if places and report.done:
        each_ms = report.wall_s / report.done * 1e3
        parts.append(f"{each_ms:.0f} ms a trajectory on {', '.join(places)}")
    if report.on_cpu:
        parts.append(f"{report.on_cpu} of them on the CPU, as the device did not solve them")
    if report.stopped:
        parts.append("stopped early; the same command goes on" if store else "stopped early")
    if report.failed and store:
        parts.append(f"{report.failed} {FAILED}: the same command tries them again")
    if elsewhere:
        parts.append(
            f"{elsewhere} run by another process, or lost with it: the same command goes on"
        )
    print_lines("; ".join(parts))


def write_json(
    fingertip: StoredFingertip | None,
    trajectories: Sequence[Mapping[str, Any]],
    report: BatchReport,
    present: int,
    places: Sequence[str],
    *,
    elsewhere: int,
) -> None:
    """Print everything except nodal fields as JSON on stdout; a fingertip as null if none is."""
    content = {
        "fingertip": None
        if fingertip is None
        else {
            "mesh": fingertip.mesh.name,
            "mesh_sha256": fingertip.mesh.sha256.hex(),
            "nodes": len(fingertip.mesh.nodes),
            "parameters": asdict(fingertip.parameters),
            "fluid_pressure_pa": fingertip.fluid_pressure_pa,
            "fluid_volume_m3": fingertip.fluid_volume_m3,
            "total_thickness_m": fingertip.total_thickness_m,
        },
        "outcomes": dict(report.outcomes),
        "present": present,
        "elsewhere": elsewhere,
        "stopped": report.stopped,
        "devices": list(places),
        "on_cpu": report.on_cpu,
        "wall_s": report.wall_s,
        "early": [asdict(early) for early in report.early],
        "trajectories": list(trajectories),
    }
    typer.echo(json.dumps(content, indent=1, allow_nan=False))


def _whole_json(trajectory: IndentationResult) -> dict[str, Any]:
    """A trajectory with its steps."""
    return {
        **_ending_json(trajectory),
        "steps": [_step_json(step) for step in trajectory.steps],
    }


def _summary_json(summary: TrajectorySummary) -> dict[str, Any]:
    """A trajectory of a sweep, which may have hundreds."""
    force = np.linalg.norm(summary.force, axis=1)
    return {
        "name": summary.id,
        **_ending_json(summary),
        "steps_converged": len(force),
        "steps_total": len(summary.path) - 1,
        "peak_force_n": float(force.max(initial=0.0)),
    }


def _ending_json(trajectory: IndentationResult | TrajectorySummary) -> dict[str, Any]:
    return {
        "indenter": trajectory.indenter,
        "outcome": trajectory.outcome.value,
        "reason": trajectory.reason,
        "travel_m": trajectory.travel_m,
        "seconds": trajectory.seconds,
    }


def _step_json(step: IndentationStep) -> Any:
    """A step without its fields."""
    values = {name: getattr(step, name) for name in _COLUMNS}
    return without_nan({**values, "convergence": asdict(step.convergence)})


def _draw(
    png: Path, fingertip: StoredFingertip, done: Sequence[IndentationResult], store: Path | None
) -> None:
    """Draw a whole store, or the last step of one trajectory."""
    if store is not None:
        from palpate_fem.plot.trajectories import plot_overview

        opened = SimulationStore.open(store)
        plot_overview([opened.summary(name) for name in opened.ids()], png, title=store.name)
    elif done and done[0].steps:
        from palpate_fem.plot.step import plot_step

        step, outline = telling_step(done[0].forces), outline_of(done[0].indenter)
        plot_step(fingertip, done[0], png, step=step, indenter=outline)
    else:
        print_lines(f"{png} is not drawn: no step converged", to=console)
        return
    print_lines(f"drew {png}", to=console)


def telling_step(forces: Floats) -> int:
    """The step to draw: the last, or where it pressed hardest if it ends off the skin.

    Args:
        forces: Net force of each step [N], shape (K, 3).
    """
    force = np.linalg.norm(forces, axis=1)
    return len(force) - 1 if force[-1] > 0.0 else int(force.argmax())


def _outcomes(report: BatchReport) -> str:
    """Number of trajectories by outcome, for the progress bar."""
    return "  ".join(f"{how} {count}" for how, count in sorted(report.outcomes.items()))
