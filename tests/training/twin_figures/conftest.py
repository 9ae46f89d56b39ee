"""Invented trials and fields, tiny, with what a figure needs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    MixedDataset,
    SkinMesh,
)


@pytest.fixture
def trials_data(provenance: Provenance) -> Callable[..., ExperimentDataset]:
    """Invented trials: sphere and cube, normal and angled, on the pad of every unit."""

    def make(units: int = 3, rows: int = 6, seed: int = 0) -> ExperimentDataset:
        rng = np.random.default_rng(seed)
        planned = [
            f"{indenter}/{point:02d}/{kind}"
            for indenter in ("sphere_small", "cube")
            for point in range(2)
            for kind in ("normal", "angled-0")
        ]
        trials = units * len(planned)
        travel = np.tile(np.linspace(0, 1e-3, rows), trials)
        push = np.tile([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], (trials // 2, 1)).repeat(rows, axis=0)
        place = rng.uniform([-12e-3, -2e-3, -7e-3], [2e-3, 2e-3, -5e-3], (trials, 3))
        return ExperimentDataset(
            unit_names=tuple(f"biotac-{unit + 1}" for unit in range(units)),
            trajectories=tuple(planned),
            indenters=tuple(name.partition("/")[0] for name in planned),
            trial_unit=np.repeat(np.arange(units, dtype=np.int32), len(planned)),
            trial_trajectory=np.tile(np.arange(len(planned), dtype=np.int32), units),
            trial_rest=np.full((trials, 19), np.nan, np.float32),
            trial=np.repeat(np.arange(trials, dtype=np.int32), rows),
            travel_m=travel.astype(np.float32),
            tared=rng.normal(0, 0.05, (trials * rows, 19)).astype(np.float32),
            force=((0.5 + 4e3 * travel)[:, None] * push).astype(np.float32),
            location=np.repeat(place, rows, axis=0).astype(np.float32),
            provenance=provenance,
        )

    return make


@pytest.fixture
def skin_mesh() -> SkinMesh:
    """Two nested boxes for a skin, triangles outward."""
    corners = np.array([[x, y, z] for x in (-15, 5) for y in (-7, 7) for z in (-8, 3)]) * 1e-3
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    nodes = np.concatenate([corners, 0.8 * corners])
    return SkinMesh(nodes, faces, faces + np.int32(8), np.arange(16, dtype=np.int32), "0" * 64)


@pytest.fixture
def fields_data(
    trials_data: Callable[..., ExperimentDataset], skin_mesh: SkinMesh
) -> Callable[..., MixedDataset]:
    """Invented trials with fields of one mode: every node by itself, the first one not at all."""

    def make(units: int = 3, rows: int = 6) -> MixedDataset:
        data = trials_data(units, rows)
        shape = np.zeros(skin_mesh.nodes.shape, np.float32)
        shape[:, 2] = np.linspace(0, 1, len(shape))
        mode = shape / np.linalg.norm(shape)
        size = np.tile(np.linspace(0, 1e-3, rows), len(data) // rows)
        return MixedDataset(
            experiment=data,
            simulated_force=data.force,
            coefficients=size[:, None].astype(np.float32),
            basis=FieldBasis(np.zeros_like(shape), mode[None], 1e-7, 1e-6),
            mesh=skin_mesh,
        )

    return make
