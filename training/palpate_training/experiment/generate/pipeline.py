"""The whole experiment: stages in order, each resumable, none begun before its input is there."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from palpate import __version__
from palpate.cluster import RayCluster, WorkerLostError
from palpate.errors import ConfigError, DatasetError
from palpate.files.atomic import written_whole
from palpate.files.hdf5 import opened
from palpate.process import check_installed
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import write_experiment, write_mixed
from palpate_training.experiment.generate.data_sets import AssembledSets, assemble
from palpate_training.experiment.generate.simulator import (
    ExperimentSpec,
    OnProgress,
    PressedSpecimens,
    Specimen,
    TwinSimulator,
)
from palpate_training.experiment.generate.trials import make_trials
from palpate_training.experiment.generate.workers import WorkerProcesses

EXPERIMENT, MIXED = "experiment.h5", "mixed.h5"
STORE = "mechanics.sim"
TRIALS = "trials"

SPEC = "experiment.json"
SPEC_SCHEMA = "palpate.twin-experiment/1"

IDLE = "idle.npz"
IDLE_RATE_HZ = 100.0
IDLE_LENGTH_S = 180.0
IDLE_SINCE_ON_S = 300.0
"""Age of a sensor when it is looked at [s]: the idle real ones were still warming up."""

MECHANICS = "mechanics"
"""The first stage, which devices can do."""

OnStage = Callable[[str, int, int, str], None]
"""Called with the stage, how many are done, of how many, and a word on them."""


@dataclass(frozen=True, slots=True)
class GeneratedExperiment:
    """What an experiment came to.

    Attributes:
        folder: Where it is.
        data: Both data sets.
        provenance_sha256: Digest of all that decides their rows, hex.
        seconds: Time of each stage in this run [s].
        bytes: Size of each part on the disk.
    """

    folder: Path
    data: AssembledSets
    provenance_sha256: str
    seconds: dict[str, float]
    bytes: dict[str, int]


class _StoppedError(Exception):
    """The data sets were being made when it was asked to stop."""


def generate(
    folder: Path,
    spec: ExperimentSpec,
    specimens: Sequence[Specimen],
    simulator: TwinSimulator,
    *,
    workers: int,
    threads: int = 1,
    ray: str | None = None,
    devices: tuple[str, ...] = (),
    slots: int | None = None,
    stop: threading.Event | None = None,
    on_stage: OnStage = lambda *_: None,
    command: str = "palpate data generate",
) -> GeneratedExperiment | None:
    """Run an experiment, or go on with it.

    Killed at any time, it goes on where it was: trajectories and trials are files of their own that
    appear whole.

    Args:
        folder: Takes everything; made if it is not there.
        spec: The experiment.
        specimens: Simulated BioTacs that are pressed.
        simulator: Simulates skin and electrodes.
        workers: Processes.
        threads: Threads of each solver.
        ray: Address of a Ray cluster that works instead of this host's processes.
        devices: Devices of this host, or of the cluster, that solve the trajectories.
        slots: Trajectories at once on each device; None = as many as the simulator thinks best.
        stop: Set it to end early.
        on_stage: Called with the progress of each stage.
        command: For provenance.

    Returns:
        What came out; None = stopped.

    Raises:
        ConfigError: The folder holds another experiment, or there are no such devices.
        LinkError: No cluster answers.
        DatasetError: What is there is damaged, or the disk refuses.
        SimulationError: Trajectories failed; run again, it goes on.
        MissingExtraError: The training extra is not installed.
    """
    for module in ("pinocchio", "threadpoolctl"):  # of trials; told before hours of mechanics
        check_installed(module, extra="training")
    stop = stop or threading.Event()
    seconds: dict[str, float] = {}
    claimed = False
    cluster = RayCluster(ray) if ray is not None else None
    processes = WorkerProcesses(workers)
    try:
        claimed = keep_spec(folder, spec, specimens)
        began = time.monotonic()
        path = folder / STORE
        complete = simulator.simulate(
            spec,
            path,
            workers=workers,
            threads=threads,
            stop=stop,
            on_progress=partial(on_stage, MECHANICS),
            devices=devices,
            slots=slots,
            cluster=cluster,
        )
        seconds[MECHANICS] = time.monotonic() - began
        if not complete:
            return None
        store = simulator.open_store(path)
        began = time.monotonic()
        complete = make_trials(
            spec,
            store,
            specimens,
            simulator,
            folder / TRIALS,
            processes if cluster is None else cluster,
            on_progress=partial(on_stage, "trials"),
            stop=stop,
        )
        if not complete:
            return None
        seconds["trials"] = time.monotonic() - began
        began = time.monotonic()

        def on_progress(done: int, total: int, word: str) -> None:
            if stop.is_set():
                raise _StoppedError
            on_stage("data sets", done, total, word)

        data, digest = _assemble(
            folder, spec, specimens, simulator, processes, on_progress, command
        )
    except _StoppedError:
        return None
    except WorkerLostError:
        if not stop.is_set():
            raise
        return None  # a signal to the whole group ended workers, too
    finally:
        # Settings with which no fingertip comes about would refuse those that are put right.
        if claimed and not (folder / STORE).exists():
            (folder / SPEC).unlink(missing_ok=True)
        processes.close()
        if cluster is not None:
            cluster.close()
    if not is_zipfile(folder / IDLE):  # not there, or cut off
        pressed = simulator.make_specimens(store.fingertip(), specimens)()
        write_idle(folder, specimens, pressed, seed=spec.seed)
    write_experiment(folder / EXPERIMENT, data.experiment)
    write_mixed(folder / MIXED, data.mixed)
    seconds["data sets"] = time.monotonic() - began
    return GeneratedExperiment(folder, data, digest, seconds, _sizes(folder))


def _assemble(
    folder: Path,
    spec: ExperimentSpec,
    specimens: Sequence[Specimen],
    simulator: TwinSimulator,
    processes: WorkerProcesses,
    on_progress: OnProgress,
    command: str,
) -> tuple[AssembledSets, str]:
    """Both data sets, and the digest of all that decides their rows."""
    store = simulator.open_store(folder / STORE)
    digest = provenance_sha256(spec, specimens, store.fingertip().key)
    provenance = Provenance(
        source=f"twin: {spec.presses} presses at random"
        if spec.presses
        else f"twin: {spec.points} points x {1 + spec.angled + len(spec.paths)} trajectories an "
        "indenter",
        command=command,
        input_sha256=digest,
        licence="generated; use as you like",
        palpate_version=__version__,
        notes="input_sha256 is the digest of experiment, units and fingertip",
    )
    names = tuple(specimen.name for specimen in specimens)
    data = assemble(
        store,
        folder / TRIALS,
        names,
        provenance,
        clearance_m=simulator.clearance_m,
        on_progress=on_progress,
        open_store=simulator.open_store,
        runner=processes,
    )
    return data, digest


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of the store, of the trials and of each data set."""
    return {
        name: sum(file.stat().st_size for file in _files(folder / name))
        for name in (STORE, TRIALS, EXPERIMENT, MIXED)
    }


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]


def provenance_sha256(spec: ExperimentSpec, specimens: Sequence[Specimen], fingertip: str) -> str:
    """Digest, hex, of all that decides the rows: spec, specimens and the fingertip's own digest."""
    content = {
        "spec": spec.content(),
        "members": [specimen.content for specimen in specimens],
        "fingertip": fingertip,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def keep_spec(folder: Path, spec: ExperimentSpec, specimens: Sequence[Specimen]) -> bool:
    """Write the settings into the experiment's folder, or compare them with those that are there.

    Returns:
        Whether they were written.

    Raises:
        ConfigError: The folder holds another experiment, says what differs; or its settings are
            damaged.
        DatasetError: The disk refuses.
    """
    wanted: dict[str, Any] = {
        "schema": SPEC_SCHEMA,
        "spec": spec.content(),
        "members": [specimen.content for specimen in specimens],
    }
    wanted = json.loads(json.dumps(wanted))  # tuples become lists, as in the file
    path = folder / SPEC
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError("it holds no settings")
    except (FileNotFoundError, NotADirectoryError):
        with written_whole(path) as part:
            part.write_text(json.dumps(wanted, indent=1) + "\n", encoding="utf-8")
        return True
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="check the folder's rights, or name another",
        ) from error
    except ValueError as error:
        raise ConfigError(
            f"{path}: {error}", remedy="name another folder, or remove the damaged file"
        ) from error
    differs = [key for key in wanted if found.get(key) != wanted[key]]
    if "spec" in differs:
        theirs, mine = found.get("spec") or {}, wanted["spec"]
        differs = [
            f"{key} {mine.get(key)} is not {theirs.get(key)}"
            for key in sorted(mine.keys() | theirs.keys())
            if mine.get(key) != theirs.get(key)
        ]
    if differs:
        raise ConfigError(
            f"{folder} holds another experiment: {'; '.join(differs)}",
            remedy="go on with the options it was begun with, or name another folder",
        )
    return False


def is_finished(folder: Path, spec: ExperimentSpec, specimens: Sequence[Specimen]) -> bool:
    """Whether a folder holds the data sets of this experiment.

    Raises:
        ConfigError: The folder holds another experiment.
        DatasetError: One of the data sets is damaged.
    """
    if not (folder / SPEC).exists():
        return False
    keep_spec(folder, spec, specimens)
    there = [path for name in (EXPERIMENT, MIXED) if (path := folder / name).exists()]
    for path in there:
        try:
            with opened(path, extra="training"):  # to read all of a large set takes minutes
                pass
        except DatasetError as error:
            raise DatasetError(
                f"a data set is damaged: {error.problem}",
                remedy="remove it and run this again: it is made again from the trials",
            ) from error
    return len(there) == 2


def write_idle(
    folder: Path, specimens: Sequence[Specimen], pressed: PressedSpecimens, *, seed: int
) -> Path:
    """Write ``idle.npz``: ``rate_hz``, and counts (T, 19) of each untouched specimen.

    Their noise and drift are compared with those of real sensors.
    """
    path = folder / IDLE
    time_s = np.arange(0.0, IDLE_LENGTH_S, 1.0 / IDLE_RATE_HZ)
    arrays: dict[str, NDArray[np.generic]] = {"rate_hz": np.array(IDLE_RATE_HZ)}
    for number, specimen in enumerate(specimens):
        rest = pressed.rest_counts[specimen.name]
        warmed = specimen.warming(IDLE_SINCE_ON_S + time_s)
        ideal = np.repeat(rest[None], len(time_s), axis=0)
        stream = specimen.stream(rest, seed + number)
        elapsed_s = np.full(len(time_s), 1.0 / IDLE_RATE_HZ)
        arrays[specimen.name] = stream(ideal, time_s, elapsed_s, warmed - warmed[0])
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return path
