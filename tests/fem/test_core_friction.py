"""The laws of contact: what their iterations lead to, and their derivatives."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem.numpy_mechanics import ContactLaw, friction_law, normal_law, return_map

Floats = NDArray[np.float64]

LAW = ContactLaw(stiffness=2e9, friction=0.3, tangential_stiffness=8e8, complement=1e8)


def test_normal_law_pushes_and_never_pulls() -> None:
    gap = np.array([-2e-6, -2e-6, 1e-6, 1e-6])
    pressure = np.array([0.0, 5e3, 0.0, 5e3])
    wanted, stiffness = normal_law(LAW, pressure, gap)
    # The last one still has a pressure, so the linear solve may see it part.
    np.testing.assert_allclose(wanted, [4e3, 4e3, 0.0, -2e3])
    np.testing.assert_allclose(stiffness, [2e9, 2e9, 0.0, 2e9])


@given(
    pressure=st.floats(0.0, 1e6),
    arm=st.tuples(*[st.floats(-1e-3, 1e-3)] * 3),
    start=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    complement=st.floats(1e7, 8e8),
)
@settings(max_examples=100)
def test_friction_iterates_to_a_spring_capped_by_coulomb(
    pressure: float,
    arm: tuple[float, float, float],
    start: tuple[float, float, float],
    complement: float,
) -> None:
    law = ContactLaw(LAW.stiffness, LAW.friction, LAW.tangential_stiffness, complement)
    normal = np.array([[0.6, 0.0, 0.8]])
    p, t, way = np.array([pressure]), np.array([start]), np.array([arm])
    for _ in range(60):
        t = friction_law(law, p, t, normal, np.zeros((1, 3, 3)), way).wanted
    wanted = return_map(law, p, normal, way)
    np.testing.assert_allclose(t, wanted, atol=1e-6 + 1e-9 * pressure)
    # A length below 1e-150 has lost digits: its square is next to the smallest number.
    assert np.linalg.norm(wanted) <= law.friction * pressure * (1 + 1e-12) + 1e-150
    assert abs(normal[0] @ wanted[0]) < 1e-9 * (1.0 + pressure)


def test_friction_has_the_derivatives_of_the_capped_spring() -> None:
    """On a ball, whose normal turns as the point moves; sticking and sliding."""
    random = np.random.default_rng(0)
    count, radius = 60, 3.5e-3
    position = random.normal(size=(count, 3))
    position *= radius / np.linalg.norm(position, axis=1, keepdims=True)
    anchor = (
        position + random.normal(0.0, 2e-5, (count, 3)) * np.repeat([1.0, 9.0], count // 2)[:, None]
    )
    pressure = random.uniform(2e4, 1e5, count)

    def traction(x: Floats, p: Floats) -> Floats:
        normal = x / np.linalg.norm(x, axis=1, keepdims=True)
        return return_map(LAW, p, normal, x - anchor)

    normal = position / radius
    curvature = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / radius
    law = friction_law(
        LAW, pressure, traction(position, pressure), normal, curvature, position - anchor
    )
    assert law.sticks.any()
    assert not law.sticks.all()
    move, step = random.normal(size=(count, 3)), 1e-9
    up, down = (traction(position + sign * step * move, pressure) for sign in (1, -1))
    slope = np.einsum("nij,nj->ni", law.by_position, move)
    assert np.abs(slope - (up - down) / (2 * step)).max() < 1e-6 * np.abs(slope).max()
    more, less = (traction(position, pressure + sign) for sign in (1.0, -1.0))
    assert np.abs(law.by_pressure - (more - less) / 2).max() < 1e-6 * LAW.friction
