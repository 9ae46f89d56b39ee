"""From a described contact to the path of its indenter: straight on, from clear of the skin."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate.errors import ErrorCode, RemoteError
from palpate.files.bundle import FieldMesh
from palpate.messages import ContactDescription, Pose
from palpate.rigid import facing, unit

Floats = npt.NDArray[np.float64]

CLEARANCE_M = 1e-3
"""How far before the skin the path begins [m]: a flat indenter bears on the round skin beside its
tip a little earlier than with it."""

STEP_M = 0.1e-3
"""Longest step within the skin [m]."""

DEEPEST_M = 3.2e-3
"""Deepest that a contact may go [m]: the twin's experiment went to 3.6 mm at most, where skin is
pinched on the core."""

FARTHEST_M = 3e-3
"""Farthest that a location may lie from the skin [m]."""

_NEIGHBOURHOOD_M = 1e-3
_GRID = 12  # points along an edge of a triangle: 0.05 mm apart on the shipped mesh
_REMEDY = "docs/conventions.md has the sensor frame; the bundle's mesh has the skin"


def path_of(contact: ContactDescription, mesh: FieldMesh) -> tuple[Pose, ...]:
    """Poses of the indenter's tip from clear of the skin to the depth; for a force, to the deepest.

    Raises:
        RemoteError: The location is not at the skin, the direction leads away from it, or the depth
            is greater than ``DEEPEST_M``.
    """
    point, normal = _nearest(mesh, np.array(contact.location, np.float64))
    inwards = -normal if contact.direction is None else unit(contact.direction)
    if inwards @ normal > -0.1:
        raise _refused(
            f"the direction {contact.direction} does not lead into the skin, whose normal at "
            f"{_mm(point)} mm is {np.round(normal, 2).tolist()}"
        )
    depth_m = DEEPEST_M if contact.depth_m is None else contact.depth_m
    if depth_m > DEEPEST_M:
        raise _refused(
            f"depth_m is {depth_m:g}, at most {DEEPEST_M:g} is simulated: the skin is pinched there"
        )
    steps = max(1, int(np.ceil(depth_m / STEP_M - 1e-9)))
    travel = [-CLEARANCE_M, *(depth_m * k / steps for k in range(steps + 1))]
    w, x, y, z = facing(inwards).tolist()
    poses = []
    for along in travel:
        px, py, pz = (point + along * inwards).tolist()
        poses.append(Pose((px, py, pz), (w, x, y, z)))
    return tuple(poses)


def _nearest(mesh: FieldMesh, location: Floats) -> tuple[Floats, Floats]:
    """The nearest point of the outer skin, and the skin's outward normal around it."""
    corners = mesh.nodes[mesh.outer_faces].astype(np.float64)  # (F, 3, 3)
    centres = corners.mean(axis=1)
    near = np.argsort(np.linalg.norm(centres - location, axis=1))[:32]
    part = np.linspace(0.0, 1.0, _GRID)
    u, v = (grid.ravel() for grid in np.meshgrid(part, part))
    weights = np.stack([1.0 - u - v, u, v])[:, u + v <= 1.0 + 1e-9]
    points = np.einsum("cs,fci->fsi", weights, corners[near]).reshape(-1, 3)
    distances = np.linalg.norm(points - location, axis=1)
    point = points[np.argmin(distances)]
    if distances.min() > FARTHEST_M:
        raise _refused(
            f"location {_mm(location)} mm is {distances.min() * 1e3:.1f} mm from the skin, at most "
            f"{FARTHEST_M * 1e3:g} mm is allowed"
        )
    around = np.linalg.norm(centres - point, axis=1) < _NEIGHBOURHOOD_M
    around[near[0]] = True
    edges = corners[around, 1:] - corners[around, :1]
    normal = np.cross(edges[:, 0], edges[:, 1]).sum(axis=0)
    # Outwards is away from the core's axis, or from its tip.
    core = np.array([min(point[0], 0.0), 0.0, 0.0])
    return point, unit(normal if normal @ (point - core) > 0 else -normal)


def _mm(point: Floats) -> str:
    return str(np.round(1e3 * point, 2).tolist())


def _refused(problem: str) -> RemoteError:
    return RemoteError(problem, remedy=_REMEDY, code=ErrorCode.INVALID_REQUEST)
