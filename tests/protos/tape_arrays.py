"""A tape of a flat patch with two units, for tests; and tapes as values that can be compared."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from palpate.files.tape_build import TapePress, tape_specimen

ELECTRICS = {
    "noise_counts": 0.4,
    "reference_c": 40.0,
    "temperature_coefficient": 0.025,
    "heating_k": 10.0,
    "heating_tau_s": 900.0,
    "gradient_sd": 0.005,
    "creep_share": 0.02,
    "creep_tau_s": 15.0,
    "pdc_offset": 2000.0,
    "pac_offset": 2028.0,
    "tac_offset": 2048.0,
    "gain": [0.0] * 19,
}
REST = np.linspace(2000.0, 2900.0, 19)


def patch(side: int = 3) -> Any:
    """Nodes of a flat patch of 6 mm [m], shape (side^2, 3)."""
    x, y = np.meshgrid(*[np.linspace(-3e-3, 3e-3, side)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.full(side * side, -8e-3)], axis=1)


def a_press(name: str, nodes: Any, *, at: float, depth_m: float, steps: int = 5) -> TapePress:
    """A smooth footprint that gets deeper and wider, dragged to one side."""
    share = np.linspace(0.0, 1.0, steps)
    tip = np.array([at, -at, -8e-3]) + share[:, None] * [0.0, 0.0, depth_m]
    r2 = np.sum((nodes - tip[0]) ** 2, axis=1)
    foot = np.exp(-r2 / (4e-6 * (1.0 + share[:, None])))
    drag = np.exp(-r2 / 2e-5)
    force = share[:, None] * [0.3, 0.0, 4.0]
    return TapePress(
        id=name,
        indenter="sphere",
        poses=np.concatenate([tip, np.tile([1.0, 0.0, 0.0, 0.0], (steps, 1))], axis=1),
        force=force,
        torque=np.cross(tip, force),
        fluid_pressure_pa=1750.0 + 8e3 * share,
        counts=np.stack([REST - share[:, None] * 300.0, REST - share[:, None] * 500.0]),
        displacement=share[:, None, None]
        * depth_m
        * (foot[:, :, None] * [0.0, 0.0, 1.0] + 0.3 * drag[None, :, None] * [1.0, 0.0, 0.0]),
    )


def arrays(side: int = 3, count: int = 2) -> dict[str, Any]:
    """Arguments of ``build_tape``."""
    nodes = patch(side)
    text = json.dumps(ELECTRICS)
    return {
        "specimens": [tape_specimen("biotac1", text, REST), tape_specimen("biotac2", text, REST)],
        "presses": [
            a_press(f"p{k}", nodes, at=-2e-3 + 4e-3 * k / count, depth_m=(1 + k % 3) * 1e-3)
            for k in range(count)
        ],
        "rest_pressure_pa": 1750.0,
        "nodes": nodes,
        "outer_faces": [[0, 1, 3]],
        "inner_faces": [[1, 4, 3]],
        "mesh_sha256": b"\x07" * 32,
        "source": "by hand, grüße",
    }


def plain(value: Any) -> Any:
    """Values that can be compared, of a tape or a part of one."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value
