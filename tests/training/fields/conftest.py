"""Invented fingers that dent smoothly, with electrodes that follow the film below the dent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    MixedDataset,
    SkinMesh,
)
from palpate_training.tasks.fields import FieldFitConfig

Floats = npt.NDArray[np.float64]

INNER_M, OUTER_M = 6.4e-3, 8.0e-3
DENT_M = 3e-3


def shell(columns: int, rings: int) -> SkinMesh:
    """Two surfaces about the core: cylinder behind the origin, sphere before it."""
    x = np.linspace(-16e-3, 0.0, columns)
    polar = np.linspace(0.0, 1.4, columns // 2)[1:]
    around = np.linspace(-1.8, 1.8, rings)
    surfaces = []
    for radius in (OUTER_M, INNER_M):
        along = np.concatenate([x, radius * np.sin(polar)])
        ring = np.concatenate([np.full(columns, radius), radius * np.cos(polar)])
        surfaces.append(
            np.stack(
                [
                    np.repeat(along, rings),
                    (ring[:, None] * np.sin(around)).ravel(),
                    (ring[:, None] * -np.cos(around)).ravel(),
                ],
                axis=1,
            )
        )
    count = len(surfaces[0])
    cells = np.arange(count).reshape(-1, rings)
    a, b, c, d = (
        part.ravel() for part in (cells[:-1, :-1], cells[1:, :-1], cells[1:, 1:], cells[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    nodes = np.concatenate(surfaces)
    ventral = np.flatnonzero(nodes[:count, 2] < 0)
    return SkinMesh(
        nodes=nodes,
        outer_faces=faces,
        inner_faces=faces + np.int32(count),
        subset=ventral[np.linspace(0, len(ventral) - 1, 128).astype(int)].astype(np.int32),
        sha256="ab" * 32,
    )


def dent(points: Floats, centre: Floats, depth: Floats, shear: Floats) -> Floats:
    """Displacement [m] of points (V, 3) by presses at a centre of so many depths (S,)."""
    normal = -centre / np.linalg.norm(centre)
    shape = np.exp(-np.sum((points - centre) ** 2, axis=1) / (2 * DENT_M**2))
    return np.asarray(depth[:, None, None] * shape[None, :, None] * (normal + shear))


@pytest.fixture(scope="session")
def make_mixed() -> Callable[..., MixedDataset]:
    def make(
        units: int = 2, trajectories: int = 30, steps: int = 12, seed: int = 0
    ) -> MixedDataset:
        rng = np.random.default_rng(seed)
        mesh = shell(14, 11)
        names = tuple(f"biotac-{i + 1}" for i in range(units))
        presses = [(unit, press) for unit in range(units) for press in range(trajectories)]
        where = np.stack(
            [rng.uniform(-8e-3, -3e-3, trajectories), rng.uniform(-0.4, 0.4, trajectories)], 1
        )
        centres = np.stack(
            [
                where[:, 0],
                OUTER_M * np.sin(where[:, 1]),
                -OUTER_M * np.cos(where[:, 1]),
            ],
            axis=1,
        )
        shears = rng.uniform(-0.3, 0.3, (trajectories, 3))
        gains = rng.uniform(0.8, 1.2, (units, 19))
        depth = np.linspace(0.3e-3, 1.2e-3, steps)
        fields, tared, force, location = [], [], [], []
        for unit, press in presses:
            centre, shear = centres[press], shears[press]
            fields.append(dent(mesh.nodes, centre, depth, shear))
            closing = np.linalg.norm(dent(ELECTRODE_POSITIONS * 1.26, centre, depth, shear), axis=2)
            drop = -gains[unit] * 0.5 * np.tanh(closing / 0.8e-3)
            tared.append(drop + rng.normal(0, 5e-4, drop.shape))
            normal = -centre / np.linalg.norm(centre)
            force.append((depth / 1e-3)[:, None] ** 1.5 * 6.0 * (normal + shear))
            location.append(np.repeat(centre[None], steps, axis=0))
        flat = np.concatenate(fields).reshape(len(presses) * steps, -1)
        mean = flat.mean(axis=0)
        modes = np.linalg.svd(flat - mean, full_matrices=False)[2][:40]
        experiment = ExperimentDataset(
            unit_names=names,
            trajectories=tuple(f"sphere/{i}/normal" for i in range(trajectories)),
            indenters=("sphere",) * trajectories,
            trial_unit=np.array([unit for unit, _ in presses], np.int32),
            trial_trajectory=np.array([press for _, press in presses], np.int32),
            trial_rest=np.full((len(presses), 19), 2800, np.float32),
            trial=np.repeat(np.arange(len(presses), dtype=np.int32), steps),
            travel_m=np.tile(depth - depth[0], len(presses)).astype(np.float32),
            tared=np.concatenate(tared).astype(np.float32),
            force=np.concatenate(force).astype(np.float32),
            location=np.concatenate(location).astype(np.float32),
            provenance=Provenance("invented presses", "pytest", "", "free", "0.0.0"),
        )
        return MixedDataset(
            experiment=experiment,
            simulated_force=experiment.force,
            coefficients=((flat - mean) @ modes.T).astype(np.float32),
            basis=FieldBasis(
                mean.reshape(-1, 3).astype(np.float32),
                modes.reshape(len(modes), -1, 3).astype(np.float32),
                1e-7,
                1e-6,
            ),
            mesh=mesh,
        )

    return make


@pytest.fixture(scope="session")
def mixed(make_mixed: Callable[..., MixedDataset]) -> MixedDataset:
    """Two units, thirty trajectories each, twelve rows a trial."""
    return make_mixed()


@pytest.fixture(scope="session")
def quick() -> FieldFitConfig:
    """Short trainings of narrow networks."""
    return FieldFitConfig(members=2, width=48, blocks=1, epochs=40, patience=40, batch_rows=64)
