"""The public BioTac of NVlabs/biotac_sim (MIT) as a solid mesh of wedges, with its core.

The public tetrahedra lock (they inflate at twice the pressure), so only their *inner surface* is
used: the skin is extruded from it along smoothed normals. palpate ships none of these files.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from palpate.errors import ConfigError, SimulationError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.check import check_mesh
from palpate_fem.mesh.core import (
    DistanceGrid,
    RigidCore,
    box_around,
    grid_points,
    signed_distance,
    tabulate,
    volume_inside,
)
from palpate_fem.mesh.solid import FingertipGeometry, check_limits, extrude
from palpate_fem.mesh.surface import components, edges, enclosed_volume, node_normals, open_edges

REMEDY = "fetch the file anew from the NVlabs/biotac_sim repository, folder assets"


def read_tet(path: Path) -> tuple[Floats, Ints]:
    """Vertices ("v x y z w") and tetrahedra ("t a b c d", from 0) of a .tet file.

    Returns:
        Vertices [m], shape (V, 3), and node ids, shape (E, 4), both as in the file.

    Raises:
        ConfigError: The file cannot be read, holds no tetrahedron, or names an unknown vertex.
    """
    return _read(path, element="t", nodes=4, first=0)


def read_obj(path: Path) -> tuple[Floats, Ints]:
    """Vertices and triangles ("f a//n b//n c//n", from 1) of an .obj file; ids from 0.

    Raises:
        ConfigError: The file cannot be read, holds no triangle, or names an unknown vertex.
    """
    return _read(path, element="f", nodes=3, first=1)


def _read(path: Path, *, element: str, nodes: int, first: int) -> tuple[Floats, Ints]:
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except FileNotFoundError as error:
        raise ConfigError(f"there is no file {path}", remedy=REMEDY) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read as text: {error}", remedy=REMEDY) from error
    vertices: list[list[float]] = []
    elements: list[list[int]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == [element]:
                if len(words) != nodes + 1:
                    raise ValueError(f"{len(words) - 1} nodes where {nodes} are due")
                elements.append([int(word.partition("/")[0]) - first for word in words[1:]])
        except ValueError as error:
            raise ConfigError(f"{path}, line {number}: {error}", remedy=REMEDY) from error
    try:
        points, ids = np.array(vertices, np.float64), np.array(elements, np.int32)
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path} has rows of different lengths", remedy=REMEDY) from error
    if points.ndim != 2 or points.shape[1] != 3 or not ids.size:
        raise ConfigError(f"{path} holds no mesh: no complete 'v' or '{element}'", remedy=REMEDY)
    if ids.min() < 0 or ids.max() >= len(points):
        wrong = ids.min() if ids.min() < 0 else ids.max()
        raise ConfigError(
            f"{path} names vertex {int(wrong) + first} of {len(points)}", remedy=REMEDY
        )
    if not np.isfinite(points).all():
        raise ConfigError(f"{path} holds a vertex that is not finite", remedy=REMEDY)
    return points, ids


def boundary(tets: Ints, points: Floats) -> Ints:
    """Faces that belong to one tetrahedron only, normals away from the solid, shape (F, 3)."""
    corner = points[tets]
    volume = np.einsum(
        "ei,ei->e",
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]),
        corner[:, 3] - corner[:, 0],
    )
    tets = np.where((volume < 0)[:, None], tets[:, [0, 2, 1, 3]], tets)
    faces = np.concatenate(
        [tets[:, [1, 2, 3]], tets[:, [0, 3, 2]], tets[:, [0, 1, 3]], tets[:, [0, 2, 1]]]
    )
    key = np.sort(faces, axis=1).astype(np.int64) @ np.array([len(points) ** 2, len(points), 1])
    _, index, times = np.unique(key, return_index=True, return_counts=True)
    return np.ascontiguousarray(faces[np.sort(index[times == 1])], np.int32)


# Vertices [m], shape (P, 3), all in use; triangles, shape (Q, 3).
TriangleSurface = tuple[Floats, Ints]

SKIN = Path("meshes/biotac/int_ext_skin/int_ext_skin_combined_ftw.tet")
PARTS = Path("meshes/biotac/bc/top_side_core_bc.obj")

# Mesh axes (X proximal, Y dorsal, Z lateral) to the sensor frame: x = -X + X0, y = Z, z = Y.
# X0 is the centre of the sphere that fits the core's tip (radius 5.33 mm, r.m.s. 0.016 mm).
X0_M = -13.96e-3
DRAWN_THICKNESS_M = 1.57e-3  # of the public skin; decides what nail and clamp touch
ATTACH_M = 1e-5  # attachDistance of the public model: skin nearer than this is held
SMOOTHING = 4  # rounds; with fewer, columns cross at the proximal edge, more round it off
SPACING_M = 0.25e-3
MARGIN_M = 2.0e-3  # around the core: more than the fluid film is thick anywhere
ROUNDING_M = 0.15e-3  # standard deviation of the blur that rounds the core's facets
CLEARANCE_M = 15e-6  # least gap between core and unpressurised skin


def to_sensor_frame(points: Floats) -> Floats:
    """Positions [m] in the files' axes to the sensor frame, shape (N, 3)."""
    return np.ascontiguousarray(np.stack([X0_M - points[:, 0], points[:, 2], points[:, 1]], axis=1))


def read_nvlabs(
    folder: Path, *, thickness_m: float = 1.57e-3, layers: int = 2
) -> FingertipGeometry:
    """Build the fingertip from the public assets.

    Args:
        folder: Holds ``meshes/biotac``.
        thickness_m: Thickness of the skin [m].
        layers: Wedges through the thickness.

    Returns:
        Skin of wedges and core. The public core starts up to 0.2 mm inside the skin; here it is cut
        back to where it leaves at least a few micrometres everywhere (`CLEARANCE_M`).

    Raises:
        ConfigError: A file is missing or damaged, holds no closed bag or no closed core, nail and
            clamp; or an argument is out of range.
        SimulationError: The skin cannot be made so thick: elements would be inverted.
    """
    check_limits(thickness_m=thickness_m, layers=layers)
    points, tets = read_tet(folder / SKIN)
    points = to_sensor_frame(points)
    cavity, skin = _surfaces(points, boundary(tets, points), folder / SKIN)
    parts, triangles = read_obj(folder / PARTS)
    slabs, core = _parts(to_sensor_frame(parts), triangles, folder / PARTS)
    inner, faces = cavity
    normal = smooth_normals(inner, faces, SMOOTHING)
    held = _held(inner + DRAWN_THICKNESS_M * normal, skin, slabs)
    mesh = extrude(
        inner,
        inner + thickness_m * normal,
        faces,
        layers=layers,
        fixed_columns=held,
        name=f"nvlabs-{thickness_m * 1e3:.3f}mm-{layers}",
    )
    check_mesh(mesh)
    return FingertipGeometry(mesh, _core(core, cavity))


def files_digest(folder: Path) -> str:
    """Digest, hex, of the files that `read_nvlabs` reads.

    Raises:
        ConfigError: One cannot be read.
    """
    digest = hashlib.sha256()
    for path in (folder / SKIN, folder / PARTS):
        try:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        except OSError as error:
            raise ConfigError(f"{path} cannot be read: {error}", remedy=REMEDY) from error
    return digest.hexdigest()


def _compact(points: Floats, faces: Ints) -> TriangleSurface:
    """Some of a file's faces with only the vertices they use."""
    used, compact = np.unique(faces, return_inverse=True)
    return points[used], compact.reshape(-1, 3).astype(np.int32)


def _surfaces(points: Floats, faces: Ints, path: Path) -> tuple[TriangleSurface, TriangleSurface]:
    """Of the cavity, normals out of it, and of the skin's outside."""
    loose = open_edges(faces)
    if len(loose):
        raise ConfigError(f"{path}: its surface is open at {len(loose)} edges", remedy=REMEDY)
    label = components(faces, len(points))
    volumes = {int(i): enclosed_volume(points, faces[label == i]) for i in np.unique(label)}
    cavities = [i for i, volume in volumes.items() if volume < 0]
    if len(cavities) != 1:
        raise ConfigError(f"{path}: it has {len(cavities)} cavities, not one", remedy=REMEDY)
    cavity = label == cavities[0]
    return _compact(points, faces[cavity][:, ::-1]), _compact(points, faces[~cavity])


def _parts(
    points: Floats, faces: Ints, path: Path
) -> tuple[list[TriangleSurface], TriangleSurface]:
    """Nail and clamp, and the core."""
    label = components(faces, len(points))
    ids = np.unique(label)
    if len(ids) != 3 or len(open_edges(faces)):
        raise ConfigError(
            f"{path}: it holds {len(ids)} parts, not a closed nail, clamp and core", remedy=REMEDY
        )
    *slabs, core = sorted(ids, key=lambda i: enclosed_volume(points, faces[label == i]))
    return [_compact(points, faces[label == i]) for i in slabs], _compact(
        points, faces[label == core]
    )


def smooth_normals(points: Floats, faces: Ints, rounds: int) -> Floats:
    """Normals at the nodes, averaged with their neighbours', shape (V, 3)."""
    normal = node_normals(points, faces)
    pairs, _ = edges(faces)
    for _ in range(rounds):
        total = normal.copy()
        np.add.at(total, pairs[:, 0], normal[pairs[:, 1]] / 6)  # mean valence of a triangle mesh
        normal = total / np.linalg.norm(total, axis=1)[:, None]
    return normal


def _held(outer: Floats, skin: TriangleSurface, slabs: list[TriangleSurface]) -> Ints:
    """Columns that end where the public skin touches nail or clamp.

    The test point is the point of the public skin nearest to a column's outer node. The node itself
    lies up to 0.1 mm off the public skin, which would need a tolerance. The nearest vertex would be
    too coarse: vertices are 0.9 mm apart.
    """
    _, foot = signed_distance(outer, *skin)
    touching = [np.abs(signed_distance(foot, *slab)[0]) < ATTACH_M for slab in slabs]
    if not all(on_slab.any() for on_slab in touching):
        raise ConfigError("nail or clamp do not touch the skin", remedy=REMEDY)
    return np.flatnonzero(np.any(touching, axis=0)).astype(np.int32)


def _core(body: TriangleSurface, cavity: TriangleSurface) -> RigidCore:
    """The public core, cut back to a clearance from the skin, as a smooth distance."""
    from scipy import ndimage

    vertices, triangles = body
    inner, faces = cavity
    origin, size = box_around(vertices, MARGIN_M, SPACING_M)
    at = grid_points(origin, SPACING_M, size)
    core = tabulate(vertices, triangles, at)
    room = tabulate(inner, faces, at)
    corner = inner[faces]
    probes = np.concatenate(
        [inner, corner.mean(axis=1), (corner + np.roll(corner, 1, 1)).reshape(-1, 3) / 2]
    )
    # max() of two distances is the intersection of the bodies; the blur rounds its edges, which may
    # bring the core back towards the skin, so the clearance grows until the spline keeps it.
    clearance = CLEARANCE_M
    for _ in range(8):
        values = ndimage.gaussian_filter(np.maximum(core, room + clearance), ROUNDING_M / SPACING_M)
        grid = DistanceGrid.sampled(origin, SPACING_M, values)
        gap = float(grid.evaluate(probes)[0].min())
        if gap > 0.9 * CLEARANCE_M:
            return RigidCore(grid, vertices, triangles, volume_inside(values, SPACING_M), "nvlabs")
        clearance += CLEARANCE_M - gap
    raise SimulationError(
        f"the core cannot be cut back: it still starts {-gap * 1e6:.1f} um inside the skin",
        remedy="check that skin and core belong to the same assets",
    )
