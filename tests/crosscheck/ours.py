"""The same problems by palpate's own solver; what the other codes' figures are compared with."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from tests.crosscheck.contact import Grading, SphereOnBlock, half_block
from tests.crosscheck.problem import Bools, Floats, Ints, Problem, Solution

from palpate_fem.indenter.shape import Indenter, Primitive, PrimitiveKind
from palpate_fem.mechanics.contact import ContactSettings, PosedIndenter
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.state import ForceBalance, SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.sparse.factor import SparseFactor, make_factor

UPSIDE_DOWN = (0.0, 1.0, 0.0, 0.0)  # half a turn about x: the indenter's body points to +z
NO_FACES = np.zeros((0, 3), np.int32)
SMALLEST_STEP = 1 / 64
# Newton's force tolerance, relative to the forces of fluid, contact, dead load and supports.
TIGHT = 1e-9


def _mesh(
    nodes: Floats, hexes: Ints, *, outer_faces: Ints | None = None, inner_faces: Ints | None = None
) -> SolidMesh:
    none = np.zeros(0, np.int32)
    return SolidMesh(
        nodes=nodes,
        elements=hexes,
        # a system wants a surface to touch, even if nothing does
        outer_faces=hexes[:1, 4:8] if outer_faces is None else outer_faces,
        outer_elements=none,
        inner_faces=NO_FACES if inner_faces is None or not len(inner_faces) else inner_faces,
        inner_elements=none,
        fixed=none,
        mirror=none,
    )


def _system(mesh: SolidMesh, mu: float, bulk_ratio: float, held: Bools) -> EquilibriumSystem:
    # The other codes have no barrier against a pinch, and a punch's edges come to it.
    return EquilibriumSystem(
        mesh,
        None,
        shear_modulus_pa=mu,
        bulk_ratio=bulk_ratio,
        contact=ContactSettings(),
        held=held,
        volume_barrier=0.0,
    )


def deform(problem: Problem) -> Solution:
    """Displacement and reactions at full load, with the same elements on the same nodes."""
    mesh = _mesh(problem.nodes, problem.hexes, inner_faces=problem.pressure_faces)
    ratio = problem.bulk_modulus_pa / problem.shear_modulus_pa
    system = _system(mesh, problem.shear_modulus_pa, ratio, problem.held)
    settings = NewtonSettings(
        tolerance=TIGHT, volume_tolerance=1e-9, iterations=30, keep_elastic=0.0
    )
    newton = NewtonSolver(system, _factor(system), settings)
    state, done, size = SolutionState.at_rest(mesh), 0.0, 1.0 / problem.steps
    while done < 1.0 - 1e-9:
        share = min(1.0, done + size)
        trial = state.copy()
        # straight on from the last state; at supports this is the prescribed displacement
        moved = state.position - problem.nodes
        trial.position += (share / done - 1.0) * moved if done else 0.0
        target = problem.nodes + share * problem.displacement
        trial.position[problem.held] = target[problem.held]
        trial.fluid_pressure = share * problem.pressure_pa
        system.load[:] = share * problem.nodal_force
        report, balance = newton.solve(trial, None, volume=None)
        if report.converged:
            state, done = trial, share
            continue
        size /= 2
        if size < SMALLEST_STEP / problem.steps:
            raise AssertionError(f"{problem.name} at {share:.3f} of the load: {report.reason}")
    unbalanced = balance.internal - state.fluid_pressure * balance.volume_gradient - system.load
    return Solution(state.position - problem.nodes, np.where(problem.held, unbalanced, 0.0))


def _factor(system: EquilibriumSystem) -> SparseFactor:
    return make_factor(
        system.pattern.indptr,
        system.pattern.indices,
        groups=system.pattern.free // 3,
        solver="fronts-double",
    )


@lru_cache(maxsize=4)
def indent(contact: SphereOnBlock, grading: Grading) -> Floats:
    """Force of the sphere on the whole block after every step of its path [N], shape (K, 3)."""
    nodes, hexes = half_block(contact, grading)
    held = np.column_stack(
        [np.zeros(len(nodes), bool), nodes[:, 1] == 0.0, np.zeros(len(nodes), bool)]
    )
    held[nodes[:, 2] == 0.0] = True
    tops = hexes[:, 4:8]
    outer = tops[(nodes[tops][:, :, 2] == contact.height_m).all(axis=1)]
    mesh = _mesh(nodes, hexes, outer_faces=outer)
    system = _system(mesh, contact.shear_modulus_pa, 1e4, held)
    newton = NewtonSolver(system, _factor(system), NewtonSettings())
    radius = contact.radius_m
    ball = Primitive(PrimitiveKind.REVOLVED, (0.0, 0.0, -radius), (0.0, 0.0, 0.0, 0.0), radius)
    start = np.array([0.0, 0.0, contact.height_m, *UPSIDE_DOWN])
    press = PosedIndenter(Indenter("ball", (ball,)), start, contact.friction)
    state, forces = SolutionState.at_rest(mesh), []
    system.update_anchors(state, press)
    was = np.zeros(3)
    for to in contact.path():
        done, size = 0.0, 1.0
        while done < 1.0 - 1e-9:
            share = min(1.0, done + size)
            pose = start.copy()
            pose[:3] += was + share * (to - was)
            trial, moved = state.copy(), press.at(pose)
            report, balance = newton.solve(trial, moved, volume=None)
            if report.converged:
                state, done = trial, share
                system.update_anchors(state, moved)
                continue
            size /= 2
            if size < SMALLEST_STEP:
                raise AssertionError(f"sphere at {to} m: {report.reason}")
        forces.append(_on_block(balance))
        was = to
    return np.array(forces)


def _on_block(balance: ForceBalance) -> Floats:
    half = -balance.indenter.sum(axis=0)
    return np.array([2 * half[0], 0.0, 2 * half[2]])
