"""Problem B by GetFEM (LGPL): Taylor-Hood elements and Nitsche's contact with an analytic sphere.

How it differs from palpate's solver, so that agreement means something: 27-node elements with
continuous trilinear pressure, exactly incompressible (J = 1, no bulk modulus); contact and friction
without penalty and without multipliers (Nitsche's method, the variant theta = 0: the traction that
obeys Signorini and Coulomb is a projection of the solid's own stress); all tangents derived
symbolically by GetFEM.

GetFEM is a Debian package for the system's interpreter, so this file imports no palpate and runs as

    /usr/bin/python3 -m tests.crosscheck.with_getfem --friction 0.5 --fine 5

from the project's root. It prints one JSON object. Without pypardiso SuperLU solves, slower.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from tests.crosscheck.contact import Grading, SphereOnBlock
from tests.crosscheck.problem import Floats

# Lengths in mm and forces in N here, so that stresses in MPa and lengths are near 1.
MM = 1e3
MPA = 1e-6
FLOOR, MIRROR, TOP = 1, 2, 3  # regions of the mesh
RESIDUAL_N = 2e-7  # norm of the unbalanced nodal forces; contact forces are about 1 N
ITERATIONS = 30
STRESS = "(mu*(Id(3)+Grad_u)+p*Det(Id(3)+Grad_u)*(Inv(Id(3)+Grad_u)'))"  # first Piola-Kirchhoff
GAP = "(Norm(X+u-c)-R)"
NORMAL = "(-Normalized(X+u-c))"  # out of the block, into the sphere
TRACTION = (
    f"Coulomb_friction_coupled_projection({STRESS}*Normal,{NORMAL},(u-before-move),{GAP},f,gamma)"
)


def _regions(gf: Any, mesh: Any, height: float, reach: float) -> None:
    faces = mesh.outer_faces()
    points = mesh.pts()
    centre = np.array(
        [
            points[:, mesh.pid_in_faces(faces[:, i : i + 1])].mean(axis=1)
            for i in range(faces.shape[1])
        ]
    )
    near = (np.abs(centre[:, 0]) < reach) & (centre[:, 1] < reach)
    mesh.set_region(FLOOR, faces[:, np.isclose(centre[:, 2], 0.0)])
    mesh.set_region(MIRROR, faces[:, np.isclose(centre[:, 1], 0.0)])
    mesh.set_region(TOP, faces[:, np.isclose(centre[:, 2], height) & near])


class Block:
    """The half block in GetFEM: unknowns displacement u and pressure p."""

    def __init__(self, contact: SphereOnBlock, grading: Grading, gamma: float) -> None:
        gf: Any = importlib.import_module("getfem")
        gf.util("trace level", 0)
        gf.util("warning level", 0)
        self._gf = gf
        axes = [MM * axis for axis in grading.axes(contact)]
        height = MM * contact.height_m
        mesh = gf.Mesh("cartesian", *axes)
        # one ring of elements more than the fine zone may touch
        _regions(gf, mesh, height, MM * grading.zone_m * (1 + 0.5 / grading.fine))
        displacement = gf.MeshFem(mesh, 3)
        displacement.set_fem(gf.Fem("FEM_QK(3,2)"))
        pressure = gf.MeshFem(mesh, 1)
        pressure.set_fem(gf.Fem("FEM_QK(3,1)"))
        solid = gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(3,4)"))
        self._surface = gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(3,6)"))
        model = gf.Model("real")
        model.add_fem_variable("u", displacement)
        model.add_fem_variable("p", pressure)
        model.add_fem_data("before", displacement)
        mu, radius = MPA * contact.shear_modulus_pa, MM * contact.radius_m
        self._start = np.array([0.0, 0.0, height + radius])
        for name, value in {
            "mu": [mu],
            "f": [contact.friction],
            "gamma": [gamma],
            "R": [radius],
            "c": self._start,
            "move": np.zeros(3),
        }.items():
            model.add_initialized_data(name, value)
        model.add_nonlinear_term(solid, f"{STRESS}:Grad_Test_u")
        model.add_nonlinear_term(solid, "(Det(Id(3)+Grad_u)-1)*Test_p")
        model.add_nonlinear_term(self._surface, f"-({TRACTION}).Test_u", TOP)
        model.set_variable("p", np.full(pressure.nbdof(), -mu))  # no stress at rest
        at = displacement.basic_dof_nodes()
        across = np.arange(at.shape[1]) % 3 == 1
        held = np.isclose(at[2], 0.0) | (np.isclose(at[1], 0.0) & across)
        first = model.interval_of_variable("u")[0]
        self.unknowns = model.nbdof()
        self._free = np.setdiff1d(np.arange(self.unknowns), np.flatnonzero(held) + first)
        self._model = model
        self._solve = _linear_solver()
        self.iterations = 0
        self.state: Floats = np.asarray(model.from_variables())

    def move(self, was: Floats, to: Floats, guess: Floats) -> None:
        """Solve for the sphere at displacement `to` [mm]; slip is measured from `was`."""
        model = self._model
        model.to_variables(self.state)
        model.set_variable("before", model.variable("u"))
        model.set_variable("c", self._start + to)
        model.set_variable("move", to - was)
        for start in (guess, self.state):
            found = self._newton(start)
            if found is not None:
                self.state = found
                return
        raise RuntimeError(f"GetFEM: Newton failed with the sphere at {to} mm")

    def force(self) -> Floats:
        """Force of the sphere on the whole block [N]; y cancels with the other half."""
        self._model.to_variables(self.state)
        half = self._gf.asm_generic(self._surface, 0, TRACTION, TOP, self._model)
        return np.array([2 * half[0], 0.0, 2 * half[2]])

    def _residual(self, state: Floats) -> Floats:
        self._model.to_variables(state)
        self._model.assembly("build_rhs")
        return np.asarray(-self._model.rhs()[self._free])

    def _newton(self, state: Floats) -> Floats | None:
        sparse: Any = importlib.import_module("scipy.sparse")
        state = state.copy()
        residual = self._residual(state)
        for _ in range(ITERATIONS):
            norm = np.linalg.norm(residual)
            if norm < RESIDUAL_N:
                return state
            self._model.assembly("build_matrix")
            tangent = self._model.tangent_matrix()
            starts, rows = tangent.csc_ind()
            matrix = sparse.csc_matrix((tangent.csc_val(), rows, starts), shape=tangent.size())
            step = self._solve(matrix.tocsr()[self._free][:, self._free], -residual)
            self.iterations += 1
            trials = []
            for length in (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125):
                trial = state.copy()
                trial[self._free] += length * step
                residual = self._residual(trial)
                trials.append((float(np.linalg.norm(residual)), trial))
                if trials[-1][0] < (1 - 0.1 * length) * norm:
                    break
            state = min(trials, key=lambda pair: pair[0])[1]
            residual = self._residual(state)
        return None


def _linear_solver() -> Callable[[Any, Floats], Floats]:
    """MKL's unsymmetric PARDISO where it is installed, else SciPy's SuperLU."""
    try:
        pardiso: Any = importlib.import_module("pypardiso").PyPardisoSolver(mtype=11)
    except ImportError:
        linalg: Any = importlib.import_module("scipy.sparse.linalg")
        return lambda matrix, right: np.asarray(linalg.splu(matrix.tocsc()).solve(right))

    def solve(matrix: Any, right: Floats) -> Floats:
        matrix.sort_indices()
        return np.asarray(pardiso.solve(matrix, right))

    return solve


def indent(contact: SphereOnBlock, grading: Grading, gamma: float) -> dict[str, Any]:
    """Forces on the block after every step [N], and what they cost.

    Args:
        contact: The problem.
        grading: Its mesh.
        gamma: Nitsche's parameter [N/mm^3]; about 15 mu over the size of the elements [mm]. The
            press force hardly depends on it (0.2 % from 10 to 40 at 0.5 mm), but what sticks holds
            only weakly: at 10, it creeps a little with every step, and the press force at friction
            0.186 falls by 0.3 % from 6 to 12 steps; at 40, or on a finer mesh, by 0.1 %.
    """
    started = time.perf_counter()
    block = Block(contact, grading, gamma)
    was, forces = np.zeros(3), []
    states: list[Floats] = []
    for number, to in enumerate(MM * contact.path()):
        # secant predictor, but not across the first touch and the turn of the path
        turn = number in {contact.press_steps, contact.press_steps + 1}
        guess = 2 * states[-1] - states[-2] if number >= 2 and not turn else block.state
        block.move(was, to, guess)
        states = [*states[-1:], block.state]
        forces.append(block.force())
        was = to
    return {
        "force_n": [[round(float(v), 6) for v in force] for force in forces],
        "unknowns": block.unknowns,
        "iterations": block.iterations,
        "seconds": round(time.perf_counter() - started, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    grading, contact = Grading(), SphereOnBlock()
    for name in ("fine", "coarse", "layers"):
        parser.add_argument(f"--{name}", type=int, default=getattr(grading, name))
    parser.add_argument("--zone-m", type=float, default=grading.zone_m)
    for name in ("press_steps", "shear_steps"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=getattr(contact, name))
    for name in ("friction", "depth_m", "travel_m"):
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=float, default=getattr(contact, name)
        )
    parser.add_argument("--gamma", type=float, default=10.0)
    given = vars(parser.parse_args())
    contact = SphereOnBlock(
        **{k: given[k] for k in ("friction", "press_steps", "shear_steps", "depth_m", "travel_m")}
    )
    grading = Grading(**{k: given[k] for k in ("fine", "coarse", "layers", "zone_m")})
    print(json.dumps({**given, **indent(contact, grading, given["gamma"])}))  # noqa: T201


if __name__ == "__main__":
    main()
