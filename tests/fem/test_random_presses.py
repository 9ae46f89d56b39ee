"""Presses at random: what is drawn, and that each begins clear of the skin and meets it."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
import pytest

from palpate.errors import ConfigError
from palpate.rigid import rotation_matrices
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import BETWEEN, indenter_names, make_indenter
from palpate_fem.indenter.distance import signed_distance
from palpate_fem.mesh.parametric import biotac
from palpate_fem.random_presses import (
    DEPTH_LEAST_M,
    DEPTH_MOST_M,
    MOVED_SHARE,
    REGION,
    SLIDE_M,
    TILT_MOST_RAD,
    TILTED_DEPTH_MOST_M,
    TWIST_RAD,
    RandomPress,
    random_presses,
)

NAMES = indenter_names() + BETWEEN


@pytest.fixture(scope="module")
def skin() -> OuterSurface:
    mesh = biotac(edge_m=1.2e-3).mesh
    return OuterSurface(mesh.nodes, mesh.outer_faces)


@pytest.fixture(scope="module")
def drawn(skin: OuterSurface) -> list[RandomPress]:
    return list(random_presses(skin, 1300, seed=3, indenters=NAMES))


def test_more_of_them_begin_alike_and_another_seed_gives_others(
    skin: OuterSurface, drawn: list[RandomPress]
) -> None:
    fewer = list(random_presses(skin, 90, seed=3, indenters=NAMES))
    for one, other in zip(fewer, drawn, strict=False):
        assert (one.name, one.segments) == (other.name, other.segments)
        np.testing.assert_array_equal(one.path, other.path)
    (another,) = random_presses(skin, 1, seed=4, indenters=NAMES)
    assert another.segments != drawn[0].segments
    assert not np.allclose(another.target, drawn[0].target)


def test_every_indenter_gets_as_many_and_every_name_is_its_own(drawn: list[RandomPress]) -> None:
    assert Counter(one.indenter for one in drawn) == dict.fromkeys(NAMES, 100)
    assert len({one.name for one in drawn}) == len(drawn)
    assert drawn[13].name == f"{NAMES[0]}/00013/random"


def test_points_tilts_and_moves_fill_their_ranges(drawn: list[RandomPress]) -> None:
    points, normals = (np.array([getattr(one, key) for one in drawn]) for key in _PLACES)
    assert REGION.holds(points, normals).all()
    assert np.ptp(points[:, 0]) > 0.95 * (REGION.x_to_m - REGION.x_from_m)
    first = [one.segments[0] for one in drawn]
    tilts = np.array([segment.angle_rad for segment in first])
    assert 0.0 <= tilts.min() < 0.02
    assert tilts.max() > 0.97 * TILT_MOST_RAD
    depths = np.array([segment.amount for segment in first], float)
    most = DEPTH_MOST_M + (TILTED_DEPTH_MOST_M - DEPTH_MOST_M) * tilts / TILT_MOST_RAD
    assert ((DEPTH_LEAST_M <= depths) & (depths <= most)).all()
    for what in ("azimuth_rad", "turn_rad"):
        angles = np.array([getattr(segment, what) for segment in first])
        assert abs(np.exp(1j * angles).mean()) < 0.08  # even round the circle
    moves = [one.segments[1] for one in drawn if len(one.segments) > 1]
    count = Counter(move.kind for move in moves)
    assert set(count) == {"slide", "twist"}
    for kind in count:
        assert count[kind] / len(drawn) == pytest.approx(MOVED_SHARE, abs=0.04)
    for move in moves:
        low, high = SLIDE_M if move.kind == "slide" else TWIST_RAD
        assert low <= abs(move.amount or 0.0) <= high
    assert {math.copysign(1, one.amount or 0) for one in moves if one.kind == "twist"} == {-1, 1}


_PLACES = ("target", "normal")


def test_each_begins_clear_faces_where_it_goes_and_meets_the_skin(
    skin: OuterSurface, drawn: list[RandomPress]
) -> None:
    nodes = skin.nodes[np.unique(skin.faces)]
    for one in itertools.islice(drawn, 0, None, 20):
        indenter, path = make_indenter(one.indenter), one.path
        check_clear(indenter, path[0], skin)
        turns = rotation_matrices(path[:, 3:])
        np.testing.assert_allclose(turns[0][:, 2], one.direction, atol=1e-12)
        way = path[1, :3] - path[0, :3]
        np.testing.assert_allclose(way / np.linalg.norm(way), one.direction, atol=1e-9)
        end = len(path) - 1 if len(one.segments) == 1 else 2
        inside = (nodes - path[end, :3]) @ turns[end]
        assert signed_distance(indenter, inside).min() < 0.0


def test_without_indenters_nothing_is_drawn(skin: OuterSurface) -> None:
    with pytest.raises(ConfigError, match="no indenters"):
        next(random_presses(skin, 1, seed=0, indenters=()))
