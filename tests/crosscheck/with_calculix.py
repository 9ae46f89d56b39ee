"""Problem B by CalculiX (GPL-2), as a second opinion: penalty contact with a meshed sphere.

20-node hexahedra with reduced integration, nearly incompressible (kappa = 1e3 mu); surface to
surface contact with linear penalties; the sphere is a rigid cap of 20-node hexahedra. Its penalties
let the sphere sink in and sticking points creep a little, so its figures are soft.

    python -m tests.crosscheck.with_calculix --friction 0.5 --folder FOLDER

writes the input deck into the folder, runs `ccx` there and prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
from tests.crosscheck.contact import Grading, SphereOnBlock
from tests.crosscheck.hexes import block, quadratic
from tests.crosscheck.problem import Floats, Ints

MM = 1e3  # the deck is in mm, N, MPa
BULK_RATIO = 1e3
CAP_RAD = np.radians(42.0)  # half opening of the rigid cap; the contact's edge is at 27 degrees


def _serendipity(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Ints]:
    """20-node hexahedra between the coordinates, without the unused centre nodes."""

    def halved(axis: Floats) -> Floats:
        fine = np.empty(2 * len(axis) - 1)
        fine[::2], fine[1::2] = axis, (axis[1:] + axis[:-1]) / 2
        return fine

    axes = [halved(axis) for axis in (x, y, z)]
    nodes, hexes = block(*axes)
    counts = tuple(len(axis) - 1 for axis in axes)
    cells = quadratic(hexes, ((counts[0], counts[1], counts[2]),))[:, :20]
    used, renumbered = np.unique(cells, return_inverse=True)
    return nodes[used], renumbered.reshape(-1, 20).astype(np.int32)


def _cap(radius: float, height: float, count: int) -> tuple[Floats, Ints]:
    """The lowest part of the sphere, one element thick, its outer face being face 1."""
    nodes, cells = _serendipity(
        np.linspace(-CAP_RAD, CAP_RAD, 2 * count + 1),
        np.linspace(0, CAP_RAD, count + 1),
        np.array([radius, radius - 1.0]),
    )
    direction = np.column_stack(
        [np.tan(nodes[:, 0]), np.tan(nodes[:, 1]), np.full(len(nodes), -1.0)]
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * nodes[:, 2:] + [0, 0, height + radius], cells


def _lines(numbers: Ints, first: int, per_line: int) -> list[str]:
    words = [str(first), *(str(number + 1) for number in numbers)]
    rows = [", ".join(words[i : i + per_line]) for i in range(0, len(words), per_line)]
    return [row + "," for row in rows[:-1]] + rows[-1:]


def _set(name: str, ids: Ints) -> list[str]:
    rows = [", ".join(str(i + 1) for i in ids[k : k + 12]) for k in range(0, len(ids), 12)]
    return [f"*NSET, NSET={name}", *rows]


def deck(contact: SphereOnBlock, grading: Grading, *, normal: float, stick: float) -> str:
    """The input file.

    Args:
        contact: The problem.
        grading: Mesh of the block.
        normal: Normal penalty [MPa/mm].
        stick: Tangential penalty [MPa/mm].
    """
    height, radius = MM * contact.height_m, MM * contact.radius_m
    axes = [MM * axis for axis in grading.axes(contact)]
    soft, bricks = _serendipity(*axes)
    rigid, shells = _cap(radius, height, 14)
    nodes = np.concatenate([soft, rigid])
    shells = shells + np.int32(len(soft))
    guide, turn = len(nodes) + 1, len(nodes) + 2
    text = ["*NODE, NSET=ALL"]
    text += [f"{i + 1}, {x:.10g}, {y:.10g}, {z:.10g}" for i, (x, y, z) in enumerate(nodes)]
    text += [f"{extra}, 0, 0, {height + radius}" for extra in (guide, turn)]
    for name, cells, first in (("BLOCK", bricks, 1), ("CAP", shells, len(bricks) + 1)):
        text.append(f"*ELEMENT, TYPE=C3D20R, ELSET={name}")
        for number, cell in enumerate(cells):
            text += _lines(cell, first + number, 11)
    text += _set("RIGID", np.arange(len(soft), len(nodes), dtype=np.int32))
    text += _set("FLOOR", np.flatnonzero(np.isclose(soft[:, 2], 0.0)).astype(np.int32))
    text += _set("MIRROR", np.flatnonzero(np.isclose(soft[:, 1], 0.0)).astype(np.int32))
    centre = soft[bricks[:, :8]].mean(axis=1)
    highest = np.isclose(soft[bricks[:, 4:8], 2].min(axis=1), height)
    reach = MM * grading.zone_m * (1 + 0.5 / grading.fine)
    touching = np.flatnonzero(highest & (np.abs(centre[:, 0]) < reach) & (centre[:, 1] < reach))
    text += ["*SURFACE, NAME=SKIN", *(f"{i + 1}, S2" for i in touching)]
    text += ["*SURFACE, NAME=SPHERE", *(f"{i + 1 + len(bricks)}, S1" for i in range(len(shells)))]
    mu = 1e-6 * contact.shear_modulus_pa
    text += ["*MATERIAL, NAME=RUBBER", "*HYPERELASTIC, NEO HOOKE"]
    text += [f"{mu / 2:.10g}, {2 / (BULK_RATIO * mu):.10g}"]
    text += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "1000., 0.3"]  # ignored: the cap is rigid
    text += ["*SOLID SECTION, ELSET=BLOCK, MATERIAL=RUBBER"]
    text += ["*SOLID SECTION, ELSET=CAP, MATERIAL=STEEL"]
    text += [f"*RIGID BODY, NSET=RIGID, REF NODE={guide}, ROT NODE={turn}"]
    text += ["*SURFACE INTERACTION, NAME=TOUCH", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"]
    text += [f"{normal:.10g}"]
    if contact.friction:
        text += ["*FRICTION", f"{contact.friction:.10g}, {stick:.10g}"]
    text += ["*CONTACT PAIR, INTERACTION=TOUCH, TYPE=SURFACE TO SURFACE", "SKIN, SPHERE"]
    text += ["*BOUNDARY", "FLOOR, 1, 3", "MIRROR, 2, 2", f"{guide}, 1, 3", f"{turn}, 1, 3"]
    parts = ((contact.press_steps, 0.0), (contact.shear_steps, MM * contact.travel_m))
    for steps, along in parts:
        if steps:
            text += ["*STEP, NLGEOM, INC=500", "*STATIC", f"{1 / steps}, 1., 1e-4, {1 / steps}"]
            text += ["*BOUNDARY", f"{guide}, 1, 1, {along}"]
            text += [f"{guide}, 3, 3, {-MM * contact.depth_m}"]
            text += ["*NODE PRINT, NSET=FLOOR, TOTALS=ONLY", "RF", "*END STEP"]
    return "\n".join(text) + "\n"


def forces(dat: str) -> dict[float, tuple[float, float]]:
    """Force of the sphere on the whole block (x, z) [N] by time, from the reactions of the floor.

    The mirror plane carries only y. Time is 1 after the press and 2 after the drag.
    """
    found = re.findall(r"total force .*set FLOOR and time\s+(\S+)\s+(\S+)\s+\S+\s+(\S+)", dat)
    return {float(t): (-2 * float(x), -2 * float(z)) for t, x, z in found}


def run(
    contact: SphereOnBlock, grading: Grading, folder: Path, *, normal: float, stick: float
) -> dict[str, Any]:
    """Write the deck, run ccx on one thread, read the reactions."""
    started = time.perf_counter()
    text = deck(contact, grading, normal=normal, stick=stick)
    (folder / "block.inp").write_text(text, encoding="utf-8")
    with (folder / "block.log").open("w", encoding="utf-8") as log:
        subprocess.run(
            ["ccx", "block"],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=log,
            check=False,
        )
    by_time = forces((folder / "block.dat").read_text(encoding="utf-8"))
    return {
        "force_x_z_n": {f"{t:.6f}": [round(v, 6) for v in f] for t, f in by_time.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--friction", type=float, default=0.5)
    parser.add_argument("--fine", type=int, default=4)
    parser.add_argument("--layers", type=int, default=4)
    parser.add_argument("--press-steps", type=int, default=6)
    parser.add_argument("--shear-steps", type=int, default=12)
    parser.add_argument("--normal", type=float, default=50.0)
    parser.add_argument("--stick", type=float, default=15.0)
    given = parser.parse_args()
    contact = SphereOnBlock(
        friction=given.friction, press_steps=given.press_steps, shear_steps=given.shear_steps
    )
    grading = Grading(fine=given.fine, coarse=2, layers=given.layers)
    result = run(contact, grading, given.folder, normal=given.normal, stick=given.stick)
    said = {k: v for k, v in vars(given).items() if k != "folder"}
    print(json.dumps({**said, **result}))  # noqa: T201


if __name__ == "__main__":
    main()
