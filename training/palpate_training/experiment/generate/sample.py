"""A small part of an experiment that travels with the program: a data set, a tape to play."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigError, DatasetError
from palpate.files.outputs import check_folder, check_output
from palpate.files.tape import Tape, write_tape
from palpate.files.tape_build import TapePress, build_tape, tape_specimen
from palpate_training.datasets.basis import encode, fit_basis, subset
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    read_experiment,
    read_mixed,
    write_experiment,
    write_mixed,
)
from palpate_training.experiment.generate.data_sets import skin_mesh
from palpate_training.experiment.generate.pipeline import EXPERIMENT, MIXED, STORE, TRIALS
from palpate_training.experiment.generate.simulator import (
    IndentationStore,
    SimulatedTrajectory,
    Specimen,
    TwinSimulator,
)
from palpate_training.experiment.generate.trials import read_trials

Floats = NDArray[np.float64]

DATASET_MODES = 12
"""Modes of the sample's fields: 1.1 MB, and two hundredths of a millimetre lost on average."""

TAPE_STEPS = 16
"""Steps of a press on tape; between them a player interpolates."""


def make_sample(
    folder: Path,
    specimens: Sequence[Specimen],
    simulator: TwinSimulator,
    dataset: Path,
    tape: Path,
    rest: Path | None = None,
) -> tuple[tuple[str, ...], int]:
    """Take one normal and one angled trajectory of each indenter.

    Args:
        folder: A finished experiment.
        specimens: Its simulated BioTacs.
        simulator: Opens its store.
        dataset: Mixed data set to write.
        tape: Tape to write.
        rest: Folder that takes both data sets without these trajectories; None = none. Who plays
            the tape to a network must have trained it on these.

    Returns:
        Ids of the trajectories of both, and the number of trials in the data set.

    Raises:
        ConfigError: A file to write is one of the experiment, is named twice, or cannot be written.
        DatasetError: The folder is no finished experiment, one of other specimens, or damaged, or
            nothing is left for ``rest``. Nothing is written then.
    """
    _check_outputs(folder, dataset, tape, rest)
    mixed = read_mixed(folder / MIXED)
    wanted = _picked(mixed)
    trials = _trials(mixed.experiment, wanted, inside=True)
    played = _tape(folder, specimens, simulator.open_store(folder / STORE), wanted)
    small = _fewer_modes(subset(mixed, trials))
    if rest is not None:
        experiment = read_experiment(folder / EXPERIMENT)
        others = subset(experiment, _trials(experiment, wanted, inside=False))
        others_mixed = subset(mixed, _trials(mixed.experiment, wanted, inside=False))
        rest.mkdir(parents=True, exist_ok=True)
        write_experiment(rest / EXPERIMENT, others)
        write_mixed(rest / MIXED, others_mixed)
    write_mixed(dataset, small)
    write_tape(tape, played)
    return wanted, len(trials)


def _check_outputs(folder: Path, dataset: Path, tape: Path, rest: Path | None) -> None:
    """Refuse files to write that are read, written twice, or cannot be written."""
    check_output(dataset, "--dataset", ".h5", folder / EXPERIMENT, folder / MIXED)
    check_output(tape, "--tape", ".npz")
    kept = [(folder / name).resolve() for name in (STORE, TRIALS)]
    for option, path in (("--dataset", dataset), ("--tape", tape)):
        if not set(kept).isdisjoint(path.resolve().parents):
            raise ConfigError(
                f"{option} {path} is inside what the command reads", remedy="name another file"
            )
    if rest is None:
        return
    check_folder(rest, "--rest")
    for name in (EXPERIMENT, MIXED):
        written = (rest / name).resolve()
        if written in ((folder / EXPERIMENT).resolve(), (folder / MIXED).resolve()):
            raise ConfigError(
                f"--rest {rest}: its {name} is what the command reads", remedy="name another folder"
            )
        if written == dataset.resolve():
            raise ConfigError(
                f"--dataset {dataset} is a file of --rest, too", remedy="name another file"
            )


def _picked(mixed: MixedDataset) -> tuple[str, ...]:
    """Of each indenter the first normal and the first angled trajectory of most specimens."""
    data = mixed.experiment
    units = np.bincount(data.trial_trajectory, minlength=len(data.trajectories))
    picked: dict[tuple[str, bool], str] = {}
    for k in sorted(range(len(units)), key=lambda k: (-units[k], data.trajectories[k])):
        name = data.trajectories[k]
        if units[k]:
            picked.setdefault((data.indenters[k], name.endswith("/normal")), name)
    if not picked:
        raise DatasetError("the mixed data set has no trial", remedy="generate it again")
    return tuple(sorted(picked.values()))


def _trials(data: ExperimentDataset, names: Sequence[str], *, inside: bool) -> list[int]:
    """Trials whose trajectory is one of these, or none of them."""
    return [
        k for k, t in enumerate(data.trial_trajectory) if (data.trajectories[t] in names) is inside
    ]


def _fewer_modes(mixed: MixedDataset) -> MixedDataset:
    fields = mixed.displacement(slice(0, len(mixed)))
    basis = fit_basis(lambda: [fields], count=DATASET_MODES)
    contact = mixed.contact
    if contact is not None:
        forces = contact.basis.decode(contact.coefficients)
        forces_basis = fit_basis(lambda: [forces], count=DATASET_MODES)
        contact = replace(contact, basis=forces_basis, coefficients=encode(forces_basis, forces))
    return replace(mixed, basis=basis, coefficients=encode(basis, fields), contact=contact)


def _tape(
    folder: Path, specimens: Sequence[Specimen], store: IndentationStore, names: Sequence[str]
) -> Tape:
    fingertip = store.fingertip()
    mesh = skin_mesh(fingertip)
    presses, rests = [], {}
    for name in names:
        done = read_trials(folder / TRIALS, name)
        rests.update({unit: rows[0] for unit, rows in done.counts.items()})
        if missing := [one.name for one in specimens if one.name not in done.counts]:
            raise DatasetError(
                f"{folder} has no trials of {', '.join(missing)}",
                remedy="give --units the specimens of this experiment",
            )
        counts = np.stack([done.counts[one.name] for one in specimens])
        rest_pa = fingertip.fluid_pressure_pa
        presses.append(_press(name, store.trajectory(name), counts, rest_pa))
    return build_tape(
        specimens=[
            tape_specimen(one.name, one.parameters_json, rests[one.name]) for one in specimens
        ],
        presses=presses,
        rest_pressure_pa=fingertip.fluid_pressure_pa,
        nodes=mesh.nodes,
        outer_faces=mesh.outer_faces,
        inner_faces=mesh.inner_faces,
        mesh_sha256=bytes.fromhex(mesh.sha256),
        source="palpate data generate; made by palpate, use as you like",
    )


def _press(name: str, trajectory: SimulatedTrajectory, counts: Floats, rest_pa: float) -> TapePress:
    """Untouched, then a few of the converged steps."""
    steps = trajectory.steps[: counts.shape[1] - 1]
    some = np.unique(np.linspace(0, len(steps) - 1, TAPE_STEPS).round().astype(int))
    chosen = [steps[k] for k in some]
    still = np.zeros((1, 3))
    return TapePress(
        id=name,
        indenter=trajectory.indenter,
        poses=np.concatenate([trajectory.path[:1], [step.pose for step in chosen]]),
        force=np.concatenate([still, [step.force for step in chosen]]),
        torque=np.concatenate([still, [step.torque for step in chosen]]),
        fluid_pressure_pa=np.array([rest_pa, *(step.fluid_pressure_pa for step in chosen)]),
        counts=counts[:, np.concatenate([[0], some + 1])],
        displacement=np.concatenate(
            [np.zeros_like(chosen[0].displacement)[None], [step.displacement for step in chosen]]
        ),
    )
