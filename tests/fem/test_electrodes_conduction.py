"""Current in the film against closed forms; symmetry, passivity, gradients."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special
from scipy.spatial import Delaunay

from palpate.errors import SimulationError
from palpate_fem.electrodes.conduction import FilmConduction, access_length
from palpate_fem.electrodes.film import FilmMesh
from palpate_fem.electrodes.specimen import DISC_DIAMETER_M

Floats = NDArray[np.float64]

SIGMA = 0.23
FILM = 0.5e-3
CONTACT = 2e-4  # Ohm m^2
# Central differences of a step of 1e-4 of the film: truncation and rounding are both below.
DIFFERENCES = 1e-6


def plane(points: Floats, faces: NDArray[np.int64], terminal: NDArray[np.int64]) -> FilmMesh:
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return FilmMesh(points, up, faces.astype(np.int32), terminal.astype(np.int32))


def strip(across: int, along: int, patch: float = 2e-3, length: float = 10e-3) -> FilmMesh:
    """A rectangle 4 mm wide with an electrode at each end."""
    x, y = np.linspace(0, length, along + 1), np.linspace(0, 4e-3, across + 1)
    points = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), -1).reshape(-1, 3)
    grid = np.arange(len(points)).reshape(along + 1, across + 1)
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    middle = points[faces].mean(axis=1)[:, 0]
    return plane(
        points, faces, np.where(middle < patch, 0, np.where(middle > length - patch, 1, -1))
    )


def rings(count: int, radii: tuple[float, float, float]) -> FilmMesh:
    """A disc, a bare ring and a ring electrode about it."""
    a, b, c = radii
    per = count // 3
    r = np.concatenate(
        [
            np.linspace(0, a, per + 1)[1:],
            np.geomspace(a, b, per + 1)[1:],
            np.linspace(b, c, per + 1)[1:],
        ]
    )
    angle = 2 * np.pi * np.arange(4 * count) / (4 * count)
    turn = 0.5 * np.arange(len(r)) * 2 * np.pi / (4 * count)
    x = r[:, None] * np.cos(angle + turn[:, None])
    y = r[:, None] * np.sin(angle + turn[:, None])
    points = np.concatenate([[[0, 0, 0]], np.stack([x, y, 0 * x], -1).reshape(-1, 3)])
    faces = np.asarray(Delaunay(points[:, :2]).simplices, np.int64)
    far = np.linalg.norm(points[faces].mean(axis=1), axis=1)
    return plane(points, faces, np.where(far < a * 0.999, 1, np.where(far > b, 0, -1)))


DISC = DISC_DIAMETER_M / 2


def fin_of_disc(a: float, transfer: float) -> float:
    """Resistance from a disc electrode to its rim: the modified Bessel equation inside."""
    sheet = SIGMA * FILM
    decay = np.sqrt(sheet * transfer)
    t = a / decay
    return float(decay * special.iv(0, t) / (2 * np.pi * a * sheet * special.iv(1, t)))


def fin_of_ring(b: float, c: float, transfer: float) -> float:
    """The same for a ring electrode from its inner rim, insulated at the outer one."""
    sheet = SIGMA * FILM
    decay = np.sqrt(sheet * transfer)
    inner, outer = b / decay, c / decay
    ratio = special.iv(1, outer) / special.kv(1, outer)  # no flux at c
    value = special.iv(0, inner) + ratio * special.kv(0, inner)
    flux = ratio * special.kv(1, inner) - special.iv(1, inner)
    return float(decay * value / (2 * np.pi * b * sheet * flux))


def impedance(mesh: FilmMesh, contact: float = CONTACT) -> float:
    film = np.full(len(mesh.nodes), FILM)
    solved = FilmConduction(mesh, 2).solve(film, sigma_s_m=SIGMA, contact_ohm_m2=contact)
    return float(solved.impedance[0])


def test_a_strip_is_two_fins_and_a_resistor() -> None:
    transfer = CONTACT + access_length(np.array(FILM), DISC)[0] / SIGMA
    decay = float(np.sqrt(SIGMA * FILM * transfer))
    fin = decay / (4e-3 * SIGMA * FILM) / np.tanh(2e-3 / decay)
    exact = 2 * fin + 6e-3 / (4e-3 * SIGMA * FILM)
    errors = [abs(impedance(strip(8, n)) / exact - 1) for n in (40, 80, 160)]
    assert errors[2] < 1e-3
    assert errors[1] < 0.31 * errors[0]  # second order
    assert errors[2] < 0.28 * errors[1]


@pytest.mark.parametrize("contact", [0.0, CONTACT])
def test_disc_within_ring(contact: float) -> None:
    a, b, c = 1.25e-3, 4e-3, 6e-3
    transfer = contact + float(access_length(np.array(FILM), DISC)[0]) / SIGMA
    exact = fin_of_disc(a, transfer) + np.log(b / a) / (2 * np.pi * SIGMA * FILM)
    exact += fin_of_ring(b, c, transfer)
    errors = [abs(impedance(rings(n, (a, b, c)), contact) / exact - 1) for n in (24, 48, 96)]
    assert errors[2] < 1e-3
    assert errors[1] < 0.31 * errors[0]
    assert errors[2] < 0.28 * errors[1]


@pytest.fixture(scope="module")
def quilt() -> tuple[FilmConduction, Floats]:
    """Five electrodes in a square with an uneven film."""
    n = 24
    axis = np.linspace(0, 12e-3, n + 1)
    points = np.stack(np.meshgrid(axis, axis, [0.0], indexing="ij"), -1).reshape(-1, 3)
    within = (points[:, :2] > 0).all(axis=1) & (points[:, :2] < 12e-3).all(axis=1)
    points[within, :2] += 1e-5 * np.random.default_rng(0).normal(size=(within.sum(), 2))
    faces = np.asarray(Delaunay(points[:, :2]).simplices, np.int64)
    middle = points[faces].mean(axis=1)[:, :2]
    centres = 1e-3 * np.array([[6, 6], [2.5, 2.5], [9.5, 2.5], [9.5, 9.5], [2.5, 9.0]])
    away = np.linalg.norm(middle[:, None] - centres, axis=2)
    terminal = np.where(away.min(axis=1) < 1.25e-3, away.argmin(axis=1), -1)
    mesh = plane(points, faces, terminal)
    x, y, _ = mesh.nodes.T / 12e-3
    film = np.exp(np.log(20e-6) + 4 * x * (1 - 0.4 * np.sin(5 * y)))
    return FilmConduction(mesh, 5), film


def test_conductances_are_reciprocal_and_passive(quilt: tuple[FilmConduction, Floats]) -> None:
    solver, film = quilt
    solved = solver.solve(film, sigma_s_m=SIGMA, contact_ohm_m2=1e-5)
    matrix = solved.conductance
    scale = matrix.max()
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14 * scale)
    np.testing.assert_allclose(matrix.sum(axis=1), 0.0, atol=1e-13 * scale)
    assert (matrix[~np.eye(5, dtype=bool)] <= 0).all()  # a maximum principle: only resistors
    assert np.linalg.eigvalsh(matrix)[0] > -1e-13 * scale
    # Two-terminal impedances from the pseudo-inverse of the same matrix.
    inverse = np.linalg.pinv(matrix)
    for i in range(1, 5):
        between = inverse[i, i] + inverse[0, 0] - 2 * inverse[i, 0]
        assert solved.impedance[i - 1] == pytest.approx(between, rel=1e-8)


def test_gradients_are_those_of_differences(quilt: tuple[FilmConduction, Floats]) -> None:
    solver, film = quilt

    def z(film: Floats, log_sigma: float = 0.0, contact: float = 1e-5) -> Floats:
        sigma = SIGMA * np.exp(log_sigma)
        return solver.solve(film, sigma_s_m=sigma, contact_ohm_m2=contact).impedance

    solved = solver.solve(film, sigma_s_m=SIGMA, contact_ohm_m2=1e-5)
    rng = np.random.default_rng(1)
    step = 1e-4
    for way in film * rng.normal(size=(4, len(film))):
        difference = (z(film + step * way) - z(film - step * way)) / (2 * step)
        answer = solved.gradient_film() @ way
        np.testing.assert_allclose(answer, difference, atol=DIFFERENCES * np.abs(answer).max())
    # Nodes that matter; the others' share is lost in the rounding of Z.
    for node in np.argsort(-np.abs(solved.gradient_film() * film).max(axis=0))[[0, 50, 100]]:
        one = np.zeros(len(film))
        one[node] = film[node]
        difference = (z(film + 1e-4 * one) - z(film - 1e-4 * one)) / 2e-4
        answer = solved.gradient_film()[:, node] * film[node]
        np.testing.assert_allclose(answer, difference, atol=DIFFERENCES * np.abs(answer).max())


def test_impedance_goes_with_one_over_sigma(quilt: tuple[FilmConduction, Floats]) -> None:
    """Without contact impedance, so that a tare of ln Z does not see temperature (section 0.5)."""
    solver, film = quilt
    one, two = (solver.solve(film, sigma_s_m=s) for s in (0.1, 0.2))
    np.testing.assert_allclose(one.impedance, 2 * two.impedance, rtol=1e-12)


def test_what_cannot_be_solved_is_refused(quilt: tuple[FilmConduction, Floats]) -> None:
    solver, film = quilt
    with pytest.raises(SimulationError, match="thinnest"):
        solver.solve(film - film.min(), sigma_s_m=SIGMA)
    with pytest.raises(SimulationError, match="sigma"):
        solver.solve(film, sigma_s_m=0.0)
    with pytest.raises(ValueError, match="shape"):
        solver.solve(film[:-1], sigma_s_m=SIGMA)
    mesh = strip(4, 10)
    with pytest.raises(SimulationError, match="no area"):
        FilmConduction(mesh, 3)


def test_a_film_in_parts_is_refused() -> None:
    whole = strip(4, 20)
    middle = whole.nodes[whole.faces].mean(axis=1)[:, 0]
    keep = (middle < 4.5e-3) | (middle > 5.5e-3)
    parts = plane(whole.nodes, whole.faces[keep].astype(np.int64), whole.terminal[keep])
    used, faces = np.unique(parts.faces, return_inverse=True)
    cut = plane(parts.nodes[used], faces.reshape(-1, 3), parts.terminal.astype(np.int64))
    with pytest.raises(SimulationError, match="parts"):
        FilmConduction(cut, 2).solve(np.full(len(used), FILM), sigma_s_m=SIGMA)


def test_elimination_leaves_what_dense_algebra_leaves(quilt: tuple[FilmConduction, Floats]) -> None:
    solver, film = quilt
    lower = solver.lower_triangle(film, sigma_s_m=SIGMA, contact_ohm_m2=1e-5).toarray()
    whole = lower + np.tril(lower, -1).T
    count = len(film)
    inner, across, outer = whole[:count, :count], whole[:count, count:], whole[count:, count:]
    left = outer - across.T @ np.linalg.solve(inner, across)
    solved = solver.solve(film, sigma_s_m=SIGMA, contact_ohm_m2=1e-5)
    np.testing.assert_allclose(solved.conductance[1:, 1:], left, rtol=1e-9)
    np.testing.assert_allclose(solved.impedance, np.diag(np.linalg.inv(left)), rtol=1e-9)


def test_reading_the_matrix_leaves_the_solver_as_it_was(
    quilt: tuple[FilmConduction, Floats],
) -> None:
    solver, film = quilt
    before = solver.solve(film, sigma_s_m=SIGMA).impedance
    solver.lower_triangle(film, sigma_s_m=SIGMA).eliminate_zeros()
    np.testing.assert_array_equal(solver.solve(film, sigma_s_m=SIGMA).impedance, before)


def test_gradient_of_a_scalar_is_that_of_its_parts(quilt: tuple[FilmConduction, Floats]) -> None:
    solver, film = quilt
    solved = solver.solve(film, sigma_s_m=SIGMA, contact_ohm_m2=1e-5)
    weight = np.random.default_rng(4).normal(size=4)
    whole = weight @ solved.gradient_film()
    np.testing.assert_allclose(solved.to_film(weight), whole, atol=1e-12 * np.abs(whole).max())
