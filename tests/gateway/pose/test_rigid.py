"""Rigid transforms against matrices."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from palpate.messages import Pose
from palpate.rigid import compose, inverse, is_rotation

fakes: Any = importlib.import_module("pose_fakes")
matrix, poses = fakes.matrix, fakes.poses


@given(poses(), poses())
def test_composition_is_the_product_of_matrices(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=fakes.NEAR)


@given(poses())
def test_inverse_undoes(pose: Pose) -> None:
    for both in (compose(pose, inverse(pose)), compose(inverse(pose), pose)):
        np.testing.assert_allclose(matrix(both), np.eye(4), atol=fakes.NEAR)


@pytest.mark.parametrize(
    ("quaternion", "unit"),
    [
        ((1.0, 0.0, 0.0, 0.0), True),
        ((0.7071, 0.7071, 0.0, 0.0), True),  # printed with four digits
        ((0.9991, 0.0, 0.0, 0.0), True),
        ((0.9989, 0.0, 0.0, 0.0), False),
        ((1.0, 1.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0, 0.0), False),
        ((math.nan, 0.0, 0.0, 0.0), False),
        ((math.inf, 0.0, 0.0, 0.0), False),
    ],
)
def test_unit_quaternions(quaternion: tuple[float, float, float, float], unit: bool) -> None:
    assert is_rotation(quaternion) is unit
