"""One contact surface of many copies of a fingertip; see ``contact`` and ``mortar``."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from palpate_fem.batched import mortar_kernels
from palpate_fem.batched.launches import Launches
from palpate_fem.batched.state import on_device
from palpate_fem.mechanics import contact_kernels
from palpate_fem.mechanics.contact import ContactSurface


class BatchedSurface:
    """One surface of all copies: constants of one, results and frozen values of each."""

    def __init__(
        self, surface: ContactSurface, nodes: int, slots: int, device: str, *, rubs: bool
    ) -> None:
        """Make room; without friction, unless it ``rubs``, what belongs to it stays zero."""
        self._each, self._launches = nodes, Launches(device)

        def room(kind: type, *shape: int) -> wp.array:
            return wp.zeros(shape, dtype=kind, device=device)

        # A face has as many quadrature points as corners, which are its contact points.
        self.count, self.points = surface.count, surface.points
        faces = surface.faces.numpy()
        self.faces = on_device(faces, wp.int32, device)
        self.pairs = on_device(surface.pairs.numpy(), wp.int32, device)
        self.shape = on_device(surface.shape_values, wp.float64, device)
        self.area = on_device(surface.area_values, wp.float64, device)
        mortar = surface.mortar
        self.mortar_shape = on_device(mortar.shape, wp.float64, device)
        self.weight = on_device(mortar.weight, wp.float64, device)
        self.corner_area = on_device(mortar.corner_area, wp.float64, device)
        self.node_area = on_device(mortar.area, wp.float64, device)
        self.nodes = on_device(np.unique(faces).astype(np.int32), wp.int32, device)
        points = self.points
        size = (slots * self.count, points)
        self.status, self.frozen_status = room(wp.int32, *size), room(wp.int32, *size)
        self.gap, self.wanted = room(wp.float64, *size), room(wp.float64, *size)
        self.slope, self.frozen_slope = room(wp.vec3d, *size), room(wp.vec3d, *size)
        self.misfit, self.coupled = room(wp.vec3d, *size), room(wp.vec3d, *size)
        self.tangent = room(wp.mat33d, *size)
        self.wanted_traction = room(wp.vec3d, *size)
        self.traction_slope = room(wp.mat33d, *size)
        self.frozen_traction_slope = room(wp.mat33d, *size)
        self.unsymmetric, self.frozen_unsymmetric = room(wp.mat33d, *size), room(wp.mat33d, *size)
        self.target, self.target_traction = room(wp.float64, *size), room(wp.vec3d, *size)
        self.mortar_status, self.mortar_tangent = room(wp.int32, *size), room(wp.mat33d, *size)
        self.offset = room(wp.float64, *size)
        self.outward, self.held = room(wp.vec3d, *size), room(wp.vec3d, *size)
        self.node_gap, self.node_mean = (
            room(wp.float64, slots * nodes),
            room(wp.float64, slots * nodes),
        )
        self.node_normal = room(wp.vec3d, slots * nodes)
        self.offset_change = room(wp.float64, slots, nodes)
        self.force = room(wp.vec3d, slots * nodes)
        self.results = [
            self.status, self.gap, self.wanted, self.slope, self.misfit, self.tangent,
        ]  # fmt: skip
        self.frozen = [
            (self.status, self.frozen_status, points),
            (self.slope, self.frozen_slope, 3 * points),
        ]
        if rubs:
            self.frozen += [
                (self.traction_slope, self.frozen_traction_slope, 9 * points),
                (self.unsymmetric, self.frozen_unsymmetric, 9 * points),
            ]

    def offset_gaps(self, items: wp.array, margin: wp.float64) -> None:
        """Set what the mean gaps of listed faces add to those of their nodes."""
        self._launch(
            mortar_kernels.gap_offsets,
            items,
            [self.faces, self._each, items, margin, self.node_area, self.node_gap, self.node_mean],
            [self.offset],
        )

    def add_spread(
        self,
        items: wp.array,
        margin: wp.float64,
        pressure: wp.array,
        change: wp.array | None,
        field: wp.array,
    ) -> None:
        """Add mortar's loads at neighbours to a nodal field; see `MortarCorrection.load`.

        Args:
            items: Faces.
            margin: Gap from which on a node cannot touch [m].
            pressure: Of the present state [Pa].
            change: Of the nodes: loads that follow it. None = minus what the loads lack.
            field: Takes the loads [N].
        """
        self._launch(
            mortar_kernels.spread_load,
            items,
            [self.faces, self.mortar_shape, self.weight, self.corner_area, self._each, items,
             margin, self.node_gap, self.node_normal, self.outward, self.frozen_slope, self.status,
             self.wanted, pressure, field if change is None else change, int(change is not None)],
            [field],
        )  # fmt: skip

    def add_offset_changes(self, items: wp.array, margin: wp.float64, moved: wp.array) -> None:
        """Add to ``offset_change`` how a change of the nodes changes the offsets of their gaps."""
        self._launch(
            mortar_kernels.offset_changes,
            items,
            [self.faces, self.mortar_shape, self.weight, self.corner_area, self.node_area,
             self._each, items, margin, self.node_gap, self.node_normal, self.outward, moved],
            [self.offset_change],
        )  # fmt: skip

    def add_offset_load(self, items: wp.array, field: wp.array) -> None:
        """Add the forces by which touching points resist ``offset_change`` to a nodal field."""
        self._launch(
            mortar_kernels.offset_load,
            items,
            [self.faces, self.area, self._each, items, self.frozen_slope, self.offset_change],
            [field],
        )

    def move_along_normals(self, items: wp.array, moved: wp.array, field: wp.array) -> None:
        """Add ``offset_change``, along the normals, to a change of the nodes; into a copy of it."""
        self._launch(
            mortar_kernels.move_along_normals,
            items,
            [self.faces, self._each, items, self.frozen_slope, self.offset_change, moved],
            [field],
        )

    def add_tangent(self, items: wp.array, blocks_each: int, blocks: wp.array) -> None:
        """Add the symmetric tangents of touching points."""
        for shape, status, tangent in (
            (self.shape, self.status, self.tangent),
            (self.mortar_shape, self.mortar_status, self.mortar_tangent),
        ):
            self._launch(
                contact_kernels.point_tangent,
                items,
                [shape, self.pairs, blocks_each, items, status, tangent],
                [blocks],
            )

    def subtract_load(self, items: wp.array, load: wp.array, field: wp.array) -> None:
        """Subtract a load at the contact points from a nodal field."""
        self._launch(
            contact_kernels.subtract_load,
            items,
            [self.faces, self.shape, self._each, items, load],
            [field],
        )

    def set_targets(self, items: wp.array, moved: wp.array) -> None:
        """Pressures and tractions after a change of the nodes, to first order."""
        self._launch(
            contact_kernels.pressure_update,
            items,
            [self.faces, self.shape, self._each, items, self.status, self.wanted,
             self.frozen_slope, self.wanted_traction, self.frozen_traction_slope, moved],
            [self.target, self.target_traction],
        )  # fmt: skip

    def _launch(
        self, kernel: Any, items: wp.array, inputs: list[Any], outputs: list[wp.array]
    ) -> None:
        self._launches(kernel, len(items), inputs, outputs)
