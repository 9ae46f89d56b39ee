"""The whole experiment: stages in order, each resumable, none begun before its input is there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate_deploy.generate.assemble import Assembled, assemble
from palpate_deploy.generate.idle import write_idle
from palpate_deploy.generate.mechanics import STORE, simulate_all, simulate_on_cluster
from palpate_deploy.generate.spec import ExperimentSpec, keep_spec, provenance_sha256
from palpate_deploy.generate.spread import Processes, Ray, Spread
from palpate_deploy.generate.trials import FOLDER, make_trials
from palpate_fem.population.member import Member
from palpate_fem.store.read import SimulationStore
from palpate_training.datasets.experiment import write_experiment, write_mixed
from palpate_training.datasets.features import Provenance
from palpate_training.datasets.features_file import palpate_version

EXPERIMENT, MIXED = "experiment.h5", "mixed.h5"

OnStage = Callable[[str, int, int, str], None]
"""Called with the stage, how many are done, of how many, and a word on them."""


@dataclass(frozen=True, slots=True)
class Generated:
    """What an experiment came to.

    Attributes:
        folder: Where it is.
        data: Both data sets.
        provenance_sha256: Digest of all that decides their rows, hex.
        seconds: Time of each stage in this run [s].
        bytes: Size of each part on the disk.
    """

    folder: Path
    data: Assembled
    provenance_sha256: str
    seconds: dict[str, float]
    bytes: dict[str, int]


def generate(
    folder: Path,
    spec: ExperimentSpec,
    members: Sequence[Member],
    *,
    workers: int,
    threads: int = 1,
    ray: str | None = None,
    stop: threading.Event | None = None,
    on_stage: OnStage = lambda *_: None,
    command: str = "palpate data generate",
) -> Generated | None:
    """Run an experiment, or go on with it.

    Killed at any time, it goes on where it was: trajectories and trials are files of their own that
    appear whole.

    Args:
        folder: Takes everything; made if it is not there.
        spec: The experiment.
        members: Its units.
        workers: Processes.
        threads: Threads of each solver.
        ray: Address of a Ray cluster that works instead of this host's processes.
        stop: Set it to end early.
        on_stage: Hears of all progress.
        command: For provenance.

    Returns:
        What came out; None = told to stop.

    Raises:
        ConfigError: The folder holds another experiment.
        DatasetError: What is there is damaged, or the disk refuses.
    """
    stop = stop or threading.Event()
    keep_spec(folder, spec, members)
    seconds: dict[str, float] = {}
    cluster = Ray(ray) if ray is not None else None
    try:
        began = time.monotonic()
        path = folder / STORE
        if cluster is not None:
            complete = simulate_on_cluster(
                spec, path, cluster, on_progress=_stage("mechanics", on_stage)
            )
        else:
            complete = simulate_all(
                spec,
                path,
                workers=workers,
                threads=threads,
                stop=stop,
                on_progress=_stage("mechanics", on_stage),
            )
        seconds["mechanics"] = time.monotonic() - began
        if not complete:
            return None
        store = SimulationStore.open(path)
        began = time.monotonic()
        spread: Spread = cluster if cluster is not None else Processes(workers)
        try:
            make_trials(
                spec,
                store,
                members,
                folder / FOLDER,
                spread,
                on_progress=_stage("trials", on_stage),
            )
        finally:
            if spread is not cluster:
                spread.close()
        seconds["trials"] = time.monotonic() - began
    finally:
        if cluster is not None:
            cluster.close()
    began = time.monotonic()
    digest = provenance_sha256(spec, members, store.fingertip().key)
    provenance = Provenance(
        source=f"twin: {spec.points} points x {1 + spec.angled} trajectories an indenter",
        command=command,
        input_sha256=digest,
        licence="generated; use as you like",
        palpate_version=palpate_version(),
        notes="input_sha256 is the digest of experiment, units and fingertip",
    )
    names = tuple(member.unit.name for member in members)
    data = assemble(
        store, folder / FOLDER, names, provenance, on_progress=_stage("data sets", on_stage)
    )
    write_idle(folder, store.fingertip(), members, seed=spec.seed)
    write_experiment(folder / EXPERIMENT, data.experiment)
    write_mixed(folder / MIXED, data.mixed)
    seconds["data sets"] = time.monotonic() - began
    return Generated(folder, data, digest, seconds, _sizes(folder))


def _stage(name: str, on_stage: OnStage) -> Callable[[int, int, str], None]:
    return lambda done, total, word: on_stage(name, done, total, word)


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of the store, of the trials and of each data set."""
    return {
        name: sum(file.stat().st_size for file in _files(folder / name))
        for name in (STORE, FOLDER, EXPERIMENT, MIXED)
    }


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
