"""Quality of solid meshes, and the check that one can be simulated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.mesh.surface import components, enclosed_volume, open_edges

# The three neighbours of each corner, in the order that makes their triple product positive.
HEXAHEDRON_CORNERS = (
    (1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3)
)  # fmt: skip
WEDGE_CORNERS = ((1, 2, 3), (2, 0, 4), (0, 1, 5), (5, 4, 0), (3, 5, 1), (4, 3, 2))
# A wedge with a regular base has triple product sin 60 deg at its corners: scaled to 1.
WEDGE_SCALE = 2.0 / np.sqrt(3.0)


def scaled_jacobians(nodes: Floats, elements: Ints) -> Floats:
    """Quality of each element: least triple product of unit edges over its corners, shape (E,).

    1 for a box or a wedge with a regular base; 0 or less if a corner is flat or inverted; -1 if an
    edge has no length.
    """
    corners = HEXAHEDRON_CORNERS if elements.shape[1] == 8 else WEDGE_CORNERS
    scale = 1.0 if elements.shape[1] == 8 else WEDGE_SCALE
    worst = np.full(len(elements), np.inf)
    for i, neighbours in enumerate(corners):
        here = nodes[elements[:, i]]
        a, b, c = (nodes[elements[:, j]] - here for j in neighbours)
        length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(c, axis=1)
        triple = np.einsum("ei,ei->e", np.cross(a, b), c)
        with np.errstate(divide="ignore", invalid="ignore"):
            here_scaled = np.where(length > 0, scale * triple / length, -1.0)
        worst = np.minimum(worst, here_scaled)
    return worst


# Faces of an element, normals outwards, by element size.
QUADS = {
    8: ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    6: ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
}
CAPS = ((0, 2, 1), (3, 4, 5))  # of a wedge
# A flatter element is degenerate: its Jacobian loses six digits.
LEAST_SCALED_JACOBIAN = 1e-6

FOLDED = "make the skin thinner or the edges longer: columns cross where the surface is bent"
DAMAGED = "build the mesh anew: its arrays do not belong together"


def check_mesh(mesh: SolidMesh) -> None:
    """Refuse a mesh that cannot be simulated; 0.1 s for 10,000 elements.

    Raises:
        SimulationError: Arrays of wrong shape, ids out of range, nodes that are not finite or not
            used, elements inverted or flat, a surface that is open, not the boundary of the solid
            or turned inside out, or a cavity without volume.
    """
    if not _well_formed(mesh):
        raise _refusal(mesh, "has arrays of the wrong shape or type", DAMAGED)
    _check_ids(mesh)
    _check_nodes(mesh)
    _check_elements(mesh)
    _check_boundary(mesh)


def _refusal(mesh: SolidMesh, problem: str, remedy: str) -> SimulationError:
    return SimulationError(f"mesh {mesh.name or 'without a name'} {problem}", remedy=remedy)


def _at(position: Floats) -> str:
    return "({:.3f}, {:.3f}, {:.3f}) mm".format(*(position * 1e3))


def _well_formed(mesh: SolidMesh) -> bool:
    """Whether all arrays have the right shape and type."""
    sides = {8: 4, 6: 3}.get(mesh.elements.shape[-1], 0)
    surfaces = ((mesh.outer_faces, mesh.outer_elements), (mesh.inner_faces, mesh.inner_elements))
    return (
        mesh.nodes.ndim == 2
        and mesh.nodes.shape[1] == 3
        and mesh.nodes.dtype == np.float64
        and mesh.elements.ndim == 2
        and sides > 0
        and len(mesh.elements) > 0
        and len(mesh.outer_faces) > 0
        and all(
            owner.ndim == 1
            and len(faces) == len(owner)
            and (not len(faces) or (faces.ndim == 2 and faces.shape[1] == sides))
            for faces, owner in surfaces
        )
        and mesh.fixed.ndim == 1
        and mesh.mirror.shape in ((0,), (len(mesh.nodes),))
        and all(
            np.issubdtype(ids.dtype, np.integer)
            for ids in (mesh.elements, mesh.fixed, mesh.mirror, *surfaces[0], *surfaces[1])
        )
    )


def _check_ids(mesh: SolidMesh) -> None:
    nodes, elements = len(mesh.nodes), len(mesh.elements)
    for name, limit in (
        ("elements", nodes),
        ("outer_faces", nodes),
        ("inner_faces", nodes),
        ("fixed", nodes),
        ("mirror", nodes),
        ("outer_elements", elements),
        ("inner_elements", elements),
    ):
        ids = getattr(mesh, name)
        wrong = ids[(ids < 0) | (ids >= limit)]
        if wrong.size:
            raise _refusal(mesh, f"has id {int(wrong[0])} in {name}, of only {limit}", DAMAGED)


def _check_nodes(mesh: SolidMesh) -> None:
    bad = np.flatnonzero(~np.isfinite(mesh.nodes).all(axis=1))
    if bad.size:
        raise _refusal(mesh, f"has {bad.size} nodes that are not finite, first {bad[0]}", DAMAGED)
    used = np.zeros(len(mesh.nodes), bool)
    used[mesh.elements] = True
    bad = np.flatnonzero(~used)
    if bad.size:
        where = _at(mesh.nodes[bad[0]])
        raise _refusal(
            mesh, f"has {bad.size} nodes of no element, first {bad[0]} at {where}",
            "leave out nodes that no element uses: they would float freely",
        )  # fmt: skip


def _check_elements(mesh: SolidMesh) -> None:
    quality = scaled_jacobians(mesh.nodes, mesh.elements)
    bad = np.flatnonzero(~(quality > LEAST_SCALED_JACOBIAN))
    if bad.size:
        worst = int(bad[quality[bad].argmin()])
        where = _at(mesh.nodes[mesh.elements[worst]].mean(axis=0))
        raise _refusal(
            mesh,
            f"has {bad.size} inverted or flat elements, worst element {worst} at {where} with "
            f"scaled Jacobian {quality[worst]:.3g}",
            FOLDED,
        )


def _check_boundary(mesh: SolidMesh) -> None:
    surfaces = {"outer": mesh.outer_faces, "inner": mesh.inner_faces}
    closed = len(mesh.inner_faces) > 0
    for name, faces in surfaces.items():
        loose = open_edges(faces) if closed else faces[:0]
        if len(loose):
            a, b = (int(i) for i in loose[0])
            where = _at(mesh.nodes[[a, b]].mean(axis=0))
            raise _refusal(
                mesh,
                f"has an open {name} surface: {len(loose)} edges without exactly one neighbour, "
                f"first between nodes {a} and {b} at {where}",
                "close the surface: a fluid cannot be held by an open one",
            )
    solid = _solid_boundary(mesh.elements)
    named = [(mesh.outer_faces, False), (mesh.inner_faces, True)]
    wanted = np.concatenate([_keys(f, turned) for f, turned in named if len(f)])
    missing = np.setdiff1d(wanted, solid)
    if len(missing) or len(np.unique(wanted)) != len(wanted):
        raise _refusal(
            mesh, f"names {len(missing)} faces that do not bound its elements, or are turned "
            "inside out, or names a face twice",
            "outer faces look away from the solid, inner ones away from the cavity",
        )  # fmt: skip
    if not closed:
        return
    if len(solid) != len(wanted):
        raise _refusal(
            mesh, f"has {len(solid) - len(wanted)} boundary faces of neither surface",
            "a skin with a cavity is bounded by its outer and inner surface only",
        )  # fmt: skip
    for name, faces in surfaces.items():
        parts = len(np.unique(components(faces, len(mesh.nodes))))
        if parts != 1:
            raise _refusal(mesh, f"has an {name} surface of {parts} parts", DAMAGED)
    cavity = enclosed_volume(mesh.nodes, mesh.inner_faces)
    if not cavity > 0:
        raise _refusal(
            mesh, f"has a cavity of {cavity * 1e9:.3g} mm^3", "turn the inner faces the other way"
        )


def _keys(faces: Ints, turned: bool = False) -> NDArray[np.void]:
    """Each face as one comparable value that does not depend on the node it starts with."""
    if turned:
        faces = faces[:, ::-1]
    first = faces.argmin(axis=1)
    around = (first[:, None] + np.arange(faces.shape[1])) % faces.shape[1]
    turned_faces = np.ascontiguousarray(np.take_along_axis(faces, around, axis=1), np.int64)
    return turned_faces.view(np.dtype((np.void, turned_faces.dtype.itemsize * faces.shape[1])))[
        :, 0
    ]


def _solid_boundary(elements: Ints) -> NDArray[np.void]:
    """Keys of the faces that belong to one element only.

    No surface may name a side of a wedge, which is a quad. One on the boundary is counted with a
    key that no triangle has.
    """
    kinds = [QUADS[8]] if elements.shape[1] == 8 else [CAPS, QUADS[6]]
    size = elements.shape[1] // 2
    found = []
    for table in kinds:
        faces = np.concatenate([elements[:, list(face)] for face in table])
        ordered = np.sort(faces, axis=1)
        _, index, times = np.unique(ordered, axis=0, return_index=True, return_counts=True)
        alone = faces[index[times == 1]]
        if alone.shape[1] != size and len(alone):
            alone = np.full((len(alone), size), -1, faces.dtype)
        found.append(_keys(alone[:, :size]))
    return np.concatenate(found)
