"""Stage one: the skin. Every planned trajectory is simulated once, into a crash-safe store."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from palpate_deploy.generate.spec import INCREMENT_M, ExperimentSpec
from palpate_deploy.generate.spread import Ray
from palpate_deploy.generate.tasks import MechanicsTask, simulate
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.outline import outline_of
from palpate_fem.service.batch import Batch, BatchReport
from palpate_fem.service.biotac import biotac
from palpate_fem.service.config import DEFAULT_FACTORY
from palpate_fem.service.jobs import Setup
from palpate_fem.service.start import skin_of
from palpate_fem.service.sweep import sweep_into_store
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.files import StoreTakenError
from palpate_fem.store.writer import Place, StoreWriter
from palpate_fem.trajectory import Campaign, PlannedIndentation

STORE = "mechanics.sim"
COMMAND = "palpate data generate"

LIMIT_S = 600.0
"""Longest time for one trajectory [s]; none has needed a third of it."""

OnProgress = Callable[[int, int, str], None]
"""Called with how many are done, of how many, and a word on them."""


def fingertip_of(spec: ExperimentSpec) -> StoredFingertip:
    """The pressurised fingertip of an experiment, made in this process."""
    return biotac(**spec.mesh_options)(spec.parameters, lambda _: None).describe()  # type: ignore[arg-type]


def plans_of(spec: ExperimentSpec, fingertip: StoredFingertip) -> list[PlannedIndentation]:
    """All planned trajectories, first points first: what is there early is a fair sample."""
    names = tuple(make_indenter(name).name for name in spec.indenters) or indenter_names()
    plans = list(
        Campaign(
            skin_of(fingertip),
            names,
            points=spec.points,
            seed=spec.seed,
            angled=spec.angled,
            increment_m=INCREMENT_M,
            overtravel_m=spec.overtravel_m,
        )
    )
    return sorted(plans, key=lambda plan: (*plan.name.split("/")[1:], plan.name))


def simulate_all(
    spec: ExperimentSpec,
    store: Path,
    *,
    workers: int,
    threads: int,
    stop: threading.Event,
    on_progress: OnProgress,
) -> bool:
    """Fill the store on this host; what it holds is not run again.

    Returns:
        Whether all is there; False = told to stop.

    Raises:
        DatasetError: The store is another fingertip's or damaged, or the disk refuses.
        RemoteError: The solver does not start.
    """
    setup = Setup(DEFAULT_FACTORY, spec.mesh_options, spec.parameters, 1)
    batch = Batch(setup, workers=workers, threads=threads, limit_s=LIMIT_S)
    try:
        fingertip = batch.fingertip(stop)
        if fingertip is None:
            return False
        plans = plans_of(spec, fingertip)

        def on_report(report: BatchReport) -> None:
            present = len(plans) - report.total
            on_progress(report.done + present, len(plans), _outcomes(report))

        report, _ = sweep_into_store(
            batch, plans, store, stop=stop, on_report=on_report, command=COMMAND
        )
        return not report.stopped
    finally:
        batch.close()


def simulate_on_cluster(
    spec: ExperimentSpec, store: Path, cluster: Ray, *, on_progress: OnProgress
) -> bool:
    """Fill the store with what the machines of a cluster simulate; this host only writes.

    Raises:
        DatasetError: The store is another fingertip's or damaged, or the disk refuses.
        WorkerLostError: The cluster lost machines again and again.
    """
    fingertip = fingertip_of(spec)
    plans = plans_of(spec, fingertip)
    with StoreWriter(store, fingertip, shared=True, outline=outline_of, command=COMMAND) as writer:
        done = writer.done()
        places: dict[str, Place] = {}

        def claimed() -> Iterator[MechanicsTask]:
            for plan in plans:
                if plan.name in done:
                    continue
                with contextlib.suppress(StoreTakenError):  # another command is at it
                    places[plan.name] = writer.claim(plan.name)
                    yield MechanicsTask(spec, plan.name, plan.indenter, plan.path)

        count = len(done)
        try:
            for task, trajectory in cluster.run(simulate, claimed()):
                with places.pop(task.name) as place:
                    place.write(trajectory)
                count += 1
                on_progress(count, len(plans), trajectory.outcome.value)
        finally:
            for place in places.values():
                place.close()
    return True


def _outcomes(report: BatchReport) -> str:
    return "  ".join(f"{how} {count}" for how, count in sorted(report.outcomes.items()))
