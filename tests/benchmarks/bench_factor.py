"""A whole factorisation of a press's tangents: ours, MKL's PARDISO, and the dense peak.

In turns, so that all meet the same disturbances by the host; CPU time, on one thread each. Both
work in single precision. PARDISO is not a dependency; install MKL elsewhere and name its library:

    python -m venv /tmp/mkl && /tmp/mkl/bin/pip install mkl
    .venv/bin/python tests/benchmarks/bench_factor.py --mkl /tmp/mkl/lib/libmkl_rt.so.3

Without ``--mkl`` ours is measured alone.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.rigid import unit
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationOutcome
from palpate_fem.sparse.blas import one_thread
from palpate_fem.sparse.factor import Multifrontal, make_factor
from palpate_fem.trajectory import NORMAL_DEPTH_M, press_path, sample_targets

Floats = NDArray[np.float64]

MATRICES = 8
DENSE = 1000
"""Size of the dense product whose rate is the peak."""


class Pardiso:
    """MKL's Cholesky factor (matrix type 2) in single precision, ordered by METIS."""

    ANALYSE, FACTORISE, SOLVE = 11, 22, 33
    SEQUENTIAL = 1

    def __init__(self, library: Path, indptr: NDArray[Any], indices: NDArray[Any]) -> None:
        mkl = ctypes.CDLL(str(library))
        mkl.MKL_Set_Threading_Layer(self.SEQUENTIAL)
        self._routine = mkl.pardiso
        self._handle, self._options = np.zeros(64, np.int64), np.zeros(64, np.int32)
        # No defaults · METIS · report entries of the factor and MFlop · single precision.
        self._options[[0, 1, 17, 18, 27]] = 1, 2, -1, -1, 1
        self._starts, self._columns = (indptr + 1).astype(np.int32), (indices + 1).astype(np.int32)
        size = len(indptr) - 1
        self._values = np.zeros(len(indices), np.float32)
        self._right, self._answer = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self._permutation = np.zeros(size, np.int32)

    def analyse(self, values: Floats) -> tuple[float, float]:
        """Order the matrix; returns entries and operations [GFlop] of the factor."""
        self._values[:] = values
        self._call(self.ANALYSE)
        return float(self._options[17]), float(self._options[18]) * 1e-3

    def factorise(self, values: Floats) -> None:
        self._values[:] = values
        self._call(self.FACTORISE)

    def solve(self, right: Floats) -> NDArray[np.float32]:
        self._right[:] = right
        self._call(self.SOLVE)
        return self._answer

    def _call(self, phase: int) -> None:
        error = ctypes.c_int32(0)
        arrays = [
            ctypes.c_void_p(a.ctypes.data)
            for a in (
                self._handle, self._values, self._starts, self._columns, self._permutation,
                self._options, self._right, self._answer,
            )
        ]  # fmt: skip
        handle, values, starts, columns, permutation, options, right, answer = arrays
        one, kind, quiet = ctypes.c_int32(1), ctypes.c_int32(2), ctypes.c_int32(0)
        size, step = ctypes.c_int32(len(self._right)), ctypes.c_int32(phase)
        by = ctypes.byref
        self._routine(
            handle, by(one), by(one), by(kind), by(step), by(size), values, starts, columns,
            permutation, by(one), options, by(quiet), right, answer, by(error),
        )  # fmt: skip
        if error.value:
            raise ArithmeticError(f"PARDISO: error {error.value} in phase {phase}")


def tangents() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[Floats]]:
    """Pattern, nodes and values of tangents of the default fingertip, from rest into contact."""
    geometry = biotac()
    tip = Fingertip.pressurised(geometry)
    pattern, found = tip.system.pattern, []
    factorise = tip.newton.factor.factorise

    def keep(values: Floats) -> None:
        found.append(values.copy())
        factorise(values)

    tip.newton.factor.factorise = keep  # type: ignore[method-assign]
    surface = OuterSurface(tip.nodes, geometry.mesh.outer_faces)
    targets, normals = sample_targets(surface, 1, seed=0)
    indenter = make_indenter("sphere_medium")
    way = -unit(normals[0], "normal")
    path = press_path(indenter, targets[0], way, surface, depth_m=NORMAL_DEPTH_M)
    tip.indent(
        indenter,
        path,
        should_stop=lambda: IndentationOutcome.CANCELLED if len(found) >= MATRICES else None,
    )
    return pattern.indptr, pattern.indices, pattern.free // 3, found[:MATRICES]


def measure(library: Path | None, runs: int) -> dict[str, Any]:
    """Medians of CPU times [ms], and the smallest, median and largest ratio."""
    indptr, indices, groups, matrices = tangents()
    ours = make_factor(indptr, indices, groups=groups, solver="fronts")
    assert isinstance(ours, Multifrontal)
    theirs = Pardiso(library, indptr, indices) if library else None
    ours.factorise(matrices[0])
    report: dict[str, Any] = {key: round(value, 3) for key, value in ours.statistics.items()}
    if theirs:
        entries, gflop = theirs.analyse(matrices[0])
        report |= {"pardiso_entries": entries, "pardiso_gflop": gflop}
    right = np.random.default_rng(0).normal(size=len(indptr) - 1)
    dense = np.random.default_rng(0).normal(size=(DENSE, DENSE)).astype(np.float32)
    times: dict[str, list[float]] = {}

    def clocked(name: str, work: Callable[[], object]) -> None:
        started = time.process_time()
        work()
        times.setdefault(name, []).append(1e3 * (time.process_time() - started))

    for run in range(runs + 1):  # the first warms up
        # All entries differ from those of the last run: no front is kept.
        values = (1.0 + 1e-3 * (run + 1)) * matrices[run % len(matrices)]
        clocked("ours_factor_ms", lambda v=values: ours.factorise(v))  # type: ignore[misc]
        assert ours.redone == ours.statistics["factor_fronts"]
        clocked("ours_solve_ms", lambda: ours.solve(right))
        if theirs:
            clocked("pardiso_factor_ms", lambda v=values: theirs.factorise(v))  # type: ignore[misc]
            clocked("pardiso_solve_ms", lambda: theirs.solve(right))
        clocked("dense_ms", lambda: dense @ dense)
    series = {name: np.array(values[1:]) for name, values in times.items()}
    report |= {name: round(float(np.median(values)), 2) for name, values in series.items()}
    peak = 2e-6 * DENSE**3 / series["dense_ms"]
    report["dense_gflops"] = round(float(np.median(peak)), 1)
    rate = 1e3 * ours.statistics["factor_gflop"] / series["ours_factor_ms"]
    report["ours_share_of_dense"] = round(float(np.median(rate / peak)), 3)
    if theirs:
        for part in ("factor", "solve"):
            ratio = series[f"ours_{part}_ms"] / series[f"pardiso_{part}_ms"]
            spread = np.min(ratio), np.median(ratio), np.max(ratio)
            report[f"{part}_ratio"] = [round(float(value), 3) for value in spread]
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mkl", type=Path, help="MKL's libmkl_rt")
    parser.add_argument("--runs", type=int, default=12)
    options = parser.parse_args()
    if options.mkl is None:
        print("PARDISO is left out: --mkl names no library")  # noqa: T201
    with one_thread():
        report = measure(options.mkl, options.runs)
    print(json.dumps(report, indent=1))  # noqa: T201


if __name__ == "__main__":
    main()
