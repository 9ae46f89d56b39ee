"""A real experiment's trials -> the paper's data sets; the simulation may be anybody's store."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from palpate import __version__
from palpate.errors import ConfigError, DatasetError
from palpate.files.hdf5 import schema_of
from palpate_training.datasets.assembly import assemble_experiment, common_trajectories
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    write_experiment,
    write_mixed,
)
from palpate_training.datasets.processing import process_all
from palpate_training.datasets.trials import (
    TRIALS_SCHEMA,
    RawTrial,
    SimulatedTrial,
    TrialRows,
    read_contents,
    read_trials,
    trial_name,
)
from palpate_training.experiment.executed_plan import OFFSET_M
from palpate_training.experiment.generate.data_sets import join, simulated_trial
from palpate_training.experiment.generate.simulator import (
    IndentationStore,
    OnProgress,
    SimulatedTrajectory,
    TwinSimulator,
)

Dropped = tuple[tuple[str, str], ...]
"""Trial and reason, of each that was left out."""


@dataclass(frozen=True, slots=True)
class ProcessedExperiment:
    """What became of the trials of a real experiment.

    Attributes:
        experiment: Purely experimental data set.
        mixed: With simulated fields; None without a simulation.
        dropped: In neither.
        unmixed: In the experimental one only.
    """

    experiment: ExperimentDataset
    mixed: MixedDataset | None
    dropped: Dropped
    unmixed: Dropped


def process_files(
    paths: Sequence[Path],
    out: Path,
    simulator: TwinSimulator,
    *,
    mechanics: Path | None = None,
    mixed: Path | None = None,
    command: str = "palpate data process",
    on_progress: OnProgress = lambda *_: None,
) -> ProcessedExperiment:
    """Process files of trials and write the data sets, once all of both is computed.

    Args:
        paths: Files of ``palpate data ingest``; read trial by trial.
        out: Experimental data set to write.
        simulator: Opens the simulation store.
        mechanics: Simulation store, for the mixed data set.
        mixed: Mixed data set to write; given if and only if ``mechanics`` is.
        command: For provenance.
        on_progress: Called after each trial, and in each part of the work after that.

    Raises:
        ConfigError: A file to write holds raw trials, or only one of store and mixed set is given.
        DatasetError: A file is damaged, a trial is there twice, nothing is left after processing or
            mixing, or the disk refuses.
    """
    if (mechanics is None) != (mixed is None):
        raise ConfigError(
            "only one of a simulation store and a mixed data set is given",
            remedy="give --mechanics STORE.sim and --mixed MIXED.h5 together, or neither",
        )
    written = [out] if mixed is None else [out, mixed]
    _check_written(written)
    files = [read_contents(path) for path in paths]
    total = sum(len(one.headers) for one in files)
    _check_once(paths, [[trial_name(header) for header in one.headers] for one in files])
    store = None if mechanics is None else simulator.open_store(mechanics)
    rows, lost = process_all(_counted(paths, total, on_progress))
    dropped = tuple(sorted(lost))
    if not rows:
        raise DatasetError(
            f"none of {total} trials gave rows; the first: {': '.join(dropped[0])}",
            remedy="look at the plan and the record; nothing was written",
        )
    provenance = Provenance(
        source="; ".join(dict.fromkeys(one.provenance.source for one in files)),
        command=command,
        input_sha256=hashlib.sha256(
            "\n".join(one.content_sha256 for one in files).encode()
        ).hexdigest(),
        licence="; ".join(dict.fromkeys(one.provenance.licence for one in files)),
        palpate_version=__version__,
        notes="input_sha256 is over the content_sha256 of each file of trials",
    )
    experiment = assemble_experiment(rows, provenance)
    both: MixedDataset | None = None
    unmixed: Dropped = ()
    if store is not None:
        both, unmixed = _mix(simulator, store, rows, experiment, on_progress)
    write_experiment(out, experiment)
    if mixed is not None and both is not None:
        write_mixed(mixed, both)
    return ProcessedExperiment(experiment, both, dropped, unmixed)


def _counted(paths: Sequence[Path], total: int, on_progress: OnProgress) -> Iterator[RawTrial]:
    done = 0
    for path in paths:
        for trial in read_trials(path):
            yield trial
            done += 1
            on_progress(done, total, trial_name(trial.header))


def _check_written(paths: Sequence[Path]) -> None:
    """Refuse to write over raw trials: forgetting OUT would make the last of them the output."""
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigError(f"{paths[0]} is to be written twice", remedy="name two files")
    for path in paths:
        if not path.exists():
            continue
        try:
            held = schema_of(path, extra="training")
        except DatasetError:  # what cannot be read may be replaced
            continue
        if held == TRIALS_SCHEMA.name:
            raise ConfigError(
                f"{path} holds raw trials, which cannot be made again",
                remedy="name the data set to write last, after the files of trials",
            )


def _check_once(paths: Sequence[Path], names: Sequence[Sequence[str]]) -> None:
    """Refuse a trial that two files hold before hours of them are read."""
    seen: dict[str, Path] = {}
    for path, some in zip(paths, names, strict=True):
        for name in some:
            if name in seen:
                raise DatasetError(
                    f"{path}: {name} is in {seen[name]} too",
                    remedy="a unit executes a trajectory once; leave out one of the files, or"
                    " ingest it again without that trajectory",
                )
            seen[name] = path


def _mix(
    simulator: TwinSimulator,
    store: IndentationStore,
    rows: Sequence[TrialRows],
    experiment: ExperimentDataset,
    on_progress: OnProgress,
) -> tuple[MixedDataset, Dropped]:
    fingertip = store.fingertip()
    common, left_out = common_trajectories(rows, set(store.ids()))
    outer = np.unique(fingertip.mesh.outer_faces)
    simulated: dict[str, SimulatedTrial] = {}
    believable: list[TrialRows] = []
    names = sorted({one.header.trajectory for one in common})
    for k, name in enumerate(names):
        trajectory = store.trajectory(name)
        believed = simulator.clear_steps(trajectory, fingertip)
        for one in (one for one in common if one.header.trajectory == name):
            if not believed:
                why = "no step of its simulation before it diverges or meets the mount"
            elif (away_m := _away(one, trajectory)) > OFFSET_M:
                why = (
                    f"its tip is {away_m * 1e3:.1f} mm from the simulated path: the store is of"
                    " another plan"
                )
            else:
                believable.append(one)
                simulated.setdefault(
                    name, simulated_trial(name, trajectory, believed, simulator.clearance_m, outer)
                )
                continue
            left_out.append((trial_name(one.header), why))
        on_progress(k + 1, len(names), "simulations")
    if not believable:
        raise _nothing_mixed(store, left_out)
    provenance = replace(
        experiment.provenance,
        source=f"{experiment.provenance.source}; simulation of {store.path.name}",
        notes=f"{experiment.provenance.notes}; fingertip {fingertip.key}",
    )
    try:
        both = join(
            believable,
            simulated,
            left_out,
            fingertip,
            provenance,
            unit_names=experiment.unit_names,
            on_progress=on_progress,
        )
    except DatasetError as error:
        if len(left_out) == len(rows):
            raise _nothing_mixed(store, left_out) from error
        raise
    return both, tuple(sorted(left_out))


def _nothing_mixed(store: IndentationStore, left_out: Sequence[tuple[str, str]]) -> DatasetError:
    trial, why = left_out[-1]
    return DatasetError(
        f"{store.path}: none of {len(left_out)} trials could be mixed; the last: {trial}: {why}",
        remedy="give the store of the plan that was executed, or leave --mechanics out",
    )


def _away(rows: TrialRows, trajectory: SimulatedTrajectory) -> float:
    """Distance of the tip from the line along which the indenter was simulated [m]."""
    start, end = trajectory.path[0, :3], trajectory.path[-1, :3]
    along = (end - start) / np.linalg.norm(end - start)
    off = rows.location - start
    off = off - np.outer(off @ along, along)
    return float(np.median(np.linalg.norm(off, axis=1)))
