# mypy: ignore-errors
"""Kernels of skin and fluid with a thread for each quadrature point, corner or pair of corners.

What ``mechanics.element_kernels`` does with a thread for each element, with the same functions.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from palpate_fem.batched.dense_tiles import THREADS
from palpate_fem.mechanics.element_kernels import (
    Scales,
    deformation,
    fluid_arm,
    left_of,
    nominal_stress,
    tangent_at_point,
    tangent_scales,
)

wp.set_module_options({"enable_backward": False})

Corners = wp.types.vector(length=8, dtype=wp.float64)
"""A number for each corner of an element."""


@wp.func_native("""
#ifdef __CUDA_ARCH__
    const int point = threadIdx.x % 8;
    const unsigned element = 0xffu << (threadIdx.x % 32 - point);
    double kept[8];
    #pragma unroll
    for (int a = 0; a < 8; ++a)
        kept[a] = values[a];
    #pragma unroll
    for (int half = 4; half > 0; half /= 2) {
        const bool upper = point & half;
        #pragma unroll
        for (int a = 0; a < half; ++a) {
            const double given = upper ? kept[a] : kept[a + half];
            kept[a] = (upper ? kept[a + half] : kept[a]) + __shfl_xor_sync(element, given, half);
        }
    }
    return kept[0];
#else
    return values[0];
#endif
""")
def sum_at_corner(values: Corners) -> wp.float64:
    """Sum over the eight threads of an element of what each gives to this thread's corner."""
    ...


@wp.func_native("""
#ifdef __CUDA_ARCH__
    const unsigned element = 0xffu << (threadIdx.x % 32 / 8 * 8);
    #pragma unroll
    for (int apart = 4; apart > 0; apart /= 2)
        value = fmin(value, __shfl_xor_sync(element, value, apart));
#endif
    return value;
""")
def smallest_of_element(value: wp.float64) -> wp.float64:
    """Smallest value of the eight threads of an element."""
    ...


@wp.kernel(launch_bounds=(THREADS, 2))
def element_state_by_point(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    volume_out: wp.array(dtype=wp.float64),
    smallest_jacobian_out: wp.array(dtype=wp.float64),
    volume_gradient_out: wp.array2d(dtype=wp.vec3d),
    force_out: wp.array(dtype=wp.vec3d),
):
    """`element_state` on a GPU, with a thread for each of eight quadrature points and corners.

    The threads of an element hand each other what they give to its corners.
    """
    item, q = wp.tid()
    e = items[item]
    s = e % elements.shape[0]
    begin = (e // elements.shape[0]) * nodes
    f = deformation(elements, gradient, position_in, s, q, begin)
    j = wp.determinant(f)
    w = weight[s, q]
    inverse_t = wp.transpose(wp.inverse(f))
    stress = nominal_stress(f, j, inverse_t, w, mu, barrier, stiffening, pressure_in[e])
    force = wp.vec3d()
    slope = wp.vec3d()
    for c in range(3):
        of_stress = Corners()
        of_volume = Corners()
        for a in range(8):
            g = gradient[s, q, a]
            of_stress[a] = stress[c, 0] * g[0] + stress[c, 1] * g[1] + stress[c, 2] * g[2]
            # dJ/dF = J F^-T
            of_volume[a] = (w * j) * (
                inverse_t[c, 0] * g[0] + inverse_t[c, 1] * g[1] + inverse_t[c, 2] * g[2]
            )
        force[c] = sum_at_corner(of_stress)
        slope[c] = sum_at_corner(of_volume)
    wp.atomic_add(force_out, begin + elements[s, q], force)
    volume_gradient_out[e, q] = slope
    shares = Corners()
    for a in range(8):
        shares[a] = w * j
    volume = sum_at_corner(shares)
    smallest = smallest_of_element(j)
    if q == 0:
        volume_out[e] = volume
        smallest_jacobian_out[e] = smallest


@wp.func
def put_matrix(matrix: wp.mat33d, at: int, numbers_out: wp.array2d(dtype=wp.float64)):
    """Write a matrix, each of its nine numbers to a row of its own.

    On a GPU neighbouring threads then write neighbouring numbers.
    """
    for i in range(3):
        for j in range(3):
            numbers_out[3 * i + j, at] = matrix[i, j]


@wp.func
def matrix_at(numbers_in: wp.array2d(dtype=wp.float64), at: int) -> wp.mat33d:
    """What `put_matrix` has written."""
    matrix = wp.mat33d()
    for i in range(3):
        for j in range(3):
            matrix[i, j] = numbers_in[3 * i + j, at]
    return matrix


@wp.kernel
def point_deformation(
    elements: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    mu: wp.float64,
    barrier: wp.float64,
    stiffening: wp.float64,
    nodes: int,
    items: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3d),
    pressure_in: wp.array(dtype=wp.float64),
    deformation_out: wp.array2d(dtype=wp.float64),
    inverse_out: wp.array2d(dtype=wp.float64),
    scales_out: wp.array2d(dtype=Scales),
):
    """What `point_state` makes its vectors of: F, F^-T (see `put_matrix`) and scales.

    On a GPU each pair of nodes makes the vectors that it needs: to write them and to read them
    again takes longer.
    """
    item, q = wp.tid()
    e = items[item]
    s = e % elements.shape[0]
    f = deformation(elements, gradient, position_in, s, q, (e // elements.shape[0]) * nodes)
    at = e * weight.shape[1] + q
    put_matrix(f, at, deformation_out)
    put_matrix(wp.transpose(wp.inverse(f)), at, inverse_out)
    scales_out[e, q] = tangent_scales(
        f, wp.determinant(f), weight[s, q], mu, barrier, stiffening, pressure_in[e]
    )


@wp.func
def put_share(share: wp.mat33d, at: int, share_out: wp.array2d(dtype=Any)):
    """Write what one element or face gives to a block, row by row."""
    for i in range(3):
        for j in range(3):
            share_out[at, 3 * i + j] = share_out.dtype(share[i, j])


@wp.kernel(launch_bounds=(THREADS, 3))
def element_tangent_by_pair(
    pair: wp.array3d(dtype=wp.int32),
    couples: wp.array(dtype=wp.vec2i),
    gradient: wp.array3d(dtype=wp.vec3d),
    bulk_over_volume: wp.array(dtype=wp.float64),
    items: wp.array(dtype=wp.int32),
    deformation_in: wp.array2d(dtype=wp.float64),
    inverse_in: wp.array2d(dtype=wp.float64),
    scales_in: wp.array2d(dtype=Scales),
    volume_gradient_in: wp.array2d(dtype=wp.vec3d),
    each: int,
    share_out: wp.array2d(dtype=Any),
):
    """`element_tangent` with a thread for each pair of corners, for a GPU, which has so many.

    ``couples`` has each pair of corners in one order, which need not be that of their nodes. Sets
    the first of the ``each`` shares of a mesh in its blocks, for one element after another.
    """
    item, couple = wp.tid()
    e = items[item]
    s = e % pair.shape[0]
    a = couples[couple][0]
    b = couples[couple][1]
    if pair[s, a, b] < 0:
        a = couples[couple][1]
        b = couples[couple][0]
    k = wp.outer(bulk_over_volume[s] * volume_gradient_in[e, a], volume_gradient_in[e, b])
    diagonal = wp.float64(0.0)
    for q in range(scales_in.shape[1]):
        scales = scales_in[e, q]
        of_a = gradient[s, q, a]
        of_b = gradient[s, q, b]
        diagonal += scales[0] * wp.dot(of_a, of_b)
        at = e * scales_in.shape[1] + q
        f = matrix_at(deformation_in, at)
        inverse = matrix_at(inverse_in, at)
        gb = inverse * of_b
        left_b = left_of(scales, f, of_b)
        k += tangent_at_point(
            scales, inverse * of_a, gb, left_of(scales, f, of_a), left_b, left_b + scales[4] * gb
        )
    k += diagonal * wp.identity(n=3, dtype=wp.float64)
    put_share(k, (e // pair.shape[0]) * each + s * couples.shape[0] + couple, share_out)


@wp.kernel
def cavity_tangent_by_pair(
    faces: wp.array2d(dtype=wp.int32),
    form: wp.array3d(dtype=wp.float64),
    nodes: int,
    items: wp.array(dtype=wp.int32),
    pressure_in: wp.array(dtype=wp.float64),
    position_in: wp.array(dtype=wp.vec3d),
    first: int,
    each: int,
    share_out: wp.array2d(dtype=Any),
):
    """`cavity_tangent` with a thread for each pair of corners.

    Sets the shares of a mesh from ``first`` on, for one face after another.
    """
    item, couple = wp.tid()
    f = items[item]
    s = f % faces.shape[0]
    copy = f // faces.shape[0]
    k = faces.shape[1]
    arm = fluid_arm(faces, form, position_in, s, couple // k, couple % k, copy * nodes)
    share = (wp.float64(6.0) * pressure_in[copy]) * wp.skew(arm)
    put_share(share, copy * each + first + s * k * k + couple, share_out)
