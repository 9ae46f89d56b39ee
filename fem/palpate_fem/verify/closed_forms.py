"""Homogeneous stretches, inflated spheres and tubes against textbook formulas.

Also Cook's membrane against felupe, and the number of Newton iterations for two bulk moduli.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from palpate_fem.verify.bodies import MU, TIGHT, VerificationBody
from palpate_fem.verify.check import Measurement, check
from palpate_fem.verify.meshes import (
    KINDS,
    cooks_membrane,
    octant,
    on_planes,
    quarter_tube,
    rectangle,
    slab,
)

INNER_M, OUTER_M = 5.5e-3, 7.07e-3  # a ball of the BioTac's size
FINEST = (6, 3)  # edges of a patch of the octant, layers
EVER_FINER = ((2, 1), (4, 2), (8, 4))
# Thin walls and small strains leave fewer digits: strains are differences of rounded positions.
FEWER_DIGITS = replace(TIGHT, tolerance=1e-8, volume_tolerance=1e-9)


WAYS = {
    "uniaxial": (-1, False, False),
    "equibiaxial": (-4, True, False),
    "pure shear": (-2, False, True),
}


@check("closed/{way} stretch 1.5", 1e-8, way=WAYS)
def stretched(way: tuple[int, bool, bool]) -> Measurement:
    """Cauchy stress over mu along x of a cube: l^2 - l^power for J = 1.

    Args:
        way: Power of the stretch across, squared; whether y is stretched as x is; whether y keeps
            its length.
    """
    return Measurement(_pulled(way, 1.5, 0.0), 1.5**2 - 1.5 ** way[0], "sigma / mu")


@check("closed/{way} stretch 3, stiffening", 1e-7, way=WAYS)
def stiffened(way: tuple[int, bool, bool]) -> Measurement:
    """The same where m = I1 - 3 is 6 to 15: (1 + stiffening m^2) (l^2 - l^power)."""
    stretch, stiffening, (power, wide, plane) = 3.0, 0.004, way
    other = stretch**2 if wide else 1.0 if plane else 1 / stretch
    m = stretch**2 + other + stretch**power - 3
    exact = (1 + stiffening * m**2) * (stretch**2 - stretch**power)
    return Measurement(_pulled(way, stretch, stiffening), exact, "sigma / mu")


def _pulled(way: tuple[int, bool, bool], stretch: float, stiffening: float) -> float:
    """Cauchy stress over mu along x of a cube that is pulled."""
    _, wide, plane = way
    line = np.linspace(0.0, 1e-3, 3)
    mesh = slab(*rectangle(line, line), line)
    held, end = on_planes(mesh), np.abs(mesh.nodes - 1e-3) < 1e-9
    held[end[:, 0], 0] = True
    held[end[:, 1], 1] = wide or plane
    goal = mesh.nodes * [stretch, stretch if wide else 1.0, 1.0]
    body = VerificationBody(mesh, held=held, bulk_ratio=1e9, stiffening=stiffening)
    # So small that no point comes to the barrier of a pinch on the way.
    for share in np.linspace(0.0, 1.0, 1 + round(20 * (stretch - 1)))[1:]:
        at = mesh.nodes + share * (goal - mesh.nodes)
        body.state.position[held] = at[held]
        balance = body.solve()
    across = np.ptp(body.state.position[:, 1]) * np.ptp(body.state.position[:, 2])
    stress = body.reactions(balance)[end[:, 0], 0].sum() / across
    return float(stress / MU)


def thick_sphere(stretch: float, ratio: float) -> float:
    """Inflation of an incompressible neo-Hookean sphere by the stretch of its inner radius.

    p / mu = (2/lb + 1/(2 lb^4)) - (2/la + 1/(2 la^4)) with lb^3 = 1 + (la^3 - 1) / ratio^3.
    """
    outer = (1 + (stretch**3 - 1) / ratio**3) ** (1 / 3)
    return float((2 / outer + 0.5 / outer**4) - (2 / stretch + 0.5 / stretch**4))


def thick_tube(stretch: float, ratio: float) -> float:
    """The same as a tube in plane strain: p / mu = ln(la/lb) + (1/lb^2 - 1/la^2) / 2."""
    outer = (1 + (stretch**2 - 1) / ratio**2) ** 0.5
    return float(np.log(stretch / outer) + (outer**-2 - stretch**-2) / 2)


@cache
def blown(
    edges: int, layers: int, ratio: float, stretches: tuple[float, ...], wedges: bool = False
) -> dict[float, float]:
    """Compute p / mu of an eighth of a sphere at the volume of each stretch, by volume control."""
    mesh = octant(edges, INNER_M, INNER_M * ratio, layers, wedges=wedges)
    body = VerificationBody(mesh, held=on_planes(mesh), bulk_ratio=1e6, settings=FEWER_DIGITS)
    rest = body.system.balance(body.state, None).volume
    found, last = {}, 1.0
    for stretch in stretches:
        for between in np.linspace(last, stretch, 2 + int((stretch - last) / 0.2))[1:]:
            body.solve(volume=rest * between**3)
        found[stretch], last = body.state.fluid_pressure / MU, stretch
    return found


STRETCHES = (1.1, 1.25, 1.5, 2.0)
WIDER, SMALLER = (1.1, 1.5, 2.0), (1.05, 1.1, 1.2, 1.3)


@check("closed/thick sphere, {wedges}, stretch {stretch}", 1e-2, wedges=KINDS, stretch=STRETCHES)
def sphere(stretch: float, *, wedges: bool) -> Measurement:
    """Inflation of a thick sphere, B/A = 1.5, with three layers; through its limit point at 1.6."""
    return Measurement(
        blown(*FINEST, 1.5, STRETCHES, wedges)[stretch], thick_sphere(stretch, 1.5), "p / mu"
    )


@check("closed/sphere of the BioTac's size, stretch {stretch}", 1e-2, "kPa", stretch=SMALLER)
def sphere_of_biotac(stretch: float) -> Measurement:
    """The same at the BioTac's size."""
    ratio = OUTER_M / INNER_M
    found = blown(*FINEST, ratio, SMALLER)
    return Measurement(MU * found[stretch] * 1e-3, MU * thick_sphere(stretch, ratio) * 1e-3)


@check("closed/thick sphere, {wedges}, order", 0.1, at_least=True, wedges=KINDS)
def sphere_order(*, wedges: bool) -> Measurement:
    """Order of convergence: slope of log error over log edge, from the two finest meshes."""
    exact = thick_sphere(1.1, 1.5)
    error = [abs(blown(e, n, 1.5, (1.1,), wedges)[1.1] - exact) for e, n in EVER_FINER]
    note = "errors " + ", ".join(f"{e / exact:.2%}" for e in error)
    return Measurement(np.log2(error[1] / error[2]), 2.0, note)


@check("closed/ideal balloon, stretch {stretch}", 1e-2, stretch=(1.5,))
def balloon(stretch: float) -> Measurement:
    """Ideal balloon, thickness over radius t -> 0: p / mu = 2 t (1/l - 1/l^7)."""
    thin = 1e-3
    found = blown(6, 1, 1 + thin, (stretch,))[stretch] / thin
    return Measurement(found, 2 * (1 / stretch - 1 / stretch**7), "p R / (mu t), t / R = 0.001")


@cache
def _tube(stretches: tuple[float, ...], bulk_ratio: float, layers: int) -> dict[float, float]:
    """Compute p / mu of a tube, B/A = 1.5, whose inner nodes are moved outward."""
    around = 4 * layers
    mesh = quarter_tube(around, INNER_M, 1.5 * INNER_M, layers)
    held = on_planes(mesh)
    held[:, 2] = True
    bore = np.abs(np.hypot(*mesh.nodes[:, :2].T) - INNER_M) < 1e-9
    held[bore, :2] = True
    body = VerificationBody(mesh, held=held, bulk_ratio=bulk_ratio, settings=FEWER_DIGITS)
    found, last = {}, 1.0
    for stretch in stretches:
        for between in np.linspace(last, stretch, 2 + int((stretch - last) / 0.1))[1:]:
            body.state.position[bore, :2] = between * mesh.nodes[bore, :2]
            balance = body.solve()
        outward = mesh.nodes[bore, :2] / INNER_M
        push = float((body.reactions(balance)[bore, :2] * outward).sum())
        # Derivative of the area of the bore's polygon by the outward displacement of its nodes.
        growth = stretch * INNER_M * around * np.sin(np.pi / 2 / around)
        found[stretch] = push / growth / np.ptp(mesh.nodes[:, 2]) / MU
        last = stretch
    return found


@check("closed/thick tube, plane strain, stretch {stretch}", 1e-2, stretch=WIDER)
def tube(stretch: float) -> Measurement:
    """Inflation of a thick tube in plane strain, B/A = 1.5, with three layers."""
    return Measurement(_tube(WIDER, 1e6, 3)[stretch], thick_tube(stretch, 1.5), "p / mu")


SMALL = 1e-4  # strain; terms of second order are far below the tolerance


def bulk_ratio(nu: float) -> float:
    """Linear elasticity: kappa / mu = 2 (1 + nu) / (3 (1 - 2 nu))."""
    return 2 * (1 + nu) / 3 / (1 - 2 * nu)


def _lame_sphere(nu: float) -> Measurement:
    mesh = octant(8, INNER_M, 1.5 * INNER_M, 4)
    body = VerificationBody(
        mesh, held=on_planes(mesh), bulk_ratio=bulk_ratio(nu), settings=FEWER_DIGITS
    )
    rest = body.system.balance(body.state, None).volume
    body.solve(volume=rest * (1 + SMALL) ** 3)
    young, cube = 2 * (1 + nu), 1.5**3  # over mu; B^3 / A^3
    per_pressure = ((1 - 2 * nu) + (1 + nu) / 2 * cube) / (cube - 1) / young
    return Measurement(body.state.fluid_pressure / MU / SMALL, 1 / per_pressure, "p A / (mu u)")


def _lame_tube(nu: float) -> Measurement:
    found = _tube((1 + SMALL,), bulk_ratio(nu), 5)[1 + SMALL] / SMALL
    square = 1.5**2
    return Measurement(found, 2 * (square - 1) / ((1 - 2 * nu) + square), "p A / (mu u)")


@check("closed/Lame {shape}, nu {nu}", 5e-3, shape=("sphere", "tube"), nu=(0.3, 0.4999))
@cache
def lame(shape: str, nu: float) -> Measurement:
    """Lame's thick sphere or tube in plane strain: pressure per small displacement of the bore."""
    return (_lame_sphere if shape == "sphere" else _lame_tube)(nu)


@check("closed/Lame {shape}, change with nu", 5e-3, shape=("sphere", "tube"))
def lame_change(shape: str) -> Measurement:
    """Change of the relative error from nu = 0.3 to 0.4999, which would show locking."""
    errors = [m.value / m.reference - 1 for m in (lame(shape, 0.3), lame(shape, 0.4999))]
    return Measurement(errors[1] - errors[0], 0.0, f"errors {errors[0]:.2%}, {errors[1]:.2%}")


COOK_MU, COOK_BULK, COOK_FORCE = 80.194, 400_890.0, 100.0
# Vertical displacement of the free end's upper corner with felupe 11's hexahedra of constant
# pressure, by edges of a side; four digits are published, hence the tolerance.
COOK = {4: 6.020, 8: 6.619, 16: 6.814, 32: 6.884}
COOK_LIMIT = 6.92  # Richardson extrapolation


def cooks_corner(edges: int) -> float:
    """Vertical displacement of the corner: plane strain, a dead shear force at the free end."""
    mesh = cooks_membrane(edges)
    held = np.zeros(mesh.nodes.shape, bool)
    held[:, 2] = True
    held[mesh.nodes[:, 0] == 0] = True
    settings = replace(TIGHT, tolerance=1e-8, largest_move_m=3.0)
    body = VerificationBody(
        mesh, held=held, mu=COOK_MU, bulk_ratio=COOK_BULK / COOK_MU, settings=settings
    )
    end = np.flatnonzero(np.abs(mesh.nodes[:, 0] - 48.0) < 1e-9)
    height = mesh.nodes[end, 1]
    share = np.where((height == height.min()) | (height == height.max()), 0.5, 1.0)
    for part in np.linspace(0.0, 1.0, 6)[1:]:
        body.system.load[end, 1] = part * COOK_FORCE * share / share.sum()
        body.solve()
    corner = end[height == height.max()]
    return float((body.state.position - mesh.nodes)[corner, 1].mean())


@check("convergence/Cook's membrane, {edges} edges", 2e-4, edges=tuple(COOK))
def cook(edges: int) -> Measurement:
    """The same element in another code gives the same displacement."""
    return Measurement(cooks_corner(edges), COOK[edges], "felupe, Q1P0")


@check("convergence/Cook's membrane, limit", 1e-2)
def cook_limit() -> Measurement:
    """The element does not lock: the finest mesh is near the limit."""
    return Measurement(cooks_corner(32), COOK_LIMIT, "limit of felupe's series")


@check("newton/count does not grow with kappa", 1e-12, "iterations")
def newton_count() -> Measurement:
    """Newton iterations of an inflation by 10 % at kappa / mu = 1e6, against those at 1e2."""
    counts = []
    for ratio in (1e6, 1e2):
        mesh = octant(4, 5.5e-3, 7.07e-3, 2)
        settings = replace(TIGHT, tolerance=1e-8, volume_tolerance=1e-8)
        body = VerificationBody(mesh, held=on_planes(mesh), bulk_ratio=ratio, settings=settings)
        body.solve(volume=1.1 * body.system.balance(body.state, None).volume)
        counts.append(body.report.iterations)
    return Measurement(counts[0], counts[1])
