"""One surface of the mesh, with what contact leaves at its points."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.device import DEVICE, scalars, vec3s
from palpate_fem.mechanics import contact_kernels
from palpate_fem.mechanics.reference_element import corner_element, face_element

Floats = NDArray[np.float64]


class Surface:
    """One surface of the mesh, with what contact leaves at its quadrature points."""

    def __init__(self, nodes: Floats, faces: NDArray[np.int32], pairs: NDArray[np.int32]) -> None:
        self.count = len(faces)
        corners = faces.shape[1] if faces.ndim == 2 else 3
        self.points = corners
        element = corner_element(corners)
        self.shape_values = element.shape
        self._corners = faces.reshape(-1, corners)
        self.area_values = self.current_area(nodes)
        size = self.area_values.shape
        self.gap, self._wanted = np.full(size, np.inf), np.zeros(size)
        self._wanted_traction = np.zeros((*size, 3))
        self.faces = wp.array(faces.reshape(-1, corners), dtype=wp.int32, device=DEVICE)
        self.pairs = wp.array(pairs.reshape(-1, corners, corners), dtype=wp.int32, device=DEVICE)
        self.shape, self.area = scalars(element.shape), scalars(self.area_values)
        self.status = wp.zeros(size, dtype=wp.int32, device=DEVICE)
        self.gap_array, self.wanted_array = scalars(self.gap), scalars(self._wanted)
        self.wanted_traction_array = vec3s(self._wanted_traction)
        self.slope = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.traction_slope = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self.misfit = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.tangent = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self.coupled = wp.zeros(size, dtype=wp.vec3d, device=DEVICE)
        self.rest = wp.zeros(size, dtype=wp.mat33d, device=DEVICE)
        self._freezing = (self.slope, self.traction_slope, self.status, self.rest)
        self._frozen = [wp.clone(array) for array in self._freezing]
        self._sliding = wp.zeros(0, dtype=wp.int32, device=DEVICE)

    @property
    def model(self) -> list[wp.array]:
        """What every contact kernel takes first."""
        return [self.faces, self.shape, self.area]

    @property
    def results(self) -> list[wp.array]:
        """What every contact kernel fills."""
        return [
            self.status,
            self.gap_array,
            self.wanted_array,
            self.slope,
            self.misfit,
            self.tangent,
        ]

    def freeze(self) -> None:
        """Keep what belongs to the tangent that is being factorised."""
        for kept, now in zip(self._frozen, self._freezing, strict=True):
            wp.copy(kept, now)
        rest = self.rest.numpy().reshape(self.count, 9 * self.points)
        sliding = np.flatnonzero(np.any(rest != 0.0, axis=1)).astype(np.int32)
        self._sliding = wp.array(sliding, dtype=wp.int32, device=DEVICE)

    @property
    def slides(self) -> bool:
        """Whether the frozen tangent has an unsymmetric share."""
        return len(self._sliding) > 0

    def add_tangent(self, blocks: wp.array) -> None:
        """Add the symmetric tangents of the points that touch."""
        if self.count:
            wp.launch(
                contact_kernels.point_tangent,
                dim=self.count,
                inputs=[self.shape, self.pairs, self.status, self.tangent],
                outputs=[blocks],
                device=DEVICE,
            )

    def add_rest_product(self, change: wp.array, product: wp.array) -> None:
        """Add the frozen unsymmetric share times a change of the nodes."""
        wp.launch(
            contact_kernels.rest_product,
            dim=len(self._sliding),
            inputs=[self.faces, self.shape, self._sliding, self._frozen[3]],
            outputs=[change, product],
            device=DEVICE,
        )

    @property
    def changed(self) -> bool:
        """Whether any point's status differs from the frozen one."""
        return not np.array_equal(self._frozen[2].numpy(), self.status.numpy())

    def forget(self) -> None:
        """Nothing is near."""
        self.gap[:] = np.inf
        self._wanted[:] = 0.0
        self._wanted_traction[:] = 0.0
        for array in (
            self.status,
            self.slope,
            self.traction_slope,
            self.misfit,
            self.tangent,
            self.coupled,
            self.rest,
        ):
            array.zero_()

    def misfit_of(self, pressure: Floats) -> float:
        """Largest difference of pressures from what the law wants [Pa]."""
        return float(np.abs(self._wanted - pressure).max()) if self.count else 0.0

    def traction_misfit(self, traction: Floats) -> float:
        """Largest difference of tractions from what friction wants [Pa]."""
        return float(np.abs(self._wanted_traction - traction).max()) if self.count else 0.0

    def updated_pressure(self, moved: wp.array) -> tuple[Floats, Floats]:
        """Pressures (F, Q) and tractions (F, Q, 3) after a change of the nodal positions [Pa]."""
        pressure = np.zeros(self.area_values.shape)
        traction = np.zeros((*pressure.shape, 3))
        if self.count:
            wp.launch(
                contact_kernels.pressure_update,
                dim=self.count,
                inputs=[
                    self.faces,
                    self.shape,
                    self.status,
                    self.wanted_array,
                    self._frozen[0],
                    self.wanted_traction_array,
                    self._frozen[1],
                    moved,
                ],
                outputs=[scalars(pressure), vec3s(traction)],
                device=DEVICE,
            )
        return pressure, traction

    def add_load(self, load: wp.array, force: wp.array) -> None:
        """Subtract a load at the points (F, Q) from nodal forces."""
        if self.count:
            wp.launch(
                contact_kernels.misfit_force,
                dim=self.count,
                inputs=[self.faces, self.shape, load],
                outputs=[force],
                device=DEVICE,
            )

    def points_at(self, position: Floats) -> Floats:
        """Where the contact points are [m], (F, Q, 3)."""
        return np.asarray(np.einsum("qa,fai->fqi", self.shape_values, position[self._corners]))

    def current_area(self, position: Floats) -> Floats:
        """Area that belongs to each corner, the integral of its shape function [m^2], (F, Q).

        The Jacobian at the corner itself would do on squares only: on distorted faces it is not the
        corner's share, and an even pressure would push unevenly.
        """
        element = face_element(self.points)
        edges = np.einsum("qad,fai->fqdi", element.gradient, position[self._corners])
        size = np.linalg.norm(np.cross(edges[:, :, 0], edges[:, :, 1]), axis=2)
        return np.asarray(np.einsum("q,fq,qa->fa", element.weight, size, element.shape))
