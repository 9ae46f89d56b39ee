"""An open parametric BioTac: hexahedra between two smooth surfaces, from dimensions only."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from palpate_fem.arrays import Floats, Ints
from palpate_fem.config import EDGE_M
from palpate_fem.mesh.check import check_mesh
from palpate_fem.mesh.core import DistanceGrid, RigidCore, box_around, grid_points, spread
from palpate_fem.mesh.grid import BagTopology, RayOrigins, Spacing, lay
from palpate_fem.mesh.shape import CavityShape, CoreShape, Field, nearest
from palpate_fem.mesh.solid import FingertipGeometry, check_limits, extrude
from palpate_fem.mesh.surface import enclosed_volume

# Underside of the nail on the skin, measured on the public nail slab: x from the clamp to the tip.
NAIL_X_M = (-13.96e-3, 3.42e-3)
NAIL_Y_M = 3.43e-3
# The nail holds what looks up within 14 degrees: quads of 116-121 mm^2, for any edge length (the
# slab is 119 mm^2, the public skin touches it on 127 mm^2 by another count). The clamp holds whole
# rings that look back within 26 degrees on average: quads of 45-67 mm^2, 59 mm^2 by default and on
# the public part.
NAIL_COSINE, CLAMP_COSINE = 0.97, 0.90

FRAME = RayOrigins(
    axis_z_m=-0.75e-3,
    tip_x_m=0.4e-3,
    tip_angle=0.7,
    end_x_m=-19.04e-3,
    end_radius_m=3.5e-3,
    back_x_m=-16.0e-3,
    mark_x_m=NAIL_X_M[0],
    mark_y_m=NAIL_Y_M,
    section_x_m=-6.8e-3,
)
# Ratio of dorsal to ventral edges, and the longest that follow the rounded edge of the flat.
COARSENING, LONGEST_M = 1.8, 1.1e-3
# Edges at the proximal end: their share of the others, the longest that still follow its rounded
# edge (else the skin would cut into the core), and how far it reaches.
END_SHARE, END_LONGEST_M, END_REACH_M = 0.65, 0.30e-3, 0.5e-3
FINE_BELOW_M, COARSE_ABOVE_M = 0.5e-3, 1.9e-3

# Nodes lie on a grid of 58 pm. Sines and roots differ in their last bit from one kind of processor
# to another, by 2e-17 m in a node, and the mesh's digest, which names it, would differ with them.
GRID_M = 2.0**-34

CORE_SPACING_M = 0.25e-3
CORE_MARGIN_M = 2.0e-3  # around the core: more than the fluid film is thick anywhere
CORE_BAND_M = 0.7e-3  # within, the tabulated distance is exact
CORE_EDGE_M = 0.6e-3  # of the surface for pictures


def biotac(
    *,
    thickness_m: float = 1.57e-3,
    edge_m: float = EDGE_M,
    layers: int = 2,
    cavity: CavityShape | None = None,
    core: CoreShape | None = None,
) -> FingertipGeometry:
    """Build the fingertip.

    Topology and inner surface depend on edge_m and the shapes only. A node's position is linear in
    thickness_m, along the normal of the inner surface.

    Args:
        thickness_m: Thickness of the skin [m].
        edge_m: Edge of a quad on the ventral and lateral inner surface [m], in whole micrometres;
            those on the outer one are longer by a quarter, dorsal ones up to `COARSENING` times as
            wide.
        layers: Hexahedra through the thickness.
        cavity: Shape of the inner surface; None = the BioTac's. The grid is laid for shapes near
            to that one.
        core: Shape of the core; None = the BioTac's in this cavity.

    Returns:
        Skin and core, exactly symmetric to y = 0.

    Raises:
        ConfigError: An argument is out of range.
        SimulationError: Elements would be inverted.
    """
    check_limits(thickness_m=thickness_m, edge_m=edge_m, layers=layers)
    cavity = cavity or CavityShape()
    core = core or CoreShape(cavity)
    bag, inner, normal = _surface(cavity, edge_m)
    mesh = extrude(
        inner,
        inner + thickness_m * normal,
        bag.faces,
        layers=layers,
        fixed_columns=_held(bag, inner, normal),
        mirror_columns=bag.mirror,
        name=f"biotac-{thickness_m * 1e3:.3f}mm-{edge_m * 1e3:.3f}mm-{layers}",
    )
    mesh = replace(mesh, nodes=np.round(mesh.nodes / GRID_M) * GRID_M)
    check_mesh(mesh)
    return FingertipGeometry(mesh, tabulated_core(core))


def spacing(edge_m: float) -> Spacing:
    """Wanted edge length: edge_m on the pad and the flanks, longer on the back, smooth between.

    Shorter at the proximal edge, which opens like a fan from the inner to the outer surface.
    """
    dorsal = max(edge_m, min(COARSENING * edge_m, LONGEST_M))
    end = min(END_SHARE * edge_m, END_LONGEST_M)

    def size(points: Floats) -> Floats:
        t = np.clip((points[:, 2] - FINE_BELOW_M) / (COARSE_ABOVE_M - FINE_BELOW_M), 0.0, 1.0)
        around = edge_m + (dorsal - edge_m) * t * t * (3 - 2 * t)
        near = np.exp(-(((points[:, 0] - FRAME.end_x_m) / END_REACH_M) ** 2))
        return np.asarray(around + (end - around) * near)

    return size


def _normals(field: Field, points: Floats, bag: BagTopology) -> Floats:
    """Unit normals of a body, exactly symmetric, shape (V, 3)."""
    _, gradient = field(points)
    normal = gradient / np.linalg.norm(gradient, axis=1)[:, None]
    normal[bag.left] = normal[bag.mirror[bag.left]] * np.array([1.0, -1.0, 1.0])
    normal[bag.mirror == np.arange(len(points)), 1] = 0.0
    return np.asarray(normal)


def _held(bag: BagTopology, inner: Floats, normal: Floats) -> Ints:
    """Columns under the nail and at the clamp."""
    x, y, _ = inner.T
    slack = 1e-5  # the grid has lines on the rim of the nail
    under = (x > NAIL_X_M[0] - slack) & (x < NAIL_X_M[1] + slack) & (np.abs(y) < NAIL_Y_M + slack)
    nail = np.flatnonzero(under & (normal[:, 2] > NAIL_COSINE))
    backwards = -normal[bag.rings, 0].mean(axis=1)
    clamp = bag.rings[backwards > CLAMP_COSINE]
    return np.unique(np.concatenate([nail, clamp.ravel(), bag.proximal.ravel()])).astype(np.int32)


@lru_cache(maxsize=4)
def _surface(cavity: CavityShape, edge_m: float) -> tuple[BagTopology, Floats, Floats]:
    """Inner surface and its normals, which do not depend on the thickness."""
    bag, inner = lay(cavity, FRAME, spacing(edge_m))
    return bag, inner, _normals(cavity, inner, bag)


@lru_cache(maxsize=4)
def tabulated_core(shape: CoreShape) -> RigidCore:
    """Tabulate the distance to a core, exactly symmetric.

    Within `CORE_BAND_M` of the surface the samples are the true distance to it. Between them the
    spline errs by 0.6 um on the surface (r.m.s.; 99 % below 3.3 um, at most 11 um, at the proximal
    edge) and by 1.4 um within 0.4 mm of it; the gradient's length differs from 1 by 0.9 % (r.m.s.).
    """
    bag, vertices = lay(shape, FRAME, lambda points: np.full(len(points), CORE_EDGE_M))
    faces = np.concatenate([bag.faces[:, [0, 1, 2]], bag.faces[:, [0, 2, 3]]])
    origin, size = box_around(vertices, CORE_MARGIN_M, CORE_SPACING_M)
    middle = size[1] // 2
    at = grid_points(origin, CORE_SPACING_M, size)[:, middle:]
    flat = at.reshape(-1, 3)
    value, _ = shape(flat)
    near = np.abs(value) < CORE_BAND_M
    foot = nearest(shape, flat[near])
    shape_of_half = at.shape[:-1]
    half = spread(at, near.reshape(shape_of_half), foot, np.sign(value).reshape(shape_of_half))
    values = np.concatenate([half[:, :0:-1], half], axis=1)
    grid = DistanceGrid.sampled(origin, CORE_SPACING_M, values)
    return RigidCore(grid, vertices, faces, enclosed_volume(vertices, faces), "parametric")
