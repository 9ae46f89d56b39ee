"""An invented fingertip and indentation, for stores and pictures without any mechanics.

The finger is a thick spherical shell of hexahedra, fixed on its back, around a ball; the
indentation is a dent where a sphere would be. Only the order of magnitude of the numbers is right.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from palpate_fem.arrays import Floats, Ints
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import Outline, StoredFingertip

INNER_M = 5.5e-3
OUTER_M = 7.0e-3
CORE_M = 4.6e-3
BULGE_M = 0.8e-3
INDENTER_M = 3.5e-3
START_M = 0.3e-3
"""Gap between skin and indenter at the first pose."""


def sample_fingertip(divisions: int = 8, layers: int = 2) -> StoredFingertip:
    """A shell of 6 * divisions^2 * layers hexahedra around a ball."""
    grid, quads = _cube(divisions)
    directions = _sphere(grid, divisions)
    count = len(directions)
    radii = np.linspace(INNER_M, OUTER_M, layers + 1)
    mirror = _mirror(grid, divisions)
    elements = np.concatenate(
        [
            np.hstack([quads + low * count, quads + high * count])
            for low, high in pairwise(range(layers + 1))
        ]
    )
    owners = np.arange(len(quads), dtype=np.int32)
    outer = quads + layers * count
    mesh = SolidMesh(
        nodes=(radii[:, None, None] * directions).reshape(-1, 3),
        elements=elements.astype(np.int32),
        outer_faces=outer.astype(np.int32),
        outer_elements=owners + np.int32((layers - 1) * len(quads)),
        inner_faces=quads,
        inner_elements=owners,
        fixed=np.flatnonzero(np.tile(directions[:, 2] > 0.6, layers + 1)).astype(np.int32),
        mirror=np.concatenate([mirror + layer * count for layer in range(layers + 1)]).astype(
            np.int32
        ),
        name=f"sample {divisions} x {layers}",
    )
    unit = np.tile(directions, (layers + 1, 1))
    bulge = BULGE_M * np.clip(0.6 - unit[:, 2:], 0.0, 1.6) / 1.6
    ball, triangles = sphere_outline(CORE_M, divisions)
    return StoredFingertip(
        mesh=mesh,
        parameters=FingertipParameters(),
        settings={"solver": "made up", "divisions": divisions},
        pressurised_nodes=mesh.nodes + bulge * unit,
        fluid_pressure_pa=29.0e3,
        fluid_volume_m3=4.7e-7,
        total_thickness_m=2 * OUTER_M + BULGE_M,
        core_vertices=np.asarray(ball, np.float64),
        core_faces=triangles,
    )


def sample_trajectory(
    tip: StoredFingertip,
    *,
    steps: int = 20,
    depth_m: float = 2e-3,
    y_m: float = 0.0,
    angle: float = 0.0,
) -> IndentationResult:
    """A sphere of 7 mm pressed into the pad, ``angle`` [rad] about y."""
    skin = tip.pressurised_nodes
    cos, sin = np.cos(angle), np.sin(angle)
    inward = np.array([sin, 0.0, cos])
    quaternion = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
    first = -(OUTER_M + BULGE_M + START_M) * inward + (0.0, y_m, 0.0)
    travel = np.linspace(0.0, START_M + depth_m, steps + 1)
    path = np.hstack([first + travel[:, None] * inward, np.tile(quaternion, (steps + 1, 1))])
    found = tuple(
        _step(tip, skin, pose, inward, depth - START_M)
        for pose, depth in zip(path[1:], travel[1:], strict=True)
    )
    return IndentationResult(
        "sphere_medium",
        path,
        found,
        IndentationOutcome.COMPLETE,
        travel_m=float(travel[-1]),
        seconds=7.5,
    )


def sphere_outline(radius_m: float = INDENTER_M, divisions: int = 8) -> Outline:
    """A sphere about the origin as triangles: vertices [m] (V, 3), triangles (T, 3)."""
    grid, quads = _cube(divisions)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return radius_m * _sphere(grid, divisions), triangles


def indenter_outline(indenter: str) -> Outline:
    """The sample's indenter, whatever its name: tip at the origin, body towards -z."""
    vertices, triangles = sphere_outline()
    return vertices - np.array([0.0, 0.0, INDENTER_M]), triangles


def _step(
    tip: StoredFingertip, skin: Floats, pose: Floats, inward: Floats, depth_m: float
) -> IndentationStep:
    centre = pose[:3] - INDENTER_M * inward
    from_centre = skin - centre
    along = from_centre @ inward
    aside = np.linalg.norm(from_centre - along[:, None] * inward, axis=1)
    # A dent that follows the sphere where it touches and fades with distance from it.
    top = np.sqrt(np.maximum(INDENTER_M**2 - aside**2, 0.0))
    fade = np.exp(-((aside / 3.2e-3) ** 2)) * (along < INDENTER_M + 4e-3)
    dent = max(depth_m, 0.0) * fade * np.clip(-tip.mesh.nodes[:, 2] / OUTER_M, 0.0, 1.0)
    touched = (top - along > 0) & (aside < INDENTER_M)
    dent = np.where(touched, np.maximum(dent, top - along), dent) if depth_m > 0 else 0.0 * dent
    displacement = dent[:, None] * inward
    radius = np.linalg.norm(skin + displacement, axis=1)
    # Keep everything out of the core, and let the layers around it keep some thickness.
    least = CORE_M + 0.6 * (np.linalg.norm(tip.mesh.nodes, axis=1) - INNER_M)
    back = np.maximum(least - radius, 0.0)[:, None] * (skin + displacement) / radius[:, None]
    displacement += back
    outer, inner = np.zeros((2, len(skin)), bool)
    outer[tip.mesh.outer_nodes], inner[tip.mesh.inner_nodes] = True, True
    pushed = np.where(outer & touched & (depth_m > 0), top - along, 0.0)
    normal = from_centre / np.linalg.norm(from_centre, axis=1, keepdims=True)
    indenter_force = 250.0 * pushed[:, None] * normal
    force = indenter_force.sum(axis=0)
    total = pushed.sum()
    magnitude = np.linalg.norm(displacement[tip.mesh.elements].mean(axis=1), axis=1)
    return IndentationStep(
        pose=pose,
        displacement=displacement,
        fluid_pressure_pa=tip.fluid_pressure_pa + 7e3 * max(depth_m / 3e-3, 0.0) ** 2,
        force=force,
        torque=np.cross(skin + displacement, indenter_force).sum(axis=0),
        indenter_force=indenter_force,
        core_force=400.0 * np.where(inner[:, None], back, 0.0),
        contact_area_m2=float(np.pi * INDENTER_M * max(depth_m, 0.0)),
        centre_of_pressure=(skin + displacement).T @ pushed / total
        if total > 0
        else np.full(3, np.nan),
        stress=1e8 * magnitude[:, None] * np.array([-1.0, -0.8, -2.0, 0.1, 0.2, 0.0]),
        convergence=Convergence(1, 4 + int(3 * (depth_m > 2e-3)), 3, 1e-9, 1e-12, 2e-6, 0.35),
    )


def _cube(divisions: int) -> tuple[Ints, Ints]:
    """Surface grid of a cube: integer coordinates (N, 3), quads (Q, 4), outward."""
    steps = np.arange(divisions + 1)
    first, second = np.meshgrid(steps, steps, indexing="ij")
    patches = []
    for axis in range(3):
        for side in (0, divisions):
            patch = np.zeros((*first.shape, 3), np.int64)
            patch[..., axis], patch[..., axis - 2], patch[..., axis - 1] = side, first, second
            corners = [patch[:-1, :-1], patch[1:, :-1], patch[1:, 1:], patch[:-1, 1:]]
            patches.append(np.stack(corners[:: 1 if side else -1], axis=2).reshape(-1, 4, 3))
    flat = np.concatenate(patches).reshape(-1, 3)
    grid, inverse = np.unique(flat, axis=0, return_inverse=True)
    return grid.astype(np.int32), inverse.reshape(-1, 4).astype(np.int32)


def _sphere(grid: Ints, divisions: int) -> Floats:
    """Directions of the grid of a cube, evened out."""
    cube = np.tan((2.0 * grid / divisions - 1.0) * np.pi / 4)
    directions: Floats = cube / np.linalg.norm(cube, axis=1, keepdims=True)
    return directions


def _mirror(grid: Ints, divisions: int) -> Ints:
    """Where each point of the grid is after y -> -y."""
    at = {tuple(point): index for index, point in enumerate(grid.tolist())}
    return np.array([at[x, divisions - y, z] for x, y, z in grid.tolist()], np.int32)
