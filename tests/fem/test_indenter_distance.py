"""Distances to indenters: closed forms, properties that together prove them, and the kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import no_type_check

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.fem import numpy_indenter

from palpate.rigid import rotation_matrices, to_local
from palpate_fem.device import DEVICE, mat33s, scalars, vec3s
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.indenter.distance import distance, signed_distance
from palpate_fem.indenter.kernels import ON_AXIS, indenter_distance
from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind

Floats = NDArray[np.float64]

ROUNDING = 1e-16  # [m]; of sums of centimetres in float64
EVERY = pytest.mark.parametrize("name", indenter_names())
COORDINATE = st.floats(-0.02, 0.02)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


def cloud(count: int, seed: int = 0) -> Floats:
    """Points in and around an indenter, many of them near its tip."""
    random = np.random.default_rng(seed)
    wide = random.uniform((-0.016, -0.016, -0.02), (0.016, 0.016, 0.008), (count // 2, 3))
    near = random.uniform((-0.008, -0.008, -0.004), (0.008, 0.008, 0.001), (count - count // 2, 3))
    return np.concatenate([wide, near])


def one(primitive: Primitive) -> Indenter:
    return Indenter("one", (primitive,))


def test_a_sphere_has_the_distance_of_a_sphere() -> None:
    centre, radius = np.array([1e-3, -2e-3, 0.5e-3]), 3.5e-3
    ball = one(
        Primitive(PrimitiveKind.REVOLVED, (1e-3, -2e-3, 0.5e-3), (0.0, 0.0, 0.0, 0.0), radius)
    )
    points = cloud(500)
    away = points - centre
    length = np.linalg.norm(away, axis=1)
    gap, normal, hessian = distance(ball, points)
    direction = away / length[:, None]
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    np.testing.assert_allclose(gap, length - radius, atol=ROUNDING)
    np.testing.assert_allclose(normal, direction, atol=1e-12)
    curved = across / length[:, None, None]
    np.testing.assert_allclose(hessian, curved, rtol=1e-9, atol=1e-9)


def test_a_rounded_box_beside_its_faces_edges_and_corners() -> None:
    box = one(Primitive(PrimitiveKind.BOX, (0.0, 0.0, 0.0), (3.0, 2.0, 1.0, 0.0), 0.5))
    points = np.array([[0, 0, 2.5], [3 + 3, 2 + 4, 0], [5, 4, 2], [0.2, 0.1, 0.7], [0, 0, 1.3]])
    gap, normal, hessian = distance(box, points)
    np.testing.assert_allclose(gap, [1.0, 4.5, 2.5, -0.8, -0.2], atol=1e-15)
    np.testing.assert_allclose(
        normal,
        np.array([[0, 0, 1], [0.6, 0.8, 0], [2 / 3, 2 / 3, 1 / 3], [0, 0, 1], [0, 0, 1]]),
        atol=1e-15,
    )
    np.testing.assert_allclose(hessian[[0, 3, 4]], 0.0)
    np.testing.assert_allclose(np.linalg.eigvalsh(hessian[1]), [0, 0, 1 / 5], atol=1e-15)
    np.testing.assert_allclose(np.linalg.eigvalsh(hessian[2]), [0, 1 / 3, 1 / 3], atol=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ring_curves_both_ways(axis: int) -> None:
    # Profile: distance from the axis 4..6, along -3..-1, grown by 0.5.
    ring = one(
        Primitive(PrimitiveKind.REVOLVED, (0.0, 0.0, 0.0), (4.0, 6.0, -3.0, -1.0), 0.5, axis=axis)
    )

    def at(radius: float, position: float) -> list[float]:
        point = np.zeros((1, 3))
        point[0, (axis + 1) % 3] = radius
        point[0, axis] = position
        gap, _, hessian = distance(ring, point)
        return [float(gap[0]), *map(float, np.linalg.eigvalsh(hessian[0]))]

    # Gap and principal curvatures.
    assert at(8.0, -2.0) == pytest.approx([1.5, 0, 0, 1 / 8], abs=1e-15)  # beside the wall
    assert at(2.0, -2.0) == pytest.approx([1.5, -1 / 2, 0, 0], abs=1e-15)  # in the bore
    assert at(5.0, 1.0) == pytest.approx([1.5, 0, 0, 0], abs=1e-15)  # over the flat
    assert at(5.2, -1.2) == pytest.approx([-0.7, 0, 0, 0], abs=1e-15)  # inside
    # Over the outer rim, 3-4-5 away: 1/5 in the half plane, n_r / r = 0.6 / 9 round about.
    assert at(9.0, 3.0) == pytest.approx([4.5, 0, 0.6 / 9, 1 / 5], abs=1e-15)


@EVERY
def test_gradient_and_hessian_are_those_of_finite_differences(name: str) -> None:
    indenter, points, step = make_indenter(name), cloud(1500), 1e-7
    gap, normal, hessian = distance(indenter, points)
    smooth = np.abs(gap) < 8e-3
    slope, curvature = np.empty_like(normal), np.empty_like(hessian)
    for i in range(3):
        move = step * np.eye(3)[i]
        gap_up, normal_up, hessian_up = distance(indenter, points + move)
        gap_down, normal_down, hessian_down = distance(indenter, points - move)
        slope[:, i] = (gap_up - gap_down) / (2 * step)
        curvature[:, i] = (normal_up - normal_down) / (2 * step)
        # Seams, where curvature jumps, and medial axes, where the normal does, are not compared.
        jump = np.abs(hessian_up - hessian_down).max(axis=(1, 2))
        turn = np.abs(normal_up - normal_down).max(axis=1)
        smooth &= (jump < 0.02 * (1.0 + np.abs(hessian).max(axis=(1, 2)))) & (turn < 1e-2)
    assert smooth.mean() > 0.5
    np.testing.assert_allclose(slope[smooth], normal[smooth], atol=1e-6)
    size = 1.0 + np.abs(hessian[smooth]).max(axis=(1, 2))
    error = np.abs(curvature - hessian)[smooth].max(axis=(1, 2))
    assert (error / size).max() < 1e-4


@EVERY
def test_the_normal_has_length_1_and_the_hessian_is_symmetric_and_blind_to_it(name: str) -> None:
    _, normal, hessian = distance(make_indenter(name), cloud(2000, seed=1))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-14)
    size = 1.0 + np.abs(hessian).max(axis=(1, 2))
    assert (np.abs(hessian - hessian.transpose(0, 2, 1)).max(axis=(1, 2)) / size).max() < 1e-14
    along = np.abs(np.einsum("nij,nj->ni", hessian, normal)).max(axis=1)
    assert (along / size).max() < 1e-12


@EVERY
def test_outside_the_foot_of_the_normal_lies_on_the_surface(name: str) -> None:
    # With the Lipschitz bound this proves the distance: no point of the surface is nearer.
    indenter, points = make_indenter(name), cloud(2000, seed=2)
    gap, normal, _ = distance(indenter, points)
    outside = gap > 0.0
    foot = points[outside] - gap[outside, None] * normal[outside]
    np.testing.assert_allclose(signed_distance(indenter, foot), 0.0, atol=1e-14)


@EVERY
@settings(max_examples=60)
@given(a=POINT, b=POINT)
@example(a=(-0.00390625, 0.0, -0.001953125), b=(-2.220446049250313e-16, 0.0, -0.001953125))
def test_the_gap_changes_no_more_than_the_point_moves(
    name: str, a: tuple[float, float, float], b: tuple[float, float, float]
) -> None:
    points, indenter = np.array([a, b]), make_indenter(name)
    gap = signed_distance(indenter, points)
    if indenter.fillet_m > 0.0:  # with fillets the gap may jump deep inside; see the kernels
        assume(gap.min() > -0.3e-3)
    # So near to its axis a solid of revolution takes a point for one on it.
    assert abs(gap[0] - gap[1]) <= np.linalg.norm(points[0] - points[1]) + ON_AXIS


@EVERY
@settings(max_examples=30)
@given(
    position=POINT,
    turn=st.tuples(*4 * [st.floats(-1, 1)]).filter(lambda q: np.linalg.norm(q) > 0.1),
    seed=st.integers(0, 1000),
)
def test_moving_indenter_and_points_together_changes_nothing(
    name: str,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    seed: int,
) -> None:
    pose = np.array([*position, *(np.array(turn) / np.linalg.norm(turn))])
    points = cloud(40, seed)
    rotation = rotation_matrices(pose[3:])
    moved = points @ rotation.T + pose[:3]
    back = to_local(pose, moved)
    indenter = make_indenter(name)
    np.testing.assert_allclose(back, points, atol=1e-16 * 100)
    np.testing.assert_allclose(
        signed_distance(indenter, back), signed_distance(indenter, points), atol=1e-14
    )


@EVERY
def test_values_are_finite_on_axes_and_at_corners(name: str) -> None:
    indenter = make_indenter(name)
    special = [[0.0, 0.0, 0.0]]
    for part in indenter.primitives:
        for x in (-part.sizes[0], 0.0, part.sizes[0], part.sizes[1]):
            for z in (-part.sizes[2], 0.0, part.sizes[2], part.sizes[3]):
                special.append([part.centre[0] + x, part.centre[1], part.centre[2] + z])
                special.append([part.centre[0], part.centre[1] + z, part.centre[2] + x])
    points = np.array(special)
    gap, normal, hessian = distance(indenter, points)
    assert np.isfinite(gap).all()
    assert np.isfinite(hessian).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-14)
    np.testing.assert_array_equal(gap, signed_distance(indenter, points))
    # Here the kernel may choose another of several nearest points, but no other distance.
    kernel_gap, kernel_normal, kernel_hessian = launch(indenter, points, 1.0)
    np.testing.assert_allclose(kernel_gap, gap, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(kernel_normal, axis=1), 1.0, atol=1e-14)
    assert np.isfinite(kernel_hessian).all()


def test_a_line_curves_on_its_axis_as_beside_it() -> None:
    capsule = one(
        Primitive(PrimitiveKind.REVOLVED, (0.0, 0.0, 0.0), (0.0, 0.0, -5e-3, -2e-3), 2e-3)
    )
    _, normal, hessian = distance(capsule, np.array([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0]]))
    np.testing.assert_allclose(normal[0], [0, 0, 1])
    np.testing.assert_allclose(np.diag(hessian[0]), [500, 500, 0], atol=1e-9)
    np.testing.assert_allclose(hessian[0], hessian[1], atol=1e-3)


@EVERY
def test_inside_is_negative_and_outside_positive(name: str) -> None:
    indenter = make_indenter(name)
    inner = [
        [*p.centre[:2], p.centre[2]] for p in indenter.primitives if p.kind == PrimitiveKind.BOX
    ]
    if inner:
        assert (signed_distance(indenter, np.array(inner)) < 0.0).all()
    above = cloud(200) * (1, 1, 0) + (0, 0, 1e-6)
    assert (signed_distance(indenter, above) > 0.0).all()


@EVERY
def test_height_over_the_top_bounds_the_gap(name: str) -> None:
    points = cloud(500, seed=3)
    for part in make_indenter(name).primitives:
        assert (
            signed_distance(one(part), points) >= points[:, 2] - numpy_indenter.top(part) - ROUNDING
        ).all()


@wp.kernel(enable_backward=False)
@no_type_check  # Warp's annotations are not types
def distances(
    primitives: wp.array2d(dtype=wp.float64),
    margin: wp.float64,
    point_in: wp.array(dtype=wp.vec3d),
    gap_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    hessian_out: wp.array(dtype=wp.mat33d),
) -> None:
    """`indenter_distance` at many points; for comparison with the NumPy twin."""
    i = wp.tid()
    near = indenter_distance(primitives, point_in[i], margin)
    gap_out[i] = near.gap
    normal_out[i] = near.normal
    hessian_out[i] = near.hessian


def launch(indenter: Indenter, points: Floats, margin_m: float) -> tuple[Floats, Floats, Floats]:
    """Run the kernel."""
    count = len(points)
    gap, normal, hessian = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 3))
    wp.launch(
        distances,
        dim=count,
        inputs=[scalars(indenter.packed()), wp.float64(margin_m), vec3s(points)],
        outputs=[scalars(gap), vec3s(normal), mat33s(hessian)],
        device=DEVICE,
    )
    return gap, normal, hessian


@EVERY
def test_without_fillet_gap_and_normal_are_those_of_numpy_to_the_bit(name: str) -> None:
    indenter, points = replace(make_indenter(name), fillet_m=0.0), cloud(50_000, seed=6)
    gap, normal, _ = distance(indenter, points)
    same_gap, same_normal, _ = numpy_indenter.distance(indenter, points)
    np.testing.assert_array_equal(gap, same_gap)
    np.testing.assert_array_equal(normal, same_normal)


@EVERY
def test_the_kernel_is_the_same_function(name: str) -> None:
    indenter = make_indenter(name)
    filleted = indenter.fillet_m > 0.0  # NumPy then tries all pairs and triples of primitives
    points = cloud(60 if filleted else 5000, seed=4)
    gap, normal, hessian = numpy_indenter.distance(indenter, points)
    kernel_gap, kernel_normal, kernel_hessian = launch(indenter, points, 1.0)
    np.testing.assert_allclose(kernel_gap, gap, atol=1e-13 * 1e-2)
    np.testing.assert_allclose(kernel_normal, normal, atol=1e-12 if filleted else 1e-13)
    size = 1.0 + np.abs(hessian).max(axis=(1, 2))
    error = (np.abs(kernel_hessian - hessian).max(axis=(1, 2)) / size).max()
    assert error < (1e-7 if filleted else 1e-13)


@EVERY
@pytest.mark.parametrize("margin", [0.1e-3, 0.5e-3])  # less and more than a fillet
def test_beyond_the_margin_the_kernel_gives_a_bound_and_within_it_the_same(
    name: str, margin: float
) -> None:
    indenter, points = make_indenter(name), cloud(5000, seed=5)
    gap, normal, _ = distance(indenter, points)
    kernel_gap, kernel_normal, kernel_hessian = launch(indenter, points, margin)
    near = gap < margin
    assert near.any()
    assert (kernel_gap[~near] >= margin).all()
    assert (kernel_gap[~near] <= gap[~near] + ROUNDING).all()
    assert not kernel_normal[~near].any()
    assert not kernel_hessian[~near].any()
    np.testing.assert_allclose(kernel_gap[near], gap[near], atol=1e-15)
    np.testing.assert_allclose(kernel_normal[near], normal[near], atol=1e-13)
