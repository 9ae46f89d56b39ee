"""Fields as coloured skins. With ``view`` and ``blueprint`` the only place that knows Rerun."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.field_mesh import FieldMesh
from palpate.messages import FloatArray
from palpate_services.blueprint import FIELD_FULL_M
from palpate_services.field_scene import FieldRow
from palpate_services.meshes import MeshLibrary
from palpate_services.simulation_view_surface import normals_of, shades

Send = Callable[[str, list[Any], Iterable[Any]], None]


class _Skin:
    """The outside of a mesh with its own numbering: nodes inside would only fill the file."""

    def __init__(self, mesh: FieldMesh) -> None:
        used, triangles = np.unique(mesh.outer_faces, return_inverse=True)
        self.used: npt.NDArray[np.int32] = used
        self.triangles = triangles.reshape(-1, 3).astype(np.int32)
        self.rest: FloatArray = mesh.nodes[used]


class FieldDrawer:
    """Draws fields on the skins of their meshes.

    ``counters``: ``view_no_mesh`` (fields of a mesh that no bundle holds), ``view_wrong_mesh``
    (fields with another number of nodes than their mesh).

    Args:
        rr: Rerun.
        stream: Where the parts go that do not change.
        send: Sends columns of an entity at the times of rows.
        meshes: Where meshes are found.
    """

    def __init__(self, rr: Any, stream: Any, send: Send, meshes: MeshLibrary) -> None:
        self.counters: Counter[str] = Counter()
        self._rr = rr
        self._stream = stream
        self._send = send
        self._meshes = meshes
        self._skins: dict[bytes, _Skin] = {}
        self._begun: set[str] = set()

    def draw(self, entity: str, rows: list[FieldRow]) -> None:
        """Draw the fields of one stream.

        Args:
            entity: Where, below it one entity for each mesh.
            rows: Fields in order of time.
        """
        for sha256, group in groupby(rows, key=lambda row: row.mesh_sha256):
            same = list(group)
            mesh = self._meshes.find(sha256)
            if mesh is None:
                self.counters["view_no_mesh"] += len(same)
                continue
            fitting = [row for row in same if row.displacement.shape == mesh.nodes.shape]
            if len(fitting) < len(same):
                self.counters["view_wrong_mesh"] += len(same) - len(fitting)
            if fitting:
                self._draw(f"{entity}/{sha256.hex()[:8]}", mesh, fitting)

    def _draw(self, entity: str, mesh: FieldMesh, rows: list[FieldRow]) -> None:
        skin = self._skins.get(mesh.sha256)
        if skin is None:
            skin = self._skins[mesh.sha256] = _Skin(mesh)
        rr = self._rr
        if entity not in self._begun:
            self._begun.add(entity)
            # Normals of the untouched skin: those of each field would nearly double the file.
            fixed = rr.Mesh3D.from_fields(
                triangle_indices=skin.triangles,
                vertex_normals=normals_of(skin.rest, skin.triangles),
            )
            self._stream.log(entity, fixed, static=True)
        moved = np.stack([row.displacement[skin.used] for row in rows])
        colours = shades(np.linalg.norm(moved, axis=2) / FIELD_FULL_M)
        columns = rr.Mesh3D.columns(
            vertex_positions=(skin.rest + moved).reshape(-1, 3), vertex_colors=colours.reshape(-1)
        )
        self._send(entity, rows, columns.partition([len(skin.used)] * len(rows)))
