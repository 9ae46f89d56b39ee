"""Current in the film: from its thickness to impedances between electrodes, with gradients.

The film is thin, so its potential lives on the core's surface (learning notes, section 4.2)::

    div(sigma h grad phi) = sum_k chi_k (phi - V_k) / (z_c + zeta(h) / sigma),   insulated border,

with linear triangles. The potentials of the film are eliminated (Kron reduction), which leaves the
conductance matrix of the 20 terminals.

The access length zeta stands for the resistance that a disc's current meets on its way into the
full height of the film. The learning notes take zeta = h / 2. That is too much for thin films, and
it grows without limit: *less* fluid over an electrode would lower its impedance, so counts would
rise under a fingertip pressed from 2 mm of fluid to 1 mm. Removing a conductor cannot do that
(Rayleigh's monotonicity), and no real sensor does it. Here zeta makes the film model of one disc
(radius a, insulated ground and roof) give exactly the resistance of the three-dimensional
conductor, which was solved by finite volumes for 0.05 a < h < 3 a. For thinner films, the edge
current of a half plane gives (2 ln 2 / pi)^2 h = 0.195 h. The formula follows those values within 3
% (docs/adr/0016).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymetis
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from palpate.errors import SimulationError
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.electrodes.specimen import DISC_DIAMETER_M, TERMINALS

Floats = NDArray[np.float64]

SHARE, TURN, EXPONENT = 0.2035, 4.56, 2.113
"""zeta / a = SHARE eta / (1 + (eta / TURN)^EXPONENT), eta = h / a; fitted for 0.05 < eta < 3."""


def access_length(film: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """Access resistance of a disc times conductivity and area, and its derivative.

    Args:
        film: Thickness h over the disc [m], shape (...), positive.
        radius_m: Radius of the disc [m].

    Returns:
        zeta [m] and d zeta / d h, both of the film's shape.
    """
    eta = film / radius_m
    bend = (eta / TURN) ** EXPONENT
    zeta = SHARE * film / (1 + bend)
    slope = SHARE * (1 + (1 - EXPONENT) * bend) / (1 + bend) ** 2
    return np.asarray(zeta), np.asarray(slope)


Indices = NDArray[np.int64]

SINGULAR = 1e11  # limit of impedance times conductance; a film of 5 um beside 2 mm gives 1e4


@dataclass(frozen=True)
class FilmSolution:
    """The solved film for one distribution of thickness.

    Attributes:
        conductance: Between the terminals, after elimination of the film [S], shape (20, 20);
            symmetric, rows sum to zero. Terminal 0 is the excitation.
        impedance: Z_i between the excitation and E_i, with all others floating [Ohm], shape (19,).
        film: The thickness [m], shape (N,).
        sigma_s_m: Conductivity of the fluid [S/m].
        contact_ohm_m2: Impedance of the interface [Ohm m^2].
    """

    conductance: Floats
    impedance: Floats
    film: Floats
    sigma_s_m: float
    contact_ohm_m2: float
    solver: FilmConduction
    factor: Any

    @cached_property
    def _potentials(self) -> tuple[Floats, Floats]:
        """Potentials for a unit current from E_i to the excitation, which is at zero [V / A].

        Of the film, shape (N, 19), and of the terminals, shape (20, 19).
        """
        count, free = len(self.film), len(self.impedance)
        right = np.zeros((count + free, free))
        right[count:] = np.eye(free)
        answer = np.asarray(self.factor.solve(right))
        terminals = np.concatenate([np.zeros((1, free)), answer[count:]])
        return answer[self.solver.position], terminals

    @cached_property
    def _field(self) -> tuple[Floats, Floats]:
        """Squared gradients [V^2 / (m A)^2] (F, 19) and squared jumps under discs (C, 19)."""
        mesh = self.solver
        film, terminals = self._potentials
        slope = np.einsum("fai,fan->fin", mesh.slopes, film[mesh.mesh.faces])
        jump = film[mesh.share_node] - terminals[mesh.share_terminal]
        return np.einsum("fin,fin->fn", slope, slope), jump**2

    def gradient_film(self) -> Floats:
        """dZ_i / dh_j [Ohm / m], shape (19, N). The problem is self-adjoint: no further solve."""
        mesh, (steep, jump) = self.solver, self._field
        per_face = -self.sigma_s_m / 3 * mesh.areas[:, None] * steep
        share = mesh.share_area[:, None] * jump
        steepness = (self._access[1] / self.sigma_s_m)[:, None]
        vertical = share * self._transfer[:, None] ** 2 * steepness
        return np.asarray(mesh.to_nodes @ per_face + mesh.share_to_nodes @ vertical).T

    @property
    def _access(self) -> tuple[Floats, Floats]:
        return access_length(self.film[self.solver.share_node], self.solver.disc_radius_m)

    @property
    def _transfer(self) -> Floats:
        return np.asarray(1 / (self.contact_ohm_m2 + self._access[0] / self.sigma_s_m))


class FilmConduction:
    """A film mesh prepared for many solves: sparsity, order of elimination, linear operators."""

    def __init__(
        self,
        mesh: FilmMesh,
        terminals: int = TERMINALS,
        *,
        disc_radius_m: float = DISC_DIAMETER_M / 2,
    ) -> None:
        """Prepare.

        Args:
            mesh: The film.
            terminals: Number of terminals; each must have a triangle.
            disc_radius_m: Radius of the electrodes [m].
        """
        self.mesh, self.terminals, self.disc_radius_m = mesh, terminals, disc_radius_m
        count = len(mesh.nodes)
        self.slopes, self.areas = _shape_gradients(mesh)
        faces = mesh.faces.astype(np.int64)
        ones = np.ones(faces.size)
        owner = np.repeat(np.arange(len(faces)), 3)
        self.to_nodes = sp.csr_matrix((ones, (faces.ravel(), owner)), shape=(count, len(faces)))
        on = np.flatnonzero(mesh.terminal >= 0)
        key = mesh.terminal[on].astype(np.int64)[:, None] * count + faces[on]
        pairs, place = np.unique(key, return_inverse=True)
        self.share_terminal, self.share_node = np.divmod(pairs, count)
        self.share_area = np.bincount(place.ravel(), np.repeat(self.areas[on] / 3, 3))
        self.share_to_nodes = sp.csr_matrix(
            (np.ones(len(pairs)), (self.share_node, np.arange(len(pairs)))),
            shape=(count, len(pairs)),
        )
        if len(np.unique(self.share_terminal)) != terminals:
            raise SimulationError("a terminal has no area", remedy="check the film's mesh")
        self._plan(count, faces)

    def _plan(self, count: int, faces: Indices) -> None:
        """Order of elimination, pattern of the matrix, and its entries from the triangles."""
        rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
        graph = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        graph.setdiag(0)
        graph.eliminate_zeros()
        adjacency = pymetis.CSRAdjacency(
            adj_starts=graph.indptr.tolist(), adjacent=graph.indices.tolist()
        )
        self.position = np.asarray(pymetis.nested_dissection(adjacency)[1], np.int64)
        # Terminals come last (without the excitation, which is ground): eliminating the film then
        # leaves the conductance matrix of the terminals, and no right-hand side is solved.
        size = count + self.terminals - 1
        node, terminal = self.position[self.share_node], count + self.share_terminal - 1
        live = terminal >= count
        own = np.arange(count, size)
        row = [self.position[rows], node, node[live], terminal[live], own]
        column = [self.position[columns], node, terminal[live], node[live], own]
        entries, place = np.unique(
            np.concatenate(column) * size + np.concatenate(row), return_inverse=True
        )
        columns, self._rows = np.divmod(entries, size)
        self._starts = np.searchsorted(columns, np.arange(size + 1))
        # All entries are linear in the sheet conductance of the triangles and in the transfer of
        # the discs, so a new film needs one product with a sparse matrix, and no assembly.
        stiff = np.einsum("fai,fbi,f->fab", self.slopes, self.slopes, self.areas).ravel()
        shares = np.arange(len(node))
        weights = [stiff, np.ones(len(node)), -np.ones(2 * live.sum()), np.ones(live.sum())]
        owner = [
            np.repeat(np.arange(len(faces)), 9),
            *(len(faces) + i for i in (shares, shares[live], shares[live], shares[live])),
        ]
        # The diagonal entry of a terminal sums all its links.
        place = np.concatenate([place[: -len(own)], place[-len(own) :][terminal[live] - count]])
        self._entries = sp.csr_matrix(
            (np.concatenate(weights), (place, np.concatenate(owner))),
            shape=(len(entries), len(faces) + len(node)),
        )

    def solve(self, film: Floats, *, sigma_s_m: float, contact_ohm_m2: float = 0.0) -> FilmSolution:
        """Conductances and impedances of one film.

        Args:
            film: Thickness at the nodes [m], shape (N,), positive.
            sigma_s_m: Conductivity of the fluid [S/m].
            contact_ohm_m2: Impedance of the electrodes' interface z_c [Ohm m^2].

        Raises:
            SimulationError: A thickness or parameter is not positive and finite.
        """
        film = np.asarray(film, np.float64)
        if film.shape != (len(self.mesh.nodes),):
            raise ValueError(f"film has shape {film.shape}, not ({len(self.mesh.nodes)},)")
        if not (np.isfinite(film).all() and film.min() > 0 and 0 < sigma_s_m < np.inf):
            raise SimulationError(
                f"the film is {film.min():g} m at its thinnest, sigma {sigma_s_m:g} S/m",
                remedy="give positive, finite values; a residual film has a floor",
            )
        access, _ = access_length(film[self.share_node], self.disc_radius_m)
        transfer = 1 / (contact_ohm_m2 + access / sigma_s_m)
        sheet = sigma_s_m * film[self.mesh.faces].mean(axis=1)
        values = self._entries @ np.concatenate([sheet, transfer * self.share_area])
        size = len(self._starts) - 1
        matrix = sp.csc_matrix((values, self._rows, self._starts), shape=(size, size))
        # Symmetric and positive definite, so the planned order of elimination is stable.
        inner, resistance, factor = _reduce(matrix, self.terminals - 1)
        whole = np.zeros((self.terminals, self.terminals))
        whole[1:, 1:] = inner
        whole[0, 1:] = whole[1:, 0] = -inner.sum(axis=0)
        whole[0, 0] = inner.sum()
        return FilmSolution(
            conductance=whole,
            impedance=np.diag(resistance).copy(),
            film=film,
            sigma_s_m=sigma_s_m,
            contact_ohm_m2=contact_ohm_m2,
            solver=self,
            factor=factor,
        )


def _reduce(matrix: sp.csc_matrix, count: int) -> tuple[Floats, Floats, Any]:
    """Schur complement of the last `count` unknowns, its inverse, and the factorisation."""
    try:
        factor: Any = splu(
            matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        place = np.arange(matrix.shape[0] - count, matrix.shape[0])
        kept = (factor.perm_c[-count:] == place).all() and (factor.perm_r[-count:] == place).all()
        left = factor.L[-count:, -count:].toarray() @ factor.U[-count:, -count:].toarray()
        left = (left + left.T) / 2
        resistance = np.linalg.inv(left)
    except (RuntimeError, np.linalg.LinAlgError) as error:
        raise _disconnected() from error
    diagonal = np.diag(resistance)
    if not kept or not (0 < diagonal.min() and diagonal.max() * left.max() < SINGULAR):
        raise _disconnected()
    return left, resistance, factor


def _disconnected() -> SimulationError:
    return SimulationError(
        "the film falls into parts that are not connected",
        remedy="check the film's mesh, and that its thickness has a floor",
    )


def _shape_gradients(mesh: FilmMesh) -> tuple[Floats, Floats]:
    """Surface gradients of the linear shape functions [1/m], (F, 3, 3), and areas [m^2], (F,)."""
    corner = mesh.nodes[mesh.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double = np.linalg.norm(normal, axis=1)
    opposite = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
    slopes = np.cross(normal[:, None], opposite) / (double**2)[:, None, None]
    return slopes, double / 2
