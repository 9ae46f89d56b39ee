"""The access length against the conductor in three dimensions, and against limits."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve
from scipy.special import ive

from palpate_fem.electrodes.conduction import access_length

Floats = NDArray[np.float64]

OUTER = 5.0  # radius of the grounded border over the disc's


def graded(start: float, end: float, first: float, growth: float, largest: float) -> Floats:
    """Points that stand the closer the nearer to the start; the disc's rim is a singularity."""
    steps = [first]
    while sum(steps) < 1.0:
        steps.append(min(growth * steps[-1], largest))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(start + (end - start) * way / way[-1])


def on_cells(height: float, outer: float, halvings: int) -> float:
    """Resistance of a disc of radius 1 on the floor of a layer, by finite volumes (r, z)."""
    growth, largest = 1.18 ** (0.5**halvings), 0.12 * 0.5**halvings
    first = 0.5e-3 * min(1.0, height) * 0.25**halvings  # at the rim the flux goes with a root
    inside = graded(1.0, 0.0, first, growth, largest)
    outside = graded(1.0, outer, first / (outer - 1), growth, largest)
    r = np.concatenate([inside[:0:-1], outside])
    z = graded(0.0, height, first / height, growth, largest)
    rc, zc = (r[1:] + r[:-1]) / 2, (z[1:] + z[:-1]) / 2
    index = np.arange(len(rc) * len(zc)).reshape(len(rc), len(zc))
    ring = np.pi * (r[1:] ** 2 - r[:-1] ** 2)
    sideways = 2 * np.pi * np.diff(z) / np.log(rc[1:] / rc[:-1])[:, None]
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
    diagonal[index[-1]] += 2 * np.pi * np.diff(z) / np.log(outer / rc[-1])
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


@cache
def resistance(height: float, outer: float = OUTER) -> float:
    """Of a disc of radius 1 on the floor of a layer, to its border; extrapolated (second order)."""
    coarse, fine = on_cells(height, outer, 0), on_cells(height, outer, 1)
    return fine + (fine - coarse) / 3


def thin(height: float, outer: float = OUTER) -> float:
    """The same by the film: modified Bessel functions under the disc, a logarithm beside."""
    zeta, _ = access_length(np.array(height), 1.0)
    decay = float(np.sqrt(height * zeta))
    under = decay * ive(0, 1 / decay) / ive(1, 1 / decay)
    return float((np.log(outer) + under) / (2 * np.pi * height))


HEIGHTS = [0.05, 0.1, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0]


@pytest.mark.parametrize("height", HEIGHTS)
def test_film_has_the_resistance_of_the_three_dimensional_conductor(height: float) -> None:
    assert thin(height) == pytest.approx(resistance(height), rel=1e-3)


@pytest.mark.parametrize(
    ("outer", "height", "within"),
    [(3.0, 1.0, 0.001), (3.0, 3.0, 0.005), (10.0, 4.0, 0.001), (10.0, 10.0, 0.02)],
)
def test_it_hardly_matters_where_the_current_is_collected(
    outer: float, height: float, within: float
) -> None:
    assert thin(height, outer) == pytest.approx(resistance(height, outer), rel=within)


def test_the_reference_is_right_where_a_closed_form_is_known() -> None:
    """A disc on a half space, 1 / (4 sigma a), less what lies beyond the border.

    In a layer of height h the images of the disc make its resistance to a far border of radius R
    1/4 + (ln (R / 4h) + Euler's constant) / (2 pi h), for h well above the radius of the disc.
    """
    height, outer = 6.0, 30.0
    images = 0.25 + (np.log(outer / (4 * height)) + np.euler_gamma) / (2 * np.pi * height)
    assert resistance(height, outer) == pytest.approx(images, rel=2e-3)


def test_the_reference_is_extrapolated_within_its_error() -> None:
    finest = on_cells(1.0, OUTER, 2)
    assert resistance(1.0) == pytest.approx(finest, rel=2e-4)


def test_more_fluid_never_raises_the_resistance() -> None:
    """Rayleigh's monotonicity, which h / 2 breaks for films thicker than the disc is wide."""
    heights = np.geomspace(0.01, 1000.0, 600)
    assert (np.diff([thin(h) for h in heights]) < 0).all()


def test_access_never_shortens() -> None:
    """Else a disc's transfer would grow without bound with more fluid over it."""
    _, slope = access_length(np.geomspace(1e-4, 1e4, 1000), 1.0)
    assert (slope > 0).all()


def test_thin_film_is_the_edge_of_a_half_plane() -> None:
    zeta, _ = access_length(np.array(1e-3), 1.0)
    assert zeta / 1e-3 == pytest.approx((2 * np.log(2) / np.pi) ** 2, rel=1e-5)


def test_thick_film_no_longer_matters() -> None:
    zeta, slope = access_length(np.array(1e4), 1.0)
    assert zeta / np.pi == pytest.approx(resistance(20.0), rel=0.02)
    assert 0 < slope < 1e-7


def test_slope_and_scale() -> None:
    film = np.geomspace(5e-6, 50e-3, 60)
    zeta, slope = access_length(film, 1.25e-3)
    step = 1e-5 * film
    difference = (
        access_length(film + step, 1.25e-3)[0] - access_length(film - step, 1.25e-3)[0]
    ) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    np.testing.assert_allclose(access_length(2 * film, 2.5e-3)[0], 2 * zeta, rtol=1e-12)
