"""``palpate fem run``: one indentation or the paper's set of them, into a picture or a store."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from palpate.command import typed_command
from palpate.errors import ConfigError
from palpate_fem.cli.model import Model, workers_for
from palpate_fem.cli.show import (
    console,
    progress_bar,
    show_report,
    show_summaries,
    show_trajectory,
    write_json,
)
from palpate_fem.cli.stopping import stop_on_signal
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.path import read_path
from palpate_fem.result import IndentationResult
from palpate_fem.service.batch import Batch, BatchReport, Plan, Press
from palpate_fem.service.start import check_start, skin_of
from palpate_fem.store.content import StoredFingertip
from palpate_fem.trajectory import Campaign, angled_direction, pad_point, press_path

DEFAULT_INDENTER = "sphere_medium"
GOOD = ("complete", "force limit")
"""Outcomes that answer the question: to the end, or to where the skin is pinched on the core."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be run, in SI; the words are those of the command's options."""

    indenters: tuple[str, ...]
    depth_m: float
    at_m: tuple[float, float]
    angle_deg: float
    azimuth_deg: float
    steps: int
    path: Path | None
    sweep: bool
    points: int
    angled: int
    seed: int


def run_command(
    wanted: Wanted,
    model: Model,
    *,
    workers: int,
    limit_s: float,
    store: Path | None,
    stress: bool,
    png: Path | None,
    as_json: bool,
) -> int:
    """Run, show, draw.

    Returns:
        0, or 1 if a trajectory neither completed nor ended at the force limit.

    Raises:
        ConfigError: An option makes no sense.
        PalpateError: The solver does not start, or the store cannot be written.
    """
    _check(wanted, store)
    jobs = None if wanted.sweep else 1
    count, threads = workers_for(workers, jobs)
    done: list[IndentationResult] = []
    with stop_on_signal() as stop, _batch(model, count, threads, limit_s) as batch:
        with progress_bar() as bar:
            task = bar.add_task("pressurise", total=None)
            fingertip = batch.fingertip(stop)
            if fingertip is None:
                return 1
            bar.update(task, description="plan")
            plans = _plans(wanted, fingertip)
            total = len(plans) if wanted.sweep else len(plans[0].path) - 1
            bar.update(task, description="simulate", total=total, completed=0)

            def on_report(report: BatchReport) -> None:
                steps = report.done if wanted.sweep else sum(report.running.values())
                bar.update(task, completed=steps + present, info=_info(report))

            present = 0
            if store is None:
                report = batch.run(
                    plans,
                    len(plans),
                    stop=stop,
                    on_trajectory=lambda _, trajectory: done.append(trajectory),
                    on_report=on_report,
                )
            else:
                from palpate_fem.service.sweep import sweep_into_store

                report, present = sweep_into_store(
                    batch,
                    plans,
                    store,
                    stop=stop,
                    on_report=on_report,
                    stress=stress,
                    command=typed_command(),
                )
    if store is not None and not wanted.sweep:
        done = _from_store(store, plans)
    _show(wanted, fingertip, done, report, plans, store, png=png, as_json=as_json, present=present)
    return 0 if not report.stopped and all(early.how in GOOD for early in report.early) else 1


def _check(wanted: Wanted, store: Path | None) -> None:
    for name in wanted.indenters:
        make_indenter(name)
    if wanted.sweep and wanted.path is not None:
        raise ConfigError("--sweep and --path exclude each other", remedy="leave one out")
    if wanted.sweep and store is None:
        raise ConfigError(
            "a sweep takes long and its results need a place", remedy="give --store NAME.sim"
        )
    if store is not None:
        from palpate.files.simulation_store import SUFFIX

        if store.suffix != SUFFIX:
            raise ConfigError(
                f"--store {store} does not end in {SUFFIX}", remedy=f"call it {store.stem}{SUFFIX}"
            )
    if not wanted.sweep and len(wanted.indenters) > 1:
        raise ConfigError("several indenters without --sweep", remedy="add --sweep, or name one")
    if not 0.0 <= wanted.angle_deg < 90.0:
        raise ConfigError(
            f"--angle-deg {wanted.angle_deg:g} does not lead into the skin",
            remedy="give 0 to 89 degrees to the inward normal",
        )
    if wanted.path is not None:
        read_path(wanted.path)


def _plans(wanted: Wanted, fingertip: StoredFingertip) -> Sequence[Plan]:
    skin = skin_of(fingertip)
    if wanted.sweep:
        names = tuple(make_indenter(name).name for name in wanted.indenters) or indenter_names()
        return list(
            Campaign(skin, names, wanted.points, wanted.seed, wanted.steps, angled=wanted.angled)
        )
    indenter = make_indenter((wanted.indenters or (DEFAULT_INDENTER,))[0])
    if wanted.path is not None:
        path = read_path(wanted.path)
        check_start(fingertip, indenter.name, path[0])
    else:
        target, normal = pad_point(skin, *wanted.at_m)
        direction = angled_direction(
            normal, math.radians(wanted.angle_deg), math.radians(wanted.azimuth_deg)
        )
        path = press_path(
            indenter, target, direction, skin, depth_m=wanted.depth_m, steps=wanted.steps
        )
    digest = hashlib.sha256(path.tobytes()).hexdigest()[:10]
    return [Press(f"{indenter.name}/press-{digest}", indenter.name, path)]


def _show(
    wanted: Wanted,
    fingertip: StoredFingertip,
    done: Sequence[IndentationResult],
    report: BatchReport,
    plans: Sequence[Plan],
    store: Path | None,
    *,
    png: Path | None,
    as_json: bool,
    present: int,
) -> None:
    if as_json:
        write_json(fingertip, done, report, present)
    elif wanted.sweep:
        assert store is not None
        show_summaries(store, [plan.name for plan in plans])
    else:
        for trajectory in done:
            show_trajectory(fingertip, trajectory)
    if not as_json:
        show_report(report, present, store)
    if png is None:
        return
    if wanted.sweep:
        from palpate_fem.plot.step import plot_overview
        from palpate_fem.store.read import SimulationStore

        assert store is not None
        opened = SimulationStore.open(store)
        plot_overview([opened.summary(name) for name in opened.ids()], png, title=store.name)
    elif done and done[0].steps:
        from palpate_fem.indenter.outline import outline_of
        from palpate_fem.plot.step import plot_step

        plot_step(fingertip, done[0], png, indenter=outline_of(done[0].indenter))
    else:
        console.print(f"{png} is not drawn: no step converged")
        return
    console.print(f"drew {png}", soft_wrap=True, markup=False, highlight=False)


def _from_store(store: Path, plans: Sequence[Plan]) -> list[IndentationResult]:
    from palpate_fem.store.read import SimulationStore

    opened = SimulationStore.open(store)
    there = set(opened.ids())
    return [opened.trajectory(plan.name) for plan in plans if plan.name in there]


def _info(report: BatchReport) -> str:
    """What ended how, for the line of the progress bar."""
    return "  ".join(f"{how} {count}" for how, count in sorted(report.outcomes.items()))


@contextmanager
def _batch(model: Model, workers: int, threads: int, limit_s: float) -> Iterator[Batch]:
    batch = Batch(model.setup(), workers=workers, threads=threads, limit_s=limit_s)
    try:
        yield batch
    finally:
        batch.close()
