"""The access length against the conductor in three dimensions, and against limits."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve
from scipy.special import ive

from palpate_fem.electrodes.conduction import access_length

Floats = NDArray[np.float64]

OUTER = 5.0  # radius of the grounded border over the disc's


def graded(start: float, end: float, first: float) -> Floats:
    """Points that stand the closer the nearer to the start; the disc's rim is a singularity."""
    steps = [first]
    while sum(steps) < 1.0:
        steps.append(min(1.18 * steps[-1], 0.12))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(start + (end - start) * way / way[-1])


def resistance(height: float) -> float:
    """Of a disc of radius 1 on the floor of a layer, to its border, by finite volumes (r, z)."""
    first = 2e-3 * min(1.0, height)
    r = np.concatenate([graded(1.0, 0.0, first)[:0:-1], graded(1.0, OUTER, first / (OUTER - 1))])
    z = graded(0.0, height, first / height)
    rc, zc = (r[1:] + r[:-1]) / 2, (z[1:] + z[:-1]) / 2
    index = np.arange(len(rc) * len(zc)).reshape(len(rc), len(zc))
    ring = np.pi * (r[1:] ** 2 - r[:-1] ** 2)
    sideways = 2 * np.pi * r[1:-1, None] * np.diff(z) / np.diff(rc)[:, None]
    upwards = ring[:, None] / np.diff(zc)
    links = [(index[:-1], index[1:], sideways), (index[:, :-1], index[:, 1:], upwards)]
    rows, columns, values = [], [], []
    diagonal = np.zeros(index.size)
    for one, other, g in links:
        for a, b in ((one, other), (other, one)):
            rows.append(a.ravel())
            columns.append(b.ravel())
            values.append(-g.ravel())
            np.add.at(diagonal, a.ravel(), g.ravel())
    diagonal[index[-1]] += 2 * np.pi * OUTER * np.diff(z) / (OUTER - rc[-1])
    on = rc < 1
    disc = ring[on] / zc[0]
    diagonal[index[on, 0]] += disc
    source = np.zeros(index.size)
    source[index[on, 0]] = disc
    rows.append(np.arange(index.size))
    columns.append(np.arange(index.size))
    values.append(diagonal)
    matrix = sp.csc_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    )
    potential = spsolve(matrix, source)
    return float(1 / (disc * (1 - potential[index[on, 0]])).sum())


def thin(height: float) -> float:
    """The same by the film: modified Bessel functions under the disc, a logarithm beside."""
    zeta, _ = access_length(np.array(height), 1.0)
    decay = float(np.sqrt(height * zeta))
    under = decay * ive(0, 1 / decay) / ive(1, 1 / decay)
    return float((np.log(OUTER) + under) / (2 * np.pi * height))


@pytest.mark.parametrize("height", [0.1, 0.4, 1.0, 2.0, 3.0])
def test_film_has_the_resistance_of_the_three_dimensional_conductor(height: float) -> None:
    assert thin(height) == pytest.approx(resistance(height), rel=0.01)


def test_more_fluid_never_raises_the_resistance() -> None:
    """Rayleigh's monotonicity, which h / 2 breaks for films thicker than the disc is wide."""
    heights = np.geomspace(0.01, 4.0, 200)
    assert (np.diff([thin(h) for h in heights]) < 0).all()


def test_thin_film_is_the_edge_of_a_half_plane() -> None:
    zeta, _ = access_length(np.array(1e-3), 1.0)
    assert zeta / 1e-3 == pytest.approx((2 * np.log(2) / np.pi) ** 2, rel=0.05)


def test_slope_and_scale() -> None:
    film = np.geomspace(5e-6, 5e-3, 40)
    zeta, slope = access_length(film, 1.25e-3)
    step = 1e-5 * film
    difference = (
        access_length(film + step, 1.25e-3)[0] - access_length(film - step, 1.25e-3)[0]
    ) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    np.testing.assert_allclose(access_length(2 * film, 2.5e-3)[0], 2 * zeta, rtol=1e-12)
