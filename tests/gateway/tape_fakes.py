"""A tape of nine nodes, two units and three presses, written by hand: no simulation, but a tape."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from palpate.files.tape import Tape, TapeSpecimen
from palpate.files.tape_build import TapePress, build_tape, tape_specimen

STEPS = 6
REST_PRESSURE_PA = 1750.0
IDS = ("ball/0/normal", "ball/1/angled", "cube/0/normal")
QUIET = {"noise_counts": 0.0, "heating_k": 0.0, "gradient_sd": 0.0, "creep_share": 0.0}
"""Electrics that add nothing: what is read is the tape, rounded."""

ELECTRICS = {
    "noise_counts": 0.45,
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
}


def nodes() -> Any:
    """Nodes of a flat patch [m], shape (9, 3)."""
    x, y = np.meshgrid([-1e-3, 0.0, 1e-3], [-1e-3, 0.0, 1e-3])
    return np.stack([x.ravel(), y.ravel(), np.full(9, -8e-3)], axis=1)


def presses(units: list[TapeSpecimen]) -> list[TapePress]:
    """Straight presses, each with a direction, a depth and a footprint of its own."""
    made = []
    share = np.linspace(0.0, 1.0, STEPS)
    for k, name in enumerate(IDS):
        direction = np.array([0.0, 0.0, 1.0]) if k != 1 else np.array([0.5, 0.0, np.sqrt(0.75)])
        # Shortest turn from +z to the direction.
        turn = np.array([1.0 + direction[2], -direction[1], direction[0], 0.0])
        turn /= np.linalg.norm(turn)
        depth = share * (1.0 + k) * 1e-3
        tip = np.array([-2e-3 * k, 1e-3, -8.3e-3]) + depth[:, None] * direction
        force = (share**1.5 * (4.0 + k))[:, None] * direction
        near = np.exp(-np.sum((nodes() - tip[0]) ** 2, axis=1) / 4e-6)
        fall = np.linspace(100.0, 900.0, 19) * (k + 1) / 3
        made.append(
            TapePress(
                id=name,
                indenter=name.partition("/")[0],
                poses=np.concatenate([tip, np.tile(turn, (STEPS, 1))], axis=1),
                force=force,
                torque=np.cross(tip, force),
                fluid_pressure_pa=REST_PRESSURE_PA + 9e3 * share,
                counts=np.stack(
                    [
                        one.rest_counts - (u + 1) * share[:, None] * fall
                        for u, one in enumerate(units)
                    ]
                ),
                displacement=depth[:, None, None] * near[None, :, None] * direction,
            )
        )
    return made


def make_tape(**electrics: float) -> Tape:
    """The tape; both units with these electrics instead of the usual ones."""
    text = json.dumps({**ELECTRICS, **electrics})
    units = [
        tape_specimen(f"unit{u + 1}", text, 2500.0 + 200.0 * u + 10.0 * np.arange(19))
        for u in range(2)
    ]
    return build_tape(
        specimens=units,
        presses=presses(units),
        rest_pressure_pa=REST_PRESSURE_PA,
        nodes=nodes(),
        outer_faces=[[0, 1, 3], [1, 4, 3]],
        inner_faces=[[4, 5, 7]],
        mesh_sha256=bytes(range(32)),
        source="made by hand for tests",
    )
