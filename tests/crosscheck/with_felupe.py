"""The problems solved by felupe (GPL-3): the same Q1P0 element, and Taylor-Hood Q2-Q1.

felupe is never imported by the package and never needed to install it; a test that uses this file
skips where felupe is absent.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from typing import Any

import numpy as np
from tests.crosscheck.cases import CASES
from tests.crosscheck.hexes import quadratic
from tests.crosscheck.problem import Floats, Problem, Solution

RESIDUAL = 1e-9  # norm of the unbalanced forces over that of the reactions (felupe's measure)
ITERATIONS = 16


def _linear_solver() -> Callable[..., Any]:
    """MKL's PARDISO where it is installed, else SciPy's SuperLU."""
    for module in ("pypardiso", "scipy.sparse.linalg"):
        try:
            return importlib.import_module(module).spsolve  # type: ignore[no-any-return]
        except ImportError:
            continue
    raise ImportError("neither pypardiso nor scipy")


def _march(problem: Problem, field: Any, solid: Any, faces: Any) -> Solution:
    """Apply all loads in equal steps.

    Args:
        problem: The nodes of the displacement field are those of the problem, in its order.
        field: Container whose first field is the displacement.
        solid: Item that assembles the elements.
        faces: Region of the faces under pressure, or None.
    """
    fe: Any = importlib.import_module("felupe")
    items = [solid]
    pressure = load = None
    if faces is not None:
        on_faces = fe.FieldContainer([fe.Field(faces, dim=3)])
        items.append(pressure := fe.SolidBodyPressure(on_faces))
    loaded = np.flatnonzero(np.any(problem.nodal_force != 0, axis=1))
    if len(loaded):
        items.append(load := fe.PointLoad(field, loaded))
    sizes = [f.values.size for f in field.fields]
    dof0 = np.flatnonzero(problem.held.ravel())
    dof1 = np.setdiff1d(np.arange(sum(sizes)), dof0)
    solver = _linear_solver()
    for step in range(1, problem.steps + 1):
        share = step / problem.steps
        if pressure is not None:
            pressure.update(share * problem.pressure_pa)
        if load is not None:
            load.update(share * problem.nodal_force[loaded])
        result = fe.newtonraphson(
            items=items,
            x0=field,
            dof0=dof0,
            dof1=dof1,
            ext0=share * problem.displacement.ravel()[dof0],
            solver=solver,
            tol=RESIDUAL,
            maxiter=ITERATIONS,
            verbose=0,
        )
        field = result.x
    moved = np.asarray(field[0].values, np.float64)
    unbalanced = np.asarray(result.fun)[: sizes[0]].reshape(-1, 3)
    return Solution(moved, np.where(problem.held, unbalanced, 0.0))


def solve(problem: Problem) -> Solution:
    """Q1P0: hexahedra with one pressure and one dilatation each, condensed."""
    fe: Any = importlib.import_module("felupe")
    mesh = fe.Mesh(problem.nodes, problem.hexes, "hexahedron")
    field = fe.FieldContainer([fe.Field(fe.RegionHexahedron(mesh), dim=3)])
    solid = fe.SolidBodyNearlyIncompressible(
        fe.NeoHooke(mu=problem.shear_modulus_pa), field, bulk=problem.bulk_modulus_pa
    )
    return _march(problem, field, solid, _faces(problem, mesh, fe.RegionHexahedronBoundary))


def _faces(problem: Problem, mesh: Any, region: Callable[..., Any]) -> Any:
    """The faces under pressure: those whose nodes are all nodes of the problem's pressure faces."""
    if not len(problem.pressure_faces):
        return None
    return region(mesh, mask=np.unique(problem.pressure_faces))


class DisplacementPressure:
    """W = mu/2 (J^(-2/3) I1 - 3) + p (J - 1) - p^2 / (2 kappa), pointwise in u and p."""

    def __init__(self, mu: float, kappa: float) -> None:
        fe: Any = importlib.import_module("felupe")
        self._isochoric = fe.NeoHooke(mu=mu)
        self._kappa = kappa
        self.x = [*self._isochoric.x[:1], np.zeros(1), np.zeros(0)]

    def gradient(self, x: list[Any], **_: Any) -> list[Any]:
        f, p, state = x[0], x[1], x[-1]
        stress = self._isochoric.gradient([f, state])[0]
        volume, cofactor = _cofactor(f)
        return [stress + p * cofactor, volume - 1 - p / self._kappa, state]

    def hessian(self, x: list[Any], **_: Any) -> list[Any]:
        f, p, state = x[0], x[1], x[-1]
        volume, cofactor = _cofactor(f)
        stiffness = self._isochoric.hessian([f, state])[0] + (p / volume) * (
            np.einsum("ij...,kl...->ijkl...", cofactor, cofactor)
            - np.einsum("il...,kj...->ijkl...", cofactor, cofactor)
        )
        return [stiffness, cofactor, np.full_like(p, -1 / self._kappa)]


def _cofactor(f: Floats) -> tuple[Floats, Floats]:
    """Determinant of F and its derivative, fields of trailing axes (point, element)."""
    matrix = np.moveaxis(f, (0, 1), (-2, -1))
    volume = np.linalg.det(matrix)
    cofactor = volume[..., None, None] * np.swapaxes(np.linalg.inv(matrix), -1, -2)
    return volume, np.moveaxis(cofactor, (-2, -1), (0, 1))


def solve_quadratic(problem: Problem) -> Solution:
    """Taylor-Hood Q2-Q1: the same nodes, every 2x2x2 hexahedra as one of 27 nodes.

    The pressure is continuous and trilinear between the corners of the larger elements. It is
    inf-sup stable, so what it converges to is free of locking and of pressure modes.
    """
    fe: Any = importlib.import_module("felupe")
    cells = quadratic(problem.hexes, problem.grids)
    mesh = fe.Mesh(problem.nodes, cells, "hexahedron27")
    region = fe.RegionTriQuadraticHexahedron(mesh)
    corners, linear = np.unique(cells[:, :8], return_inverse=True)
    dual = fe.RegionHexahedron(
        fe.Mesh(problem.nodes[corners], linear.reshape(-1, 8), "hexahedron"),
        quadrature=region.quadrature,
        grad=False,
    )
    field = fe.FieldContainer([fe.Field(region, dim=3), fe.Field(dual)])
    material = DisplacementPressure(problem.shear_modulus_pa, problem.bulk_modulus_pa)
    solid = fe.SolidBody(material, field)
    faces = _faces(problem, mesh, fe.RegionTriQuadraticHexahedronBoundary)
    return _march(problem, field, solid, faces)


def main() -> None:
    """Print the figures of all cases as JSON; about 4 minutes on one core."""
    fe: Any = importlib.import_module("felupe")
    figures: dict[str, dict[str, dict[str, float]]] = {"Q1P0": {}, "Taylor-Hood Q2-Q1": {}}
    for name, case in CASES.items():
        problem = case.make()
        figures["Q1P0"][name] = case.measure(problem, solve(problem))
        if case.taylor_hood:
            found = case.measure(problem, solve_quadratic(problem))
            figures["Taylor-Hood Q2-Q1"][name] = found
    print(json.dumps({"felupe": fe.__version__, **figures}, indent=1))  # noqa: T201


if __name__ == "__main__":
    main()
