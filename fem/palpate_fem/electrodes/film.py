"""Mesh of the fluid film: triangles on the wetted core, with nodes on the rims of electrodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from palpate.anatomy import ELECTRODE_POSITIONS, EXCITATION_POSITIONS
from palpate.errors import ConfigError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.electrodes.specimen import DISC_DIAMETER_M, DISC_TERMINAL
from palpate_fem.mesh.core import RigidCore
from palpate_fem.mesh.surface import face_vectors, open_edges

EDGE_M = 0.55e-3
"""Edge of the triangles between the discs [m]; gives 3,000 nodes on the BioTac."""

TOP_Z_M = 1.2e-3  # above, the core turns into the dorsal flat under the nail (mesh.shape: 1.91 mm)
BACK_X_M = -17.9e-3  # behind, the rounded proximal edge and the clamp (mesh.shape: -18.54 mm)
RADIUS_M = (
    5.1e-3  # of the capsule on which points are placed before they are projected onto the core
)

# Rings of nodes around a disc: radius over the disc's radius, number of nodes, angle of the first
# one in steps. Most current leaves at the rim, so rings are dense there. Those next to the rim use
# its angles, or Delaunay would flip its edges.
RINGS = (
    (0.4, 8, 0.0),
    (0.7, 14, 0.5),
    (0.88, 24, 0.0),
    (1.0, 24, 0.0),
    (1.13, 24, 0.0),
    (1.35, 20, 0.5),
)
RIM = 3
LONGEST_M = 1.8e-3  # longest edge of a triangle at a disc, however short the others are
# No other nodes within this many radii of a *nominal* disc, so that a small change of the diameter
# does not change the topology.
CLEAR = 1.52
# With larger discs, or a smaller core, E7..E10 would touch.
LIMITS = {
    "edge_m": (0.25e-3, 1.0e-3),
    "disc_diameter_m": (2.0e-3, 2.6e-3),
    "recess_m": (-0.1e-3, 0.3e-3),
}


@dataclass(frozen=True)
class FilmMesh:
    """Triangles of the film; its border is insulated.

    Attributes:
        nodes: On the core [m], shape (N, 3), sensor frame.
        normals: Unit normals of the core there, out of it, shape (N, 3).
        faces: Triangles, counter-clockwise seen from outside, shape (F, 3).
        terminal: Terminal whose electrode lies under each triangle, -1 for none, shape (F,).
    """

    nodes: Floats
    normals: Floats
    faces: Ints
    terminal: Ints

    @property
    def areas(self) -> Floats:
        """Areas of the triangles [m^2], shape (F,)."""
        return np.asarray(np.linalg.norm(face_vectors(self.nodes, self.faces), axis=1))


def film_mesh(
    core: RigidCore,
    *,
    edge_m: float = EDGE_M,
    disc_diameter_m: float = DISC_DIAMETER_M,
    recess_m: float = 0.0,
) -> FilmMesh:
    """Mesh the wetted surface of a core, from the clamp over the pad to the nail's rim.

    Nodes lie on the rims of the discs, so a disc is a union of triangles with exactly its area, and
    results change smoothly with a disc's diameter.

    Args:
        core: The core, in the sensor frame.
        edge_m: Edge of the triangles between the discs [m].
        disc_diameter_m: Of the electrodes [m].
        recess_m: Depth of the film's floor below the core's surface [m]. With 0.25 mm, the radius
            of the public part (5.33 mm) becomes that of the electrode table (5.08 mm).

    Raises:
        ConfigError: An argument is out of range, or the electrodes do not fit onto the core.
    """
    given = {"edge_m": edge_m, "disc_diameter_m": disc_diameter_m, "recess_m": recess_m}
    for name, value in given.items():
        low, high = LIMITS[name]
        if not low <= value <= high:
            raise ConfigError(
                f"{name} = {value} is not within [{low:g}, {high:g}]", remedy="give it in m"
            )
    centres = onto(core, np.concatenate([ELECTRODE_POSITIONS, EXCITATION_POSITIONS]), -recess_m)[0]
    radius = disc_diameter_m / 2
    points, disc, about = _disc_points(core, centres, radius, recess_m)
    # Where discs are close together, ring nodes near another disc are left out.
    away = np.linalg.norm(points[:, None] - centres, axis=2)
    away[np.arange(len(points)), about] = np.inf
    keep = (disc >= 0) | (away.min(axis=1) > 1.15 * radius)
    points, disc = points[keep], disc[keep]
    between = onto(core, _lattice(edge_m), -recess_m)[0]
    far, _ = cKDTree(centres).query(between)
    between = between[far > max(CLEAR * DISC_DIAMETER_M / 2, 1.3 * radius + 0.3 * edge_m)]
    points = np.concatenate([points, between])
    disc = np.concatenate([disc, np.full(len(between), -1)])
    faces = _triangles(points, edge_m)
    used, compact = np.unique(faces, return_inverse=True)
    faces = compact.reshape(-1, 3).astype(np.int32)
    points, disc = points[used], disc[used]
    at = disc[faces]
    inside = (at[:, 0] >= 0) & (at == at[:, :1]).all(axis=1)
    terminal = np.where(inside, DISC_TERMINAL[at[:, 0]], -1).astype(np.int32)
    mesh = FilmMesh(points, onto(core, points, -recess_m)[1], faces, terminal)
    for i in range(len(centres)):
        area = mesh.areas[inside & (at[:, 0] == i)].sum() / (np.pi * radius**2)
        if not 0.97 < area < 1.04:  # curvature makes the area up to 2 % larger
            raise ConfigError(
                f"electrode disc {i} covers {area:.2f} of its area on the core",
                remedy="check that the core is in the sensor frame",
            )
    return mesh


def onto(core: RigidCore, points: Floats, level_m: float = 0.0) -> tuple[Floats, Floats]:
    """Nearest points on a level set of the core's distance field, and the unit normals there.

    Args:
        core: The core.
        points: Near its surface [m], shape (N, 3).
        level_m: Distance from the surface, negative inside [m].
    """
    points = np.array(points, np.float64)
    for _ in range(8):
        value, gradient, _ = core.grid.evaluate(points)
        square = np.maximum(np.einsum("ni,ni->n", gradient, gradient), 0.25)
        points -= ((value - level_m) / square)[:, None] * gradient
    _, gradient, _ = core.grid.evaluate(points)
    return points, gradient / np.linalg.norm(gradient, axis=1)[:, None]


def _disc_points(
    core: RigidCore, centres: Floats, radius: float, recess: float
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Points of the rings; the disc that each lies in (-1 = none); the disc it was placed around.

    Points are ordered by ring, then by disc.
    """
    _, normal = onto(core, centres, -recess)
    across = np.cross(normal, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    along = np.cross(across, normal)
    everyone = np.arange(len(centres))
    about = np.concatenate([everyone, *(np.repeat(everyone, ring[1]) for ring in RINGS)])
    within = len(centres) * (1 + sum(ring[1] for ring in RINGS[: RIM + 1]))
    disc = np.where(np.arange(len(about)) < within, about, -1)
    # Projection onto the curved core shrinks a disc by some per cent; stretching restores its area.
    stretch = np.ones(len(centres))
    for trial in range(3):
        points = [centres]
        for share, count, turn in RINGS:
            angle = 2 * np.pi * (np.arange(count) + turn) / count
            flat = (
                np.cos(angle)[:, None] * along[:, None] + np.sin(angle)[:, None] * across[:, None]
            )
            way = (share * radius * stretch)[:, None, None] * flat
            points.append((centres[:, None] + way).reshape(-1, 3))
        laid = onto(core, np.concatenate(points), -recess)[0]
        if trial < 2:
            stretch *= np.sqrt(np.pi * radius**2 / _rim_areas(laid, len(centres)))
    return laid, disc, about


def _rim_areas(laid: Floats, count: int) -> Floats:
    """Area within the rim of each disc, from triangles around its centre [m^2]."""
    start = count * (1 + sum(ring[1] for ring in RINGS[:RIM]))
    rim = laid[start : start + count * RINGS[RIM][1]].reshape(count, -1, 3)
    middle = laid[:count, None]
    fan = np.cross(rim - middle, np.roll(rim, -1, axis=1) - middle)
    return np.asarray(np.linalg.norm(fan, axis=2).sum(axis=1) / 2)


def _lattice(edge: float) -> Floats:
    """Points on the ventral part of a capsule, about `edge` apart; rows are mirror-symmetric."""
    row = edge * np.sqrt(3) / 2
    rows = np.ceil(-BACK_X_M / row)
    barrel = np.linspace(BACK_X_M, 0.0, int(rows) + 1)
    cap = np.linspace(0.0, np.pi / 2, int(np.ceil(RADIUS_M * np.pi / 2 / row)) + 1)[1:]
    x = np.concatenate([barrel, RADIUS_M * np.sin(cap)])
    radius = np.concatenate([np.full(len(barrel), RADIUS_M), RADIUS_M * np.cos(cap)])
    points = []
    for number, (at, r) in enumerate(zip(x, radius, strict=True)):
        if r <= TOP_Z_M:  # the whole ring
            count = max(1, round(2 * np.pi * r / edge))
            angle = 2 * np.pi * (np.arange(count) + 0.5 * (number % 2)) / count
        else:
            widest = np.arccos(-TOP_Z_M / r)
            count = round(2 * widest * r / edge)
            angle = np.linspace(-widest, widest, count + 1)
            if number % 2:  # staggered, but its ends stay on the border
                middle = (angle[1:] + angle[:-1]) / 2
                angle = np.concatenate([angle[:1], middle, angle[-1:]])
        points.append(
            np.stack([np.full(len(angle), at), r * np.sin(angle), -r * np.cos(angle)], axis=1)
        )
    return np.concatenate(points)


def _triangles(points: Floats, edge: float) -> Ints:
    """Delaunay triangles in a conformal map of the capsule, which preserves their shapes."""
    x, y, z = points.T
    angle = np.arctan2(y, -z)
    polar = np.arctan2(np.hypot(y, z), np.maximum(x, 0.0))
    away = np.where(x < 0, np.exp(-x / RADIUS_M), np.tan(polar / 2))
    faces = Delaunay(away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).simplices
    corner = points[faces]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    # Across the open back of the capsule.
    keep = longest < max(2.5 * edge, LONGEST_M)
    keep &= corner[:, :, 2].mean(axis=1) < TOP_Z_M + 0.5 * edge
    faces, middle = faces[keep], corner[keep].mean(axis=1)
    middle[:, 0] = np.maximum(middle[:, 0], 0.0)
    inwards = np.einsum("fi,fi->f", face_vectors(points, faces), middle) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return _trimmed(points, _flipped(points, np.asarray(faces, np.int32)))


def _trimmed(points: Floats, faces: Ints) -> Ints:
    """The faces without the flat triangles that Delaunay leaves along a border."""
    while True:
        corner = points[faces]
        longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
        flat = np.linalg.norm(face_vectors(points, faces), axis=1) < 0.05 * longest**2
        count = len(points)
        loose = open_edges(faces).astype(np.int64)
        key = loose[:, 0] * count + loose[:, 1]
        own = faces.astype(np.int64) * count + np.roll(faces, -1, axis=1)
        outer = np.isin(own, key).any(axis=1)
        if not (flat & outer).any():
            return faces
        faces = faces[~(flat & outer)]


def _flipped(points: Floats, faces: Ints) -> Ints:
    """Flip edges until opposite angles add up to less than pi in space, not only in the map.

    Lawson (1977). Needed because the map is not conformal on the tip's facet.
    """
    faces = faces.copy()
    for _ in range(30):
        pairs = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
        key = pairs.min(axis=2).astype(np.int64) * len(points) + pairs.max(axis=2)
        order = np.argsort(key.ravel(), kind="stable")
        twice = np.flatnonzero(np.diff(key.ravel()[order]) == 0)
        one, other = order[twice], order[twice + 1]
        sides = points[pairs] - points[faces][:, :, None]
        cosine = np.einsum("fci,fci->fc", sides[:, :, 0], sides[:, :, 1])
        cosine /= np.linalg.norm(sides, axis=3).prod(axis=2)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0)).ravel()
        excess = angle[one] + angle[other] - np.pi
        worst = np.argsort(-excess)
        worst = worst[excess[worst] > 1e-6]
        if not len(worst):
            break
        taken = np.zeros(len(faces), bool)
        for i in worst:  # each triangle at most once in a round
            (f, a), (g, b) = divmod(int(one[i]), 3), divmod(int(other[i]), 3)
            if taken[f] or taken[g]:
                continue
            taken[[f, g]] = True
            top, left, right = faces[f, a], faces[f, (a + 1) % 3], faces[f, (a + 2) % 3]
            bottom = faces[g, b]
            faces[f], faces[g] = (top, left, bottom), (top, bottom, right)
    return faces
