"""Time one factorisation and one solve for many slots on a GPU, kernel by kernel.

    python tests/benchmarks/bench_batched_factor.py --slots 1 16 64 192 --out factor.json

The pattern is that of the twin's mesh, the matrices are diagonally dominant; every front is worked
on, as in the first factorisation of a press. Two right-hand sides. One slot's launches are a graph,
whose kernels are not timed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from palpate_fem.batched.factor import BatchedFactor
from palpate_fem.config import FingertipParameters
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac

COMMAND = "python tests/benchmarks/bench_batched_factor.py "


def dominant(indptr: Any, indices: Any) -> Any:
    """Entries of a positive definite matrix."""
    values = np.random.default_rng(0).uniform(-1.0, 1.0, len(indices))
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    total = np.zeros(len(indptr) - 1)
    np.add.at(total, rows, np.abs(values))
    np.add.at(total, indices, np.abs(values))
    values[indptr[:-1]] = total + 1.0
    return values


def timed(call: Callable[[], None]) -> tuple[float, float]:
    """Time until it is launched, and until it is done [ms]."""
    wp.synchronize()
    started = time.perf_counter()
    call()
    launched = time.perf_counter() - started
    wp.synchronize()
    return 1e3 * launched, 1e3 * (time.perf_counter() - started)


def measure(pattern: Any, slots: int, device: str) -> dict[str, Any]:
    """One factorisation and one solve."""
    indptr, indices = np.asarray(pattern.indptr), np.asarray(pattern.indices)
    factor = BatchedFactor(indptr, indices, pattern.free // 3, slots=slots, device=device)
    values = dominant(indptr, indices)
    one = wp.array(values, dtype=factor.values.dtype, device=device)
    nothing = wp.zeros_like(one)
    every = wp.array(np.arange(slots, dtype=np.int32), dtype=wp.int32, device=device)
    random = np.random.default_rng(1).normal(size=(slots, 2, len(indptr) - 1))
    vectors = wp.array(random, dtype=wp.float64, device=device)

    def put(source: wp.array) -> None:
        for slot in range(slots):
            wp.copy(factor.values, source, dest_offset=slot * len(values))

    def anew() -> None:
        """Change every entry, so that every front is worked on."""
        put(nothing)
        factor.factorise(every)
        put(one)

    for _ in range(2):  # what one slot's launches are kept as is made the second time
        anew()
        factor.factorise(every)
        factor.solve(every, vectors, 2)
    anew()
    factor_launch, factor_ms = timed(lambda: factor.factorise(every))
    solve_launch, solve_ms = timed(lambda: factor.solve(every, vectors, 2))
    anew()
    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    factor.factorise(every)
    factor.solve(every, vectors, 2)
    kernels: dict[str, float] = defaultdict(float)
    for event in wp.timing_end():
        kernels[event.name.removeprefix("forward kernel ").rsplit("_", 1)[0]] += event.elapsed
    return {
        "slots": slots,
        "factor_ms": factor_ms,
        "factor_launch_ms": factor_launch,
        "factor_ms_a_slot": factor_ms / slots,
        "solve_ms": solve_ms,
        "solve_launch_ms": solve_launch,
        "solve_ms_a_slot": solve_ms / slots,
        "kernels_ms": dict(sorted(kernels.items(), key=lambda pair: -pair[1])),
        "bad": int(factor.bad.numpy().sum()),
        "statistics": factor.statistics,
    }


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--slots", type=int, nargs="+", default=[64])
    parser.add_argument("--edge-mm", type=float, default=0.47)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    geometry = biotac(edge_m=1e-3 * options.edge_mm)
    pattern = Fingertip(geometry, FingertipParameters(), SolverSettings()).system.pattern
    report = {
        "device": wp.get_device(options.device).name,
        "command": COMMAND + shlex.join(sys.argv[1:]),
        "runs": [],
    }
    for slots in options.slots:
        run = measure(pattern, slots, options.device)
        report["runs"].append(run)
        sys.stdout.write(f"{run}\n")
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
