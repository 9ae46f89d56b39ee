"""Small data sets: one with a known law between electrodes and force, and tiny experiments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate_training.datasets.assembly import assemble_experiment, assemble_mixed
from palpate_training.datasets.basis import fit_basis
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import ExperimentDataset, MixedDataset, SkinMesh
from palpate_training.datasets.features import FeatureDataset
from palpate_training.datasets.trials import MixedRows, TrialHeader, TrialRows

TRIALS = [
    ("biotac-1", "cube/00/normal"),
    ("biotac-1", "sphere/00/normal"),
    ("biotac-1", "sphere/01/angled-2"),
    ("biotac-2", "cube/00/normal"),
    ("biotac-2", "sphere/01/angled-2"),
]
"""Unit and trajectory of the trials of the tiny experiment, in its order."""


@pytest.fixture
def provenance() -> Provenance:
    return Provenance("made by a test", "pytest", "", "free", "0.0.0")


@pytest.fixture
def press_data(provenance: Provenance) -> Callable[..., FeatureDataset]:
    """Presses of an invented finger: force and place follow smooth laws of the counts."""

    def make(presses: int = 12, rows: int = 60, seed: int = 0) -> FeatureDataset:
        rng = np.random.default_rng(seed)
        n = presses * rows
        group = np.repeat(np.arange(presses, dtype=np.int32), rows)
        depth = np.tile(np.clip(np.sin(np.linspace(-0.5, np.pi, rows)), 0, None), presses)
        place = np.repeat(rng.uniform(-1, 1, (presses, 3)), rows, axis=0)
        touching = depth > 0
        force = (depth[:, None] * (place + np.array([0, 0, 3]))).astype(np.float32)
        mix = rng.normal(size=(6, 19)) * 60
        signal = np.hstack([force, depth[:, None] * place]) @ mix + rng.normal(size=(n, 19))
        baseline = np.tile(rng.uniform(2500, 3000, 19), (n, 1)).astype(np.float32)
        electrodes = np.clip(np.round(baseline + signal), 0, 4095).astype(np.uint16)
        location = np.where(touching[:, None], 0.004 * place, np.nan).astype(np.float32)
        return FeatureDataset(
            electrodes=electrodes,
            baseline=baseline,
            force=force,
            group=group,
            block=group.copy(),
            sensor=np.zeros(n, dtype=np.int32),
            sensor_names=("finger",),
            provenance=provenance,
            contact_location=location,
            centre_of_pressure=location + np.float32(0.001),
            contact_normal=np.where(
                touching[:, None], place / np.linalg.norm(place, axis=1, keepdims=True), np.nan
            ).astype(np.float32),
            in_contact=touching,
            time_ns=np.arange(n, dtype=np.int64) * 10_000_000,
        )

    return make


@pytest.fixture
def make_rows() -> Callable[..., TrialRows]:
    """Processed rows of one trial; place and direction follow from the trajectory alone."""

    def make(unit: str, trajectory: str, rows: int = 6) -> TrialRows:
        plan = np.random.default_rng(list(trajectory.encode()))
        rng = np.random.default_rng(list(f"{unit} {trajectory}".encode()))
        travel = 1e-4 * np.arange(rows, dtype=np.float64)
        start = np.array([plan.uniform(-0.015, 0.0), plan.uniform(-0.004, 0.004), -0.009])
        way = np.array([0.5 * (plan.random() - 0.5), 0.5 * (plan.random() - 0.5), 1.0])
        way /= np.linalg.norm(way)
        return TrialRows(
            header=TrialHeader(unit, trajectory, trajectory.split("/")[0], "left"),
            rest=rng.integers(2800, 3200, 19).astype(float),
            travel_m=travel,
            tared=rng.uniform(-0.5, 0.1, (rows, 19)),
            force=np.outer(0.5 + 3e3 * travel, way),
            location=start + np.outer(travel, way) + rng.normal(0, 1e-6, 3),
        )

    return make


@pytest.fixture
def experiment(make_rows: Callable[..., TrialRows], provenance: Provenance) -> ExperimentDataset:
    """Two units, three unique trajectories, five trials of unequal length."""
    trials = [make_rows(*trial, rows=5 + i) for i, trial in enumerate(TRIALS)]
    return assemble_experiment(trials, provenance)


@pytest.fixture
def skin() -> SkinMesh:
    """Twelve nodes that count as a skin."""
    rng = np.random.default_rng(5)
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    return SkinMesh(
        rng.uniform(-0.01, 0.01, (12, 3)), faces, faces[:1] + 6, np.arange(4, dtype=np.int32), "ab"
    )


@pytest.fixture
def mixed_rows(make_rows: Callable[..., TrialRows]) -> list[MixedRows]:
    """The trials of the tiny experiment with a field that follows three laws of travel."""
    rng = np.random.default_rng(6)
    shapes = rng.normal(size=(3, 12, 3))
    found = []
    for unit, trajectory in TRIALS:
        rows = make_rows(unit, trajectory)
        law = np.stack([rows.travel_m, rows.travel_m**2 * 1e3, rows.force[:, 0] * 1e-4])
        field = np.einsum("kr,kvc->rvc", law, shapes).astype(np.float32)
        found.append(MixedRows(rows, 1.1 * rows.force, field))
    return found


@pytest.fixture
def mixed(mixed_rows: list[MixedRows], skin: SkinMesh, provenance: Provenance) -> MixedDataset:
    """The mixed data set of these trials."""
    basis = fit_basis(lambda: (one.displacement for one in mixed_rows))
    return assemble_mixed(mixed_rows, basis, skin, provenance)


@pytest.fixture
def large(
    make_rows: Callable[..., TrialRows], skin: SkinMesh, provenance: Provenance
) -> MixedDataset:
    """Presses of three indenters, two, seven and nine, of eleven rows, with fields of no law."""
    rng = np.random.default_rng(8)
    outer = skin.nodes[skin.outer_faces]
    normals = np.cross(outer[:, 1] - outer[:, 0], outer[:, 2] - outer[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    trials = []
    for kind, count in (("cube", 2), ("ring", 7), ("sphere", 9)):
        for k in range(count):
            rows = make_rows("a", f"{kind}/{k:02d}/normal", rows=11)
            moved = 1e-4 * rng.normal(size=(11, 12, 3)) * 0.5 ** np.arange(12)[:, None]
            force = -rng.uniform(0.5, 1.0, (11, 6, 1)) * np.repeat(normals, 3, axis=0)
            trials.append(
                MixedRows(
                    rows, 1.1 * rows.force, moved.astype(np.float32), force.astype(np.float32)
                )
            )
    basis = fit_basis(lambda: (one.displacement for one in trials))
    forces = fit_basis(
        lambda: (one.contact_force for one in trials if one.contact_force is not None), count=6
    )
    return assemble_mixed(trials, basis, skin, provenance, contact_basis=forces)
