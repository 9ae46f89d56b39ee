"""Triangles of an indenter for pictures: closed, outward, on the exact surface."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats, Ints
from palpate_fem.indenter.catalogue import BASE_M, indenter_names, make_indenter
from palpate_fem.indenter.distance import signed_distance
from palpate_fem.indenter.outline import SPACING_M, outline_of

ROUNDING_M = 1e-12
FACETS = 0.03
"""Share of the volume between flat triangles and a round surface, and in the edges they cut off."""


@pytest.fixture(scope="module", params=indenter_names())
def outline(request: pytest.FixtureRequest) -> tuple[str, Floats, Ints]:
    return request.param, *outline_of(request.param)


def test_it_lies_on_the_surface(outline: tuple[str, Floats, Ints]) -> None:
    name, vertices, triangles = outline
    indenter = make_indenter(name)
    np.testing.assert_allclose(signed_distance(indenter, vertices), 0.0, atol=ROUNDING_M)
    middles = signed_distance(indenter, vertices[triangles].mean(axis=1))
    assert np.abs(middles).max() < SPACING_M, "at most the edges are cut off"


def test_it_is_closed(outline: tuple[str, Floats, Ints]) -> None:
    """Each edge belongs to two triangles, which go along it in opposite directions."""
    _, vertices, triangles = outline
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert all((end, start) in there for start, end in there)
    assert set(triangles.ravel().tolist()) == set(range(len(vertices)))


def test_its_normals_point_outward(outline: tuple[str, Floats, Ints]) -> None:
    name, vertices, triangles = outline
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    enclosed = np.einsum("ti,ti->", a, np.cross(b, c)) / 6
    step = 0.25e-3  # not the grid that the triangles come from
    axes = [np.arange(low, high, step) for low, high in ((-15e-3, 15e-3),) * 2 + ((-18e-3, 1e-3),)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + step / 3
    inside = float((signed_distance(make_indenter(name), points) < 0).sum()) * step**3
    assert enclosed == pytest.approx(inside, rel=FACETS)


def test_it_reaches_from_tip_to_base(outline: tuple[str, Floats, Ints]) -> None:
    name, vertices, _ = outline
    assert vertices[:, 2].min() == pytest.approx(BASE_M, abs=ROUNDING_M)
    assert vertices[:, 2].max() == pytest.approx(0.0, abs=SPACING_M / 20), name


def test_public_names_are_understood() -> None:
    np.testing.assert_array_equal(outline_of("ring_7mm")[0], outline_of("ring")[0])
    with pytest.raises(ConfigError, match="'ring'"):
        outline_of("rnig")
