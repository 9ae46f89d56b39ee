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
(radius a, insulated ground and roof, current collected on a cylinder of radius 5 a) give exactly
the resistance of the three-dimensional conductor:

* h << a: the edge current of a half plane, zeta = (2 ln 2 / pi)^2 h = 0.195 h;
* h >> a: the resistance no longer depends on h. In the film it is zeta / (pi sigma a^2), so zeta
  tends to pi a times a constant; with an infinitely far cylinder the disc's own resistance, 1 / 4,
  would make that pi a / 4;
* between: finite volumes, extrapolated to vanishing cells (docs/adr/0016).

Up to h = 4 a it does not matter how far the current is collected. Beyond, it does, because h is no
longer short against the way along the film; 5 a is the way to the nearest excitation on the finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np
import pymetis
import scipy.sparse as sp
import warp as wp
from numpy.typing import NDArray

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.device import indices, launch, scalars
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.electrodes.specimen import DISC_DIAMETER_M, TERMINALS

EDGE = (2 * np.log(2) / np.pi) ** 2
"""zeta / h of a film that is thin against its disc."""

DEEP = 0.6914
"""zeta / a of a film that is thick against its disc."""

# zeta / a = EDGE eta (1 + A1 eta + A2 eta^2 + A3 eta^3) / (1 + A1 eta + B2 eta^2 + ...) with
# eta = h / a: the resistance is within 0.06 % of the reference for 0.02 < eta < 20, and falls with
# h everywhere.
A1, A2, A3 = -0.4782, 0.6000, 0.3282
B2, B3, B4 = 0.5508, 0.2617, EDGE * A3 / DEEP


def access_length(film: Floats, radius_m: float) -> tuple[Floats, Floats]:
    """Access resistance of a disc times conductivity and area, and its derivative.

    Args:
        film: Thickness h over the disc [m], shape (...), positive.
        radius_m: Radius of the disc [m].

    Returns:
        zeta [m] and d zeta / d h, both of the film's shape.
    """
    eta = film / radius_m
    above = 1 + eta * (A1 + eta * (A2 + eta * A3))
    below = 1 + eta * (A1 + eta * (B2 + eta * (B3 + eta * B4)))
    above_slope = A1 + eta * (2 * A2 + eta * 3 * A3)
    below_slope = A1 + eta * (2 * B2 + eta * (3 * B3 + eta * 4 * B4))
    zeta = EDGE * film * above / below
    slope = EDGE * (above + eta * (above_slope - above * below_slope / below)) / below
    return np.asarray(zeta), np.asarray(slope)


Indices = NDArray[np.int64]

wp.set_module_options({"enable_backward": False})

# The factor has 67,000 entries and takes a million multiplications: so little that the routines of
# SciPy spend most of their time on the pattern, which never changes here, and on columns too short
# for dense blocks. Written in C++ because the loops of Warp's own language are four times slower:
# they load the address of each array again for each entry (measured in ADR 0016).
_ELIMINATE = """
const int* __restrict__ start = starts.data;
const int* __restrict__ row = rows.data;
double* __restrict__ dense = work.data;
double* lower = factor.data;
for (int j = 0; j < size; ++j) {
    const int first = start[j], end = start[j + 1];
    for (int p = first; p < end; ++p) dense[row[p]] = lower[p];
    for (int link = link_starts.data[j]; link < link_starts.data[j + 1]; ++link) {
        const int from = links.data[link], to = start[link_columns.data[link] + 1];
        const double share = lower[from];
        for (int q = from; q < to; ++q) dense[row[q]] -= share * lower[q];
    }
    // A pivot that is not positive becomes NaN, which spreads to all that depends on it.
    const double scale = j < eliminated ? 1.0 / sqrt(dense[j]) : 1.0;
    for (int p = first; p < end; ++p) lower[p] = scale * dense[row[p]];
}
"""
_SUBSTITUTE = """
const int* __restrict__ start = starts.data;
const int* __restrict__ row = rows.data;
const double* __restrict__ lower = factor.data;
double* solution = answer.data;
for (int j = eliminated - 1; j >= 0; --j) {
    double* own = solution + j * columns;
    for (int p = start[j] + 1; p < start[j + 1]; ++p) {
        const double share = lower[p];
        const double* later = solution + row[p] * columns;
        for (int c = 0; c < columns; ++c) own[c] -= share * later[c];
    }
    const double scale = 1.0 / lower[start[j]];
    for (int c = 0; c < columns; ++c) own[c] *= scale;
}
"""


@wp.func_native(_ELIMINATE)
@no_type_check  # Warp's annotations are not types
def _eliminate(
    size: int,
    eliminated: int,
    starts: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    link_starts: wp.array(dtype=wp.int32),
    links: wp.array(dtype=wp.int32),
    link_columns: wp.array(dtype=wp.int32),
    work: wp.array(dtype=wp.float64),
    factor: wp.array(dtype=wp.float64),
): ...


@wp.func_native(_SUBSTITUTE)
@no_type_check
def _substitute(
    eliminated: int,
    columns: int,
    starts: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    factor: wp.array(dtype=wp.float64),
    answer: wp.array(dtype=wp.float64),
): ...


@wp.kernel
@no_type_check
def eliminate(
    size: int,
    eliminated: int,
    starts: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    link_starts: wp.array(dtype=wp.int32),
    links: wp.array(dtype=wp.int32),
    link_columns: wp.array(dtype=wp.int32),
    work: wp.array(dtype=wp.float64),
    factor: wp.array(dtype=wp.float64),
) -> None:
    """Cholesky factor of the first columns, Schur complement of the rest, in place (left-looking).

    ``links`` are the entries of each row in eliminated columns: what its column has to gather.
    """
    _eliminate(size, eliminated, starts, rows, link_starts, links, link_columns, work, factor)


@wp.kernel
@no_type_check
def substitute(
    eliminated: int,
    columns: int,
    starts: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    factor: wp.array(dtype=wp.float64),
    answer: wp.array(dtype=wp.float64),
) -> None:
    """Eliminated unknowns from the remaining ones, several solutions side by side."""
    _substitute(eliminated, columns, starts, rows, factor, answer)


SINGULAR = 1e11  # limit of impedance times conductance; a film of 5 um beside 2 mm gives 1e4


@dataclass(frozen=True)
class FilmSolution:
    """The solved film for one distribution of thickness.

    Attributes:
        conductance: Between the terminals, after elimination of the film [S], shape (20, 20);
            symmetric, rows sum to zero. Terminal 0 is the excitation.
        resistance: Potential of E_i for a unit current into E_j, with the excitation at zero [Ohm],
            shape (19, 19).
        film: The thickness [m], shape (N,).
        sigma_s_m: Conductivity of the fluid [S/m].
        contact_ohm_m2: Impedance of the interface [Ohm m^2].
    """

    conductance: Floats
    resistance: Floats
    film: Floats
    sigma_s_m: float
    contact_ohm_m2: float
    solver: FilmConduction
    factor: Floats

    @property
    def impedance(self) -> Floats:
        """Z_i between the excitation and E_i, with all others floating [Ohm], shape (19,)."""
        return np.diagonal(self.resistance)

    @cached_property
    def _squares(self) -> tuple[Floats, Floats]:
        """Squared differences of potential for a unit current from E_i to the excitation [V^2/A^2].

        Along the edges of the triangles, shape (E, 19), and across the access lengths, (C, 19).
        """
        mesh = self.solver
        film = mesh.potentials(self.factor, self.resistance)
        along = film[mesh.edges[:, 0]]
        along -= film[mesh.edges[:, 1]]
        across = film[mesh.share_node]
        across -= np.concatenate([np.zeros((1, len(self.resistance))), self.resistance])[
            mesh.share_terminal
        ]
        return np.square(along, out=along), np.square(across, out=across)

    def gradient_film(self) -> Floats:
        """dZ_i / dh_j [Ohm / m], shape (19, N). The problem is self-adjoint: no further solve."""
        return self._by_film(*self._squares).T

    def to_film(self, gradient: Floats) -> Floats:
        """Gradient of a scalar by thickness [1/m], shape (N,), from that by impedances, (19,)."""
        along, across = self._squares
        return self._by_film(along @ gradient, across @ gradient)

    def gradient_log_sigma(self) -> Floats:
        """dZ_i / d ln sigma [Ohm], shape (19,): less what the interface alone contributes."""
        if self.contact_ohm_m2 == 0:
            return -self.impedance
        mesh = self.solver
        zeta, _ = access_length(self.film[mesh.share_node], mesh.disc_radius_m)
        transfer = 1 / (self.contact_ohm_m2 + zeta / self.sigma_s_m)
        _, across = self._squares
        at_interface = (mesh.share_area * transfer**2 * self.contact_ohm_m2) @ across
        return np.asarray(at_interface - self.impedance)

    def _by_film(self, along: Floats, across: Floats) -> Floats:
        mesh = self.solver
        zeta, slope = access_length(self.film[mesh.share_node], mesh.disc_radius_m)
        transfer = 1 / (self.contact_ohm_m2 + zeta / self.sigma_s_m)
        weight = mesh.share_area * transfer**2 * slope / self.sigma_s_m
        vertical = (weight * across.T).T
        return np.asarray(
            mesh.share_to_nodes @ vertical - self.sigma_s_m * (mesh.edges_to_nodes @ along)
        )


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
        faces = mesh.faces.astype(np.int64)
        areas = mesh.areas
        on = np.flatnonzero(mesh.terminal >= 0)
        key = mesh.terminal[on].astype(np.int64)[:, None] * count + faces[on]
        pairs, place = np.unique(key, return_inverse=True)
        self.share_terminal, self.share_node = np.divmod(pairs, count)
        self.share_area = np.bincount(place.ravel(), np.repeat(areas[on] / 3, 3))
        self.share_to_nodes = sp.csr_matrix(
            (np.ones(len(pairs)), (self.share_node, np.arange(len(pairs)))),
            shape=(count, len(pairs)),
        )
        if len(np.unique(self.share_terminal)) != terminals:
            raise SimulationError("a terminal has no area", remedy="check the film's mesh")
        # The power in a triangle is a sum over its edges: sigma h sum w (difference)^2, with half
        # the cotangent of the opposite angle as weight w. So edges carry the whole problem.
        sides = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
        sides.sort(axis=2)
        keys, edge = np.unique(sides[..., 0] * count + sides[..., 1], return_inverse=True)
        self.edges = np.stack(np.divmod(keys, count), axis=1)
        by_face = sp.csr_matrix(
            (
                _edge_weights(mesh).ravel() / 3,
                (np.repeat(np.arange(len(faces)), 3), edge.ravel()),
            ),
            shape=(len(faces), len(keys)),
        )
        ones = np.ones(faces.size)
        owner = np.repeat(np.arange(len(faces)), 3)
        to_nodes = sp.csr_matrix((ones, (faces.ravel(), owner)), shape=(count, len(faces)))
        self.edges_to_nodes = (to_nodes @ by_face).tocsr()
        self._plan(count)

    def _plan(self, count: int) -> None:
        """Order of elimination, pattern of the factor, and the matrix's entries from the film."""
        one, other = self.edges.T
        ends = np.concatenate([one, other]), np.concatenate([other, one])
        graph = sp.csr_matrix((np.ones(len(ends[0])), ends), shape=(count, count))
        adjacency = pymetis.CSRAdjacency(
            adj_starts=graph.indptr.tolist(), adjacent=graph.indices.tolist()
        )
        position = np.asarray(pymetis.nested_dissection(adjacency)[1], np.int64)
        self._position = position
        # Terminals come last (without the excitation, which is ground): eliminating the film then
        # leaves the conductance matrix of the terminals, and no right-hand side is solved.
        size = count + self.terminals - 1
        node, terminal = position[self.share_node], count + self.share_terminal - 1
        live = terminal >= count
        # Links between two unknowns, or to ground (-1). Each adds its conductance to the diagonal
        # entries of its ends, and subtracts it from the entry between them.
        first = np.concatenate([position[one], node])
        second = np.concatenate([position[other], np.where(live, terminal, -1)])
        low, high = np.minimum(first, second), np.maximum(first, second)
        inner = low >= 0
        last = np.arange(count, size)
        rows = np.concatenate([high[inner], np.arange(size), np.repeat(last, len(last))])
        columns = np.concatenate([low[inner], np.arange(size), np.tile(last, len(last))])
        pattern = _factor_pattern(rows, columns, size)
        self._starts, self._rows = pattern.indptr, pattern.indices
        column_of = np.repeat(np.arange(size), np.diff(self._starts))
        keys = column_of * size + self._rows

        def entry(row: Indices, column: Indices) -> Indices:
            return np.searchsorted(keys, column * size + row)

        # All entries are linear in the thickness and in the transfer of the discs, so a new film
        # needs one product with a sparse matrix, and no assembly.
        links = np.arange(len(first))
        seen = second >= 0
        add = sp.csr_matrix(
            (
                np.concatenate([np.ones(len(first) + seen.sum()), -np.ones(inner.sum())]),
                (
                    np.concatenate(
                        [
                            entry(first, first),
                            entry(second[seen], second[seen]),
                            entry(high[inner], low[inner]),
                        ]
                    ),
                    np.concatenate([links, links[seen], links[inner]]),
                ),
            ),
            shape=(len(keys), len(first)),
        )
        of_film = sp.block_diag([self.edges_to_nodes.T, sp.eye_array(len(node))])
        self._entries = sp.csr_matrix(add @ of_film)
        # Entries of each row left of the diagonal, in columns that are eliminated.
        left = np.flatnonzero((column_of < self._rows) & (column_of < count))
        left = left[np.argsort(self._rows[left], kind="stable")]
        self._links, self._link_columns = (
            left.astype(np.int32),
            column_of[left].astype(np.int32),
        )
        self._link_starts = np.searchsorted(self._rows[left], np.arange(size + 1)).astype(np.int32)

    def solve(self, film: Floats, *, sigma_s_m: float, contact_ohm_m2: float = 0.0) -> FilmSolution:
        """Conductances and impedances of one film.

        Args:
            film: Thickness at the nodes [m], shape (N,), positive.
            sigma_s_m: Conductivity of the fluid [S/m].
            contact_ohm_m2: Impedance of the electrodes' interface z_c [Ohm m^2].

        Raises:
            SimulationError: A thickness or parameter is not positive and finite.
        """
        factor = self._entries_of(film, sigma_s_m, contact_ohm_m2)
        inner, resistance = self._reduce(factor)
        whole = np.zeros((self.terminals, self.terminals))
        whole[1:, 1:] = inner
        whole[0, 1:] = whole[1:, 0] = -inner.sum(axis=0)
        whole[0, 0] = inner.sum()
        return FilmSolution(
            conductance=whole,
            resistance=resistance,
            film=np.asarray(film, np.float64),
            sigma_s_m=sigma_s_m,
            contact_ohm_m2=contact_ohm_m2,
            solver=self,
            factor=factor,
        )

    def lower_triangle(
        self, film: Floats, *, sigma_s_m: float, contact_ohm_m2: float = 0.0
    ) -> sp.csc_matrix:
        """The matrix that `solve` factorises [S]: film in order of elimination, then E1..E19.

        Entries that only its factor has are stored zeros. Arguments and errors as for `solve`.
        """
        values = self._entries_of(film, sigma_s_m, contact_ohm_m2)
        size = len(self._starts) - 1
        pattern = self._rows.copy(), self._starts.copy()  # SciPy edits them in place
        return sp.csc_matrix((values, *pattern), shape=(size, size))

    def _entries_of(self, film: Floats, sigma_s_m: float, contact_ohm_m2: float) -> Floats:
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
        drive = np.concatenate([sigma_s_m * film, transfer * self.share_area])
        return np.asarray(self._entries @ drive)

    def _reduce(self, factor: Floats) -> tuple[Floats, Floats]:
        """Factorise the matrix in place: conductances between the terminals, and their inverse."""
        size, count = len(self._starts) - 1, len(self.mesh.nodes)
        pattern = (self._starts, self._rows, self._link_starts, self._links, self._link_columns)
        launch(
            eliminate,
            1,
            [size, count, *map(indices, pattern), scalars(np.empty(size))],
            [scalars(factor)],
        )
        # Symmetric and positive definite, so the planned order of elimination is stable. The last
        # columns are full, and hold the lower triangle of what the elimination leaves.
        left = np.zeros((size - count, size - count))
        left.T[np.triu_indices(size - count)] = factor[self._starts[count] :]
        left += np.tril(left, -1).T
        diagonal = factor[self._starts[:count]]
        try:
            resistance = np.linalg.inv(left)
        except np.linalg.LinAlgError as error:
            raise _disconnected() from error
        resistance = (resistance + resistance.T) / 2
        own = np.diagonal(resistance)
        if not (diagonal.min() > 0 and 0 < own.min() and own.max() * left.max() < SINGULAR):
            raise _disconnected()
        return left, resistance

    def potentials(self, factor: Floats, resistance: Floats) -> Floats:
        """Potentials of the film for unit currents from E_i to the excitation [V/A], (N, 19).

        Args:
            factor: Of a solution.
            resistance: Potentials of the terminals for these currents [V/A], shape (19, 19).
        """
        count, columns = len(self.mesh.nodes), len(resistance)
        answer = np.concatenate([np.zeros((count, columns)), resistance])
        launch(
            substitute,
            1,
            [count, columns, indices(self._starts), indices(self._rows), scalars(factor)],
            [scalars(answer.ravel())],
        )
        return answer[self._position]


def _factor_pattern(rows: Indices, columns: Indices, size: int) -> sp.csc_matrix:
    """Pattern of the Cholesky factor of a matrix with entries at these places (lower triangle).

    A column gets the entries of its children in the elimination tree, without their first ones.
    """
    given = sp.csc_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size))
    given = sp.tril(given, format="csc")
    given.sort_indices()
    found: list[NDArray[np.int32]] = []
    children: list[list[int]] = [[] for _ in range(size)]
    for j in range(size):
        own = given.indices[given.indptr[j] : given.indptr[j + 1]]
        below = np.unique(np.concatenate([own, *(found[child][1:] for child in children[j])]))
        found.append(below)
        if len(below) > 1:
            children[below[1]].append(j)
    indptr = np.cumsum([0, *map(len, found)], dtype=np.int32)
    whole = np.concatenate(found).astype(np.int32)
    return sp.csc_matrix((np.ones(len(whole)), whole, indptr), shape=(size, size))


def _disconnected() -> SimulationError:
    return SimulationError(
        "the film falls into parts that are not connected",
        remedy="check the film's mesh, and that its thickness has a floor",
    )


def _edge_weights(mesh: FilmMesh) -> Floats:
    """Half the cotangent of each corner's angle: weight of the edge opposite to it, (F, 3)."""
    corner = mesh.nodes[mesh.faces]
    ahead = np.roll(corner, -1, axis=1) - corner
    behind = np.roll(corner, -2, axis=1) - corner
    along = np.einsum("fci,fci->fc", ahead, behind)
    across = np.linalg.norm(np.cross(ahead[:, 0], behind[:, 0]), axis=1)
    return np.asarray(along / (2 * across[:, None]))
