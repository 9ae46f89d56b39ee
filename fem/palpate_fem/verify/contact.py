"""Frictionless contact against Hertz, the flat punch, Johnson's roll, and two patch tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate_fem.arrays import Floats
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.contact import PosedIndenter
from palpate_fem.mechanics.state import ForceBalance
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.verify.bodies import MU, TIGHT, VerificationBody, ball, plane, pose, punch, roll
from palpate_fem.verify.check import Measurement, check, checks
from palpate_fem.verify.meshes import (
    graded,
    hollow_sphere,
    on_planes,
    quarter_disc,
    rectangle,
    slab,
)

FAR = 60.0  # size of the body over the contact's: a half-space to 1 %
GROWTH = 1.5
ACROSS = 8  # elements from the middle to the edge of contact
# Rounding errors in the large far elements are 1e-9 of the small force.
SETTINGS = replace(TIGHT, tolerance=1e-7, volume_tolerance=1e-9, gap_tolerance_m=1e-12)


# Rings and layers are finest, 0.05 of the radius, at the rim of the punch, where its pressure is
# singular. It lies between two rings, so that the force is that of a rim at its true radius.
PUNCH_RINGS = (0.3, 0.5, 0.65, 0.775, 0.875, 0.925, 0.975, 1.025, 1.075, 1.125)


def _pressed(
    mesh: SolidMesh, held: NDArray[np.bool_], indenter: Indenter, depth: float
) -> tuple[VerificationBody, ForceBalance]:
    """Press an indenter to a depth [m] into a body whose deep end is held."""
    held = held.copy()
    held[mesh.nodes[:, 2] > mesh.nodes[:, 2].max() - 1e-12] = True
    body = VerificationBody(mesh, held=held, settings=SETTINGS)
    return body, body.solve(PosedIndenter(indenter, pose((0.0, 0.0, depth)), 0.0))


def _quarter(mesh: SolidMesh) -> NDArray[np.bool_]:
    """Components held on the planes of symmetry x = 0 and y = 0."""
    held = on_planes(mesh)
    held[:, 2] = False
    return held


def _mean_square(balance: ForceBalance, distance: Floats) -> float:
    """Mean square distance from the middle, weighted with the nodal forces along z [m^2]."""
    force = -balance.indenter[:, 2]
    return float((force * distance**2).sum() / force.sum())


@checks(
    ("contact/Hertz force, R {radius} mm", 3e-2, "N"),
    ("contact/Hertz contact radius, R {radius} mm", 5e-2, "mm"),
    ("contact/Hertz pressure, R {radius} mm", 5e-2, "kPa"),
    radius={"3.5": 3.5e-3, "1.75": 1.75e-3},
)
def hertz(radius: float) -> tuple[Measurement, ...]:
    """A ball on a half-space, of which a quarter is meshed.

    Hertz: force F = 16/3 mu sqrt(R) d^1.5, contact radius a = sqrt(R d), and pressure in the middle
    p0 = 3 F / (2 pi a^2), F and a by their formulas. The measured radius is that of Hertz' pressure
    with the same mean square distance, a^2 = 5/2 <r^2>, which is not restricted to nodes.
    """
    depth = 1e-4
    a = np.sqrt(radius * depth)
    radii = graded(a / ACROSS, 1.3 * a, FAR * a, GROWTH)[2:]
    depths = graded(a / ACROSS, 0.5 * a, FAR * a, GROWTH)
    mesh = slab(*quarter_disc(radii, 8), depths, name="Hertz")
    body, balance = _pressed(mesh, _quarter(mesh), ball(radius), depth)
    contact = np.sqrt(2.5 * _mean_square(balance, np.hypot(*mesh.nodes[:, :2].T)))
    middle = np.hypot(*mesh.nodes[mesh.outer_faces, :2].transpose(2, 0, 1)) == 0
    pressure = body.state.indenter_pressure[middle].max()
    force = 16 / 3 * MU * np.sqrt(radius) * depth**1.5
    return (
        Measurement(-4 * balance.indenter[:, 2].sum(), force),
        Measurement(contact * 1e3, a * 1e3),
        Measurement(pressure * 1e-3, 1.5e-3 * force / (np.pi * radius * depth)),
    )


@check("contact/flat punch, force", 5e-2, "N")
def flat_punch() -> Measurement:
    """Sneddon: F = 8 mu a d under a flat-ended cylinder."""
    a, depth = 1e-3, 1e-5
    outside = PUNCH_RINGS[-1] + graded(0.05, 0.05, FAR, GROWTH)[1:]
    radii = a * np.concatenate([PUNCH_RINGS, outside])
    mesh = slab(*quarter_disc(radii, 8), a * graded(0.05, 0.1, FAR, GROWTH), name="punch")
    _, balance = _pressed(mesh, _quarter(mesh), punch(a, 1e-3 * a), depth)
    return Measurement(-4 * balance.indenter[:, 2].sum(), 8 * MU * a * depth)


@checks(
    ("contact/line contact, half width", 5e-2, "mm"),
    ("contact/line contact, pressure", 5e-2, "kPa"),
)
def line_contact() -> tuple[Measurement, ...]:
    """Roll on a half-space in plane strain, at the measured force F for each length.

    Johnson: half width a = sqrt(F R / (pi mu)), and p0 = 2 F / (pi a), a by its formula. The
    measured a^2 = 4 <x^2> is that of Johnson's pressure p0 sqrt(1 - x^2 / a^2).
    """
    radius, depth, width = 3.5e-3, 5e-5, 1e-4
    a = 2.0e-4
    x = graded(a / ACROSS, 1.3 * a, FAR * a, GROWTH)
    mesh = slab(
        *rectangle(x, np.array([0.0, width])),
        graded(a / ACROSS, 0.5 * a, FAR * a, GROWTH),
        name="line",
    )
    held = _quarter(mesh)
    held[:, 1] = True
    body, balance = _pressed(mesh, held, roll(radius, 1e-2), depth)
    force = -2 * float(balance.indenter[:, 2].sum()) / width
    contact = 2 * np.sqrt(_mean_square(balance, mesh.nodes[:, 0]))
    expected = np.sqrt(force * radius / np.pi / MU)
    return (
        Measurement(contact * 1e3, expected * 1e3, f"{force:.2f} N/m"),
        Measurement(body.state.indenter_pressure.max() * 1e-3, 2e-3 * force / np.pi / expected),
    )


@check("contact/patch test, {shake}", 1e-6, shake={"even quads": 0.0, "distorted quads": 0.2})
def contact_patch(shake: float) -> Measurement:
    """A block that a plane compresses: the pressure is uniform.

    Args:
        shake: Random displacement of the surface's nodes along it, as a share of an edge.
    """
    line = np.linspace(0.0, 1e-3, 6)
    points, quads = rectangle(line, line)
    inside = ((points > 0) & (points < 1e-3)).all(axis=1)
    random = np.random.default_rng(2)
    points[inside] += random.uniform(-1, 1, (int(inside.sum()), 2)) * shake * line[1]
    mesh = slab(points, quads, line[:3])
    held = _quarter(mesh)
    held[mesh.nodes[:, 2] == line[2], 2] = True
    body = VerificationBody(mesh, held=held)
    body.solve(PosedIndenter(plane(), pose((0.0, 0.0, 0.05 * line[2])), 0.0))
    pressure = body.state.indenter_pressure
    spread = float(np.abs(pressure / pressure.mean() - 1).max())
    return Measurement(spread, note=f"mean {pressure.mean() * 1e-3:.3f} kPa")


@check("contact/free slide of facets on a plane", 1e-6)
def free_slide() -> Measurement:
    """A coarse ball dragged over a frictionless plane: tangential over normal force.

    Contact between facets with barriers fails this ("No Free Slide").
    """
    mesh = hollow_sphere(4, 3e-3, 4e-3, 1)
    held = np.zeros(mesh.nodes.shape, bool)
    held[mesh.inner_nodes] = True
    body, worst = VerificationBody(mesh, held=held), 0.0
    press = PosedIndenter(plane(), pose((0.0, 0.0, -4e-3)), 0.0)
    for k in range(1, 9):
        balance = body.solve(press.at(pose((1e-4 * k, 0.5e-4 * k, -4e-3 + min(k, 2) * 1e-4))))
        x, y, z = -balance.indenter.sum(axis=0)
        worst = max(worst, float(np.hypot(x, y) / z))
    return Measurement(worst, note=f"{z:.3f} N")
