"""Between the poses of a path: straight, evenly turning, the shortest way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from palpate.rigid import LEVER_M, interpolate_pose, path_lengths, rotation_matrices

Floats = NDArray[np.float64]

COORDINATE = st.floats(-0.02, 0.02)
TURN = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
SHARE = st.floats(0.0, 1.0)


@st.composite
def poses(draw: st.DrawFn) -> Floats:
    turn = np.array(draw(TURN))
    place = [draw(COORDINATE) for _ in range(3)]
    return np.array([*place, *turn / np.linalg.norm(turn)])


def angle(a: Floats, b: Floats) -> float:
    """Of the turn between two poses [rad]; exact for small ones too."""
    first, second = a[3:], b[3:]
    apart = float(np.linalg.norm(first - second)), float(np.linalg.norm(first + second))
    return float(4.0 * np.arcsin(min(1.0, min(apart) / 2.0)))


@given(a=poses(), b=poses(), share=SHARE)
def test_between_poses_the_tip_goes_straight_and_turns_evenly(
    a: Floats, b: Floats, share: float
) -> None:
    pose = interpolate_pose(a, b, share)
    np.testing.assert_allclose(pose[:3], a[:3] + share * (b[:3] - a[:3]), atol=1e-17)
    assert np.linalg.norm(pose[3:]) == pytest.approx(1.0, abs=1e-14)
    whole = angle(a, b)
    if whole < np.pi - 1e-3:  # at half a turn there is no shortest way
        assert angle(a, pose) == pytest.approx(share * whole, abs=1e-6)
        assert angle(pose, b) == pytest.approx((1 - share) * whole, abs=1e-6)


@given(a=poses(), b=poses(), share=SHARE)
def test_interpolation_begins_ends_reverses_and_knows_both_signs(
    a: Floats, b: Floats, share: float
) -> None:
    assert angle(interpolate_pose(a, b, 0.0), a) < 1e-7
    assert angle(interpolate_pose(a, b, 1.0), b) < 1e-7
    np.testing.assert_array_equal(interpolate_pose(a, a, share)[:3], a[:3])
    if angle(a, b) < np.pi - 1e-3:
        there, back = interpolate_pose(a, b, share), interpolate_pose(b, a, 1.0 - share)
        np.testing.assert_allclose(there[:3], back[:3], atol=1e-16)
        assert angle(there, back) < 1e-6
        other = np.concatenate([b[:3], -b[3:]])
        turned = [rotation_matrices(interpolate_pose(a, end, share)[3:]) for end in (b, other)]
        np.testing.assert_allclose(turned[0], turned[1], atol=1e-9)


@given(corners=st.lists(st.tuples(*[COORDINATE] * 3), min_size=2, max_size=8))
def test_lengths_of_a_path_add_up(corners: list[tuple[float, float, float]]) -> None:
    path = np.array([[*corner, 1.0, 0.0, 0.0, 0.0] for corner in corners])
    lengths = path_lengths(path)
    assert lengths[0] == 0.0
    for k in range(1, len(path)):
        step = np.linalg.norm(path[k, :3] - path[k - 1, :3])
        assert lengths[k] - lengths[k - 1] == pytest.approx(step, abs=1e-15)


@given(first=poses(), second=poses(), sign=st.sampled_from([1.0, -1.0]))
def test_a_turn_is_as_long_as_its_arc(first: Floats, second: Floats, sign: float) -> None:
    path = np.array([first, second, [*first[:3], *(sign * second[3:])]])
    turn, back = angle(first, second), np.linalg.norm(second[:3] - first[:3])
    lengths = path_lengths(path)
    assert lengths[1] == pytest.approx(np.hypot(back, LEVER_M * turn), rel=1e-9, abs=1e-12)
    assert lengths[2] - lengths[1] == pytest.approx(back, rel=1e-9, abs=1e-12)
    assert path_lengths(path[[0, 2]])[1] == pytest.approx(LEVER_M * turn, rel=1e-7, abs=1e-12)


def test_parts_of_a_twist_add_up_to_it() -> None:
    half = np.deg2rad(np.linspace(0.0, 10.0, 9))
    path = np.zeros((9, 7))
    path[:, 3], path[:, 6] = np.cos(half), np.sin(half)
    np.testing.assert_allclose(path_lengths(path), LEVER_M * 2.0 * half, atol=1e-15)


def test_noise_of_an_orientation_hardly_lengthens_a_move() -> None:
    path = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (31, 1))
    path[:, 2] = 1e-4 * np.arange(31)
    path[1::2, 4] = 1e-3  # 0.1 degrees forth and back
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1, keepdims=True)
    assert path_lengths(path)[-1] == pytest.approx(3e-3, rel=3e-3)
