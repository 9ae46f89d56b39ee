"""One converged increment, linearised with its complete derivative.

With displacements u from the mesh's own positions X, so that x = X + u, an increment solves::

    R_x = f(x) - p_f b(x) - F_o - F_i = 0        forces of skin, fluid, indenter and core
    R_v = V(x) - V_fluid = 0                     the fluid is sealed
    R_p = g^_I(x) + p_I / e = 0                  each touching node I of both surfaces

for z = (u at the free unknowns, p_f, p_I). The indenter's force is F_o = B(x) p - W T(x, p, a): the
pressures p_I where the faces are (B_I = A_I dg^_I/dx, ``mortar``), and the tractions T at the
nodes, which follow from positions, pressures and the anchors a by the return mapping. Element
pressures are condensed. What the next increment takes over from this one is its anchors.

Newton's method in ``newton`` does not need the complete derivative; here it is. It couples nodes
two faces apart, and sliding friction makes it unsymmetric. GMRES solves it or its transpose with
two preconditioners in turn. First the factor of the symmetric tangent, with the pressures as
unknowns of their own: so contact's stiff law is eliminated, and only the directions of the gaps'
gradients differ, by the turn of the normal within a face. Then the complete derivative of the few
unknowns around the contact, where that difference is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, gcrotmk, splu

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.mechanics.contact import ContactSurface, PosedIndenter
from palpate_fem.mechanics.state import MortarCorrection, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.sparse.factor import SparseFactor

ACCURACY, ENOUGH = 1e-10, 1e-8
"""What a solution leaves over of its right side, and what it may; rounding errors leave 1e-11."""

SEARCH, KEPT, ROUNDS = 60, 20, 4
"""Products of a round of GMRES, directions kept from one to the next, and most rounds."""

PATCH_LAYERS = 2
"""Elements around the loaded nodes in the patch: 2 save four of five products of GMRES."""


@dataclass(frozen=True, slots=True)
class Traction:
    """Friction of m touching nodes on the indenter by the return mapping, with its derivatives.

    Attributes:
        value: T [Pa], (m, 3); the skin feels -T.
        by_position: With the anchors fixed [Pa/m], (m, 3, 3).
        by_arm: With the normals fixed, too: minus the derivative by the anchors [Pa/m], (m, 3, 3).
        by_pressure: (m, 3).
        by_friction: By the coefficient [Pa], (m, 3).
    """

    value: Floats
    by_position: Floats
    by_arm: Floats
    by_pressure: Floats
    by_friction: Floats

    @classmethod
    def of(
        cls,
        arm: Floats,
        normal: Floats,
        curvature: Floats,
        pressure: Floats,
        *,
        friction: float,
        stiffness: float,
    ) -> Traction:
        """Traction of nodes at ``arm`` (m, 3) from their anchors.

        Args:
            arm: From the anchor to the node [m], (m, 3).
            normal: Gradient of the distance, (m, 3).
            curvature: Its second derivative [1/m], (m, 3, 3).
            pressure: Contact pressures [Pa], (m,).
            friction: Coulomb coefficient.
            stiffness: Of a sticking point [Pa/m].
        """
        along = np.einsum("mi,mi->m", normal, arm)
        way = arm - along[:, None] * normal
        flat = np.eye(3) - normal[:, :, None] * normal[:, None, :]
        turned = np.einsum("mij,mj->mi", curvature, arm)
        turn = flat - along[:, None, None] * curvature - normal[:, :, None] * turned[:, None, :]
        length = np.linalg.norm(way, axis=1)
        limit = friction * pressure
        slides = stiffness * length > limit
        toward = way / np.maximum(length, 1e-30)[:, None]
        share = np.where(slides, limit / np.maximum(length, 1e-30), stiffness)
        left = share[:, None, None] * (
            np.eye(3) - slides[:, None, None] * toward[:, :, None] * toward[:, None, :]
        )
        sliding = np.where(slides[:, None], toward, 0.0)
        return cls(
            share[:, None] * way,
            left @ turn,
            left @ flat,
            friction * sliding,
            pressure[:, None] * sliding,
        )


class SurfaceContact:
    """What touches on one surface: m nodes, their pressures, and the force's derivatives.

    Attributes:
        nodes: Touching nodes, (m,).
        area: Undeformed area of each [m^2], (m,).
        pressure: [Pa], (m,).
        normal: Gradients of the distance, (m, 3).
        curvature: Its second derivatives [1/m], (m, 3, 3).
        by_pressure: B of the force on the skin [m^2], sparse (3 V, m).
        by_position: The force's derivative at constant pressures, friction left out [N/m], sparse
            (3 V, 3 V).
        plain: The same if the pressures acted at their nodes, sparse (3 V, m).
        at_nodes: What contact of touching nodes adds to the factorised tangent that is in neither
            of them: stiffness of the law, and friction [N/m], sparse (3 V, 3 V).
    """

    def __init__(
        self,
        surface: ContactSurface,
        faces: Ints,
        correction: MortarCorrection,
        pressure: Floats,
        curved: Callable[[Floats], tuple[Floats, Floats]],
        state: SolutionState,
        *,
        mortar: bool,
    ) -> None:
        """From a surface whose contact was evaluated at the state.

        Args:
            surface: With the results of its kernels.
            faces: Node ids, (F, k).
            correction: Evaluated at the same state.
            pressure: Of the contact points [Pa], (F, k).
            curved: Gradients and second derivatives of the distance to the other body, at points.
            state: Where it was evaluated.
            mortar: Whether the pressure acts at the faces' quadrature points.
        """
        self._faces, size = faces, len(state.position)
        touching = surface.status.numpy() > 0
        self.nodes = np.unique(faces[touching])
        count = len(self.nodes)
        self.area = np.bincount(faces.ravel(), surface.area_values.ravel(), size)[self.nodes]
        self.pressure = self.at_node(pressure)
        self.normal, self.curvature = curved(state.position[self.nodes])
        number = np.full(size, -1)
        number[self.nodes] = np.arange(count)
        corner = number[faces.ravel()]
        known = np.flatnonzero(corner >= 0)
        collect = sparse.csr_array(
            (np.ones(len(known)), (known, corner[known])), shape=(faces.size, count)
        )
        self.plain = _columns(self.nodes, self.area[:, None] * self.normal, size)
        self.by_pressure = (self.plain + correction.spread @ collect).tocsr()
        turn = -(self.area * self.pressure)[:, None, None] * self.curvature
        tangent = np.where(touching[..., None, None], surface.tangent.numpy(), 0.0)
        nodal = np.zeros((size, 3, 3))
        np.add.at(nodal, faces, tangent)
        if mortar:
            loaded = np.where(
                (surface.mortar_status.numpy() > 0)[..., None, None],
                surface.mortar_tangent.numpy(),
                0.0,
            )
            some = np.flatnonzero(np.any(loaded != 0.0, axis=(1, 2, 3)))
            shape = surface.mortar.shape
            blocks = np.einsum("qa,qb,fqij->fabij", shape, shape, loaded[some])
            self.by_position = -_face_matrix(faces[some], blocks, size)
            self.at_nodes = _block_diagonal(self.nodes, nodal[self.nodes], size)
        else:
            self.by_position = -_block_diagonal(self.nodes, turn, size)
            self.at_nodes = _block_diagonal(self.nodes, nodal[self.nodes] - turn, size)

    def at_node(self, values: Floats) -> Floats:
        """Values of contact points (F, k, ...) at the touching nodes, (m, ...)."""
        flat = values.reshape(self._faces.size, *values.shape[2:])
        first = np.zeros(int(self._faces.max(initial=0)) + 1, np.intp)
        first[self._faces.ravel()] = np.arange(self._faces.size)
        return np.asarray(flat[first[self.nodes]])

    @property
    def gaps(self) -> sparse.csr_array:
        """Gradients of the touching nodes' gaps, sparse (m, 3 V)."""
        return (self.by_pressure @ sparse.diags_array(1.0 / self.area)).T.tocsr()


def _block_diagonal(nodes: Ints, blocks: Floats, size: int) -> sparse.csr_array:
    """Blocks (m, 3, 3) at nodes (m,) as a sparse matrix over ``size`` nodes, (3 V, 3 V)."""
    return _face_matrix(nodes[:, None], blocks[:, None, None], size)


def _columns(nodes: Ints, vectors: Floats, size: int) -> sparse.csr_array:
    """Vectors (m, 3) at nodes (m,), each in a column of its own, over ``size`` nodes, (3 V, m)."""
    rows = (3 * nodes[:, None].astype(np.int64) + np.arange(3)).ravel()
    columns = np.repeat(np.arange(len(nodes)), 3)
    return sparse.coo_array(
        (vectors.ravel(), (rows, columns)), shape=(3 * size, len(nodes))
    ).tocsr()


def _face_matrix(cells: Ints, blocks: Floats, size: int) -> sparse.csr_array:
    """Blocks (C, k, k, 3, 3) of cells (C, k) as a sparse matrix over ``size`` nodes."""
    at = 3 * cells[:, :, None].astype(np.int64) + np.arange(3)
    rows = np.broadcast_to(at[:, :, None, :, None], blocks.shape)
    columns = np.broadcast_to(at[:, None, :, None, :], blocks.shape)
    return sparse.coo_array(
        (blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * size, 3 * size)
    ).tocsr()


class LinearisedIncrement:
    """The equations of one increment around its solution.

    Vectors over nodes are flat, (3 V,). Solutions and right sides are those of z, (n + 1 + m,):
    free unknowns, fluid pressure, pressures of the nodes that touch the indenter, then the core.

    Attributes:
        outer: Contact with the indenter.
        inner: Contact with the core.
        traction: Friction with the indenter.
        on_indenter: Force of the indenter on the skin [N], (V, 3).
        on_core: Force of the core on the skin [N], (V, 3).
        outer_by_position: Its derivative by all nodes' positions, friction included, sparse.
        outer_by_pressure: Its derivative by the pressures on the indenter, friction included.
        outer_by_anchor: Its derivative by the anchors in the indenter's frame, sparse (3 V, 3 V).
        outer_by_friction: By the coefficient, (3 V,).
    """

    def __init__(
        self,
        system: EquilibriumSystem,
        factor: SparseFactor,
        state: SolutionState,
        indenter: PosedIndenter | None,
        anchor: Floats,
    ) -> None:
        """Linearise and factorise.

        Args:
            system: The equations. Its last tangent is replaced.
            factor: Of the system's pattern.
            state: The solution.
            indenter: At its pose; None = none.
            anchor: Anchors that the increment began with, (outer faces, points, 3).
        """
        self.system, self.indenter, self._factor = system, indenter, factor
        state = state.copy()
        system.correct_contact(state, indenter)
        # Directions are held within an increment, but follow the state from one correction to the
        # next, the last of which is near the solution.
        follows = np.zeros_like(state.on_indenter.held)
        state.on_indenter = replace(state.on_indenter, held=follows)
        balance = system.balance(state, indenter)
        self.state = state
        self.on_indenter, self.on_core = -balance.indenter, -balance.core
        values = system.tangent_values()
        factor.factorise(values)
        mesh, pattern, mortar = system.mesh, system.pattern, system.contact.mortar
        core = system.on_core.core
        self.outer = SurfaceContact(
            system.outer, mesh.outer_faces, state.on_indenter, state.indenter_pressure,
            indenter.curved if indenter else _nowhere, state, mortar=mortar,
        )  # fmt: skip
        self.inner = SurfaceContact(
            system.inner, mesh.inner_faces, state.on_core, state.core_pressure,
            (lambda points: core.evaluate(points)[1:]) if core else _nowhere, state, mortar=mortar,
        )  # fmt: skip
        self._add_friction(anchor)
        self._assemble(values, balance.volume_gradient.reshape(-1)[pattern.free])

    def _add_friction(self, anchor: Floats) -> None:
        """Evaluate the tractions, and what they add to the indenter's force."""
        outer, indenter, size = self.outer, self.indenter, len(self.state.position)
        nodes, area = outer.nodes, outer.area
        if indenter is None:
            none, blocks = np.zeros((0, 3)), np.zeros((0, 3, 3))
            self.traction = Traction(none, blocks, blocks, none, none)
            rotation = np.eye(3)
        else:
            rotation = indenter.rotation
            self.traction = Traction.of(
                self.state.position[nodes] - indenter.tip - outer.at_node(anchor) @ rotation.T,
                outer.normal,
                outer.curvature,
                outer.pressure,
                friction=indenter.friction,
                stiffness=self.system.contact.tangential_stiffness,
            )
        rub = self.traction
        self.traction_by_position = _block_diagonal(nodes, rub.by_position, size)
        self.traction_by_anchor = _block_diagonal(nodes, -rub.by_arm @ rotation, size)
        self.traction_by_pressure = _columns(nodes, rub.by_pressure, size)
        self.traction_by_friction = _columns(nodes, rub.by_friction, size).sum(axis=1)
        share = np.zeros(size)
        share[nodes] = area
        weight = sparse.diags_array(np.repeat(share, 3))
        self.outer_by_position = outer.by_position - weight @ self.traction_by_position
        self.outer_by_pressure = outer.by_pressure - weight @ self.traction_by_pressure
        self.outer_by_anchor = -(weight @ self.traction_by_anchor)
        self.outer_by_friction = -(weight @ self.traction_by_friction)

    def _assemble(self, values: Floats, gradient: Floats) -> None:
        """The parts of the complete derivative, and scales that make it free of units."""
        system, free = self.system, self.system.pattern.free
        pattern, outer, inner = system.pattern, self.outer, self.inner
        count = len(free)
        # Contact's law and friction are taken out of the tangent, where they act at the nodes.
        contact = -outer.at_nodes - inner.at_nodes + outer.by_position - self.outer_by_position
        contact = contact[free][:, free]
        upper = sparse.csr_array((values, pattern.indices, pattern.indptr), shape=(count, count))
        self._upper, self._lower = upper, upper.T
        # Each row of the triangle begins with its diagonal, which would count twice.
        contact -= sparse.diags_array(values[pattern.indptr[:-1]])
        self._rest, self._rest_transposed = contact.tocsr(), contact.T.tocsr()
        self._volume = gradient
        self._force = sparse.hstack(
            [self.outer_by_pressure[free], inner.by_pressure[free]], format="csr"
        )
        self._plain = sparse.hstack([outer.plain[free], inner.plain[free]], format="csr")
        self._gap = sparse.vstack([outer.gaps[:, free], inner.gaps[:, free]], format="csr")
        self._area = np.concatenate([outer.area, inner.area])
        self._stiffness = system.contact.stiffness
        mu, edge = system.skin.mu, float(np.cbrt(system.skin.rest_volume.mean()))
        size = count + 1 + len(self._area)
        self._unknown, self._equation = np.full(size, mu), np.full(size, edge)
        self._unknown[:count], self._equation[:count] = edge, mu * edge**2
        self._equation[count] = edge**3
        self._border = np.asarray(self._factor.solve(gradient))
        self._factorise_patch()

    def _factorise_patch(self) -> None:
        """Factorise the complete derivative of the unknowns around the contact."""
        count, touching = len(self._volume), len(self._area)
        loaded = np.unique((self._force + self._plain).tocoo().coords[0])
        mesh = self.system.mesh
        nodes = np.unique(self.system.pattern.free[loaded] // 3)
        for _ in range(PATCH_LAYERS):
            nodes = np.unique(mesh.elements[np.isin(mesh.elements, nodes).any(axis=1)])
        inside = np.flatnonzero(np.isin(self.system.pattern.free // 3, nodes))
        self._patch = np.concatenate([inside, count + 1 + np.arange(touching)])
        if not touching:
            return
        half = self._upper[inside][:, inside]
        matrix = sparse.block_array(
            [
                [half + half.T + self._rest[inside][:, inside], -self._force[inside]],
                [self._gap[:, inside], sparse.eye_array(touching) / self._stiffness],
            ]
        )
        scaled = (
            sparse.diags_array(1.0 / self._equation[self._patch])
            @ matrix
            @ sparse.diags_array(self._unknown[self._patch])
        )
        self._patch_factor = splu(scaled.tocsc())

    def solve(self, right: Floats) -> Floats:
        """Solution of R_z z = right.

        Raises:
            SimulationError: The linear solve does not converge.
        """
        scaled = self._iterate(
            lambda z: self.product(self._unknown * z) / self._equation,
            lambda r: self._precondition(self._equation * r) / self._unknown,
            right / self._equation,
            "N",
        )
        return np.asarray(self._unknown * scaled)

    def solve_transposed(self, right: Floats) -> Floats:
        """Solution of R_z^T lambda = right; see `solve`."""
        scaled = self._iterate(
            lambda z: self._unknown * self.product_transposed(z / self._equation),
            lambda r: self._equation * self._precondition_transposed(r / self._unknown),
            self._unknown * right,
            "T",
        )
        return np.asarray(scaled / self._equation)

    def _iterate(
        self,
        product: Callable[[Floats], Floats],
        precondition: Callable[[Floats], Floats],
        right: Floats,
        side: Literal["N", "T"],
    ) -> Floats:
        """Flexible GMRES: rounding errors of a factor in single precision do not limit it.

        The factor leaves over what only contact knows, so a solve around the contact follows.
        """

        def both(residual: Floats) -> Floats:
            answer = precondition(residual)
            if len(self._area):
                left = (residual - product(answer))[self._patch]
                answer[self._patch] += self._patch_factor.solve(left, side)
            return answer

        size, norm = len(right), float(np.linalg.norm(right))
        if norm == 0.0:
            return right
        answer, _ = gcrotmk(
            LinearOperator((size, size), matvec=product, dtype=np.float64),
            right,
            M=LinearOperator((size, size), matvec=both, dtype=np.float64),
            rtol=ACCURACY,
            m=SEARCH,
            k=KEPT,
            maxiter=ROUNDS,
        )
        left = float(np.linalg.norm(right - product(answer))) / norm
        if not left <= ENOUGH:
            raise SimulationError(
                f"the linearised equations are not solved: {left:.1e} is left",
                remedy="take gradients of a state that is farther from losing its stability",
            )
        return np.asarray(answer)

    def product(self, z: Floats) -> Floats:
        """R_z times a vector."""
        count = len(self._volume)
        x, fluid, pressure = z[:count], z[count], z[count + 1 :]
        balance = self._upper @ x + self._lower @ x + self._rest @ x
        balance -= fluid * self._volume + self._force @ pressure
        gap = self._gap @ x + pressure / self._stiffness
        return np.concatenate([balance, [self._volume @ x], gap])

    def product_transposed(self, z: Floats) -> Floats:
        """R_z^T times a vector."""
        count = len(self._volume)
        x, volume, gap = z[:count], z[count], z[count + 1 :]
        balance = self._upper @ x + self._lower @ x + self._rest_transposed @ x
        balance += volume * self._volume + self._gap.T @ gap
        pressure = gap / self._stiffness - self._force.T @ x
        return np.concatenate([balance, [-(self._volume @ x)], pressure])

    def _precondition(self, right: Floats) -> Floats:
        """Approximate solution with the factor: contact's normals at the nodes, no coupling."""
        count, stiff = len(self._volume), self._stiffness
        by_x, by_v, by_p = right[:count], right[count], right[count + 1 :]
        change = np.asarray(self._factor.solve(by_x + self._plain @ (stiff * by_p)))
        fluid = (by_v - self._volume @ change) / (self._volume @ self._border)
        change = change + fluid * self._border
        pressure = stiff * (by_p - (self._plain.T @ change) / self._area)
        return np.concatenate([change, [fluid], pressure])

    def _precondition_transposed(self, right: Floats) -> Floats:
        """The same of the transposed equations."""
        count, stiff = len(self._volume), self._stiffness
        by_x, by_f, by_p = right[:count], right[count], right[count + 1 :]
        load = by_x - self._plain @ (stiff / self._area * by_p)
        answer = np.asarray(self._factor.solve(load))
        volume = (self._volume @ answer + by_f) / (self._volume @ self._border)
        answer = answer - volume * self._border
        gap = stiff * (by_p + self._plain.T @ answer)
        return np.concatenate([answer, [volume], gap])


def _nowhere(points: Floats) -> tuple[Floats, Floats]:
    """Derivatives of the distance to a body that is not there, so that nothing touches it."""
    return np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
