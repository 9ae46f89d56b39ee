"""A simulation store without files or finite elements, which worker processes can open too."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

PRESSES = tuple(f"{kind}/{k:02d}/normal" for kind in ("cube", "sphere") for k in range(5))
SHORT = "cube/03/normal"
"""A press whose simulation does not reach the force at which a trial begins."""


@dataclass(frozen=True)
class PlaneStore:
    """Presses on a flat skin of 6 x 6 nodes.

    Attributes:
        path: A file with the name of the press whose fields lack a node, as if of another mesh; may
            be empty.
    """

    path: Path

    def ids(self) -> list[str]:
        return list(PRESSES)

    def fingertip(self) -> Any:
        x, y = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
        nodes = np.column_stack([1e-3 * x.ravel(), 1e-3 * y.ravel(), np.full(36, -5e-3)])
        at = np.arange(36).reshape(6, 6)
        a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
        faces = np.stack([a, b, c, d], axis=-1).reshape(-1, 4).astype(np.int32)
        mesh = SimpleNamespace(
            outer_faces=faces,
            inner_faces=faces[:1, ::-1],
            outer_nodes=np.arange(36, dtype=np.int32),
            sha256=b"plane",
        )
        return SimpleNamespace(mesh=mesh, pressurised_nodes=nodes)

    def trajectory(self, trajectory: str, /) -> Any:
        number = PRESSES.index(trajectory)
        nodes = self.fingertip().pressurised_nodes
        away = np.linalg.norm(nodes[:, :2] - nodes[7 + 2 * number, :2], axis=1)
        weight = np.exp(-((away / (1e-3 + 2e-4 * number)) ** 2))[:, None] * (0.0, 0.1, 1.0)
        pressed = np.where(away[:, None] < 1.5e-3, weight, 0.0)
        steps = []
        for k in range(1, 9):
            depth = 1e-4 * k
            size = 0.1 if trajectory == SHORT else 6e3 * depth * (1.0 + 0.1 * np.sin(number + k))
            nodal = size * pressed / np.linalg.norm(pressed.sum(axis=0))
            field = depth * weight * (1.0 + 0.1 * np.sin(3e3 * away * depth * 1e3))[:, None]
            if trajectory == self.path.read_text():
                field = field[:-1]
            pose = np.array([0.0, 0.0, depth, 1.0, 0.0, 0.0, 0.0])
            steps.append(
                SimpleNamespace(
                    pose=pose, displacement=field, indenter_force=nodal, force=nodal.sum(axis=0)
                )
            )
        path = np.zeros((2, 7))
        path[:, 3] = 1.0
        path[1, 2] = 8e-4
        return SimpleNamespace(indenter=trajectory.split("/")[0], path=path, steps=steps)
