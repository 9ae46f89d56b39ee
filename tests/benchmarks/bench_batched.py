"""Many presses at once on a GPU: time a trajectory, and agreement with the CPU.

    python tests/benchmarks/bench_batched.py --slots 1 16 64 192 --out batched.json
    ... --edge-mm 0.47 0.6 0.38      other meshes, one after the other
    ... --together 2                 slots and presses shared by two processes on the device

Presses are the twin's: points of the pad in turn with the nine indenters, one 3 mm deep along the
normal and one 1.5 mm deep at 30 degrees to it, in 20 steps. ``--check N`` computes N of the first
mesh on the CPU, too, in ``--processes`` processes. ``--tightened 10`` divides all tolerances by
so much. Results are written after each size. ``docs/make_fem_batched.py`` makes a page of them.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shlex
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import warp as wp

from palpate.rigid import unit
from palpate_fem.batched.fingertip import BatchedFingertip, BatchedPress
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import IndentationResult
from palpate_fem.trajectory import (
    ANGLE_RAD,
    ANGLED_DEPTH_M,
    NORMAL_DEPTH_M,
    angled_direction,
    press_path,
    sample_targets,
)


def presses_on(tip: Fingertip, count: int) -> list[BatchedPress]:
    """The first presses: nine indenters, normal and angled, at points of the pad."""
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    targets, normals = sample_targets(surface, -(-count // 18), seed=1)
    presses = []
    for k in range(count):
        point, kind = divmod(k, 18)
        number, angled = divmod(kind, 2)
        normal = normals[point]
        way = angled_direction(normal, ANGLE_RAD, point) if angled else -unit(normal, "normal")
        depth = ANGLED_DEPTH_M if angled else NORMAL_DEPTH_M
        indenter = make_indenter(indenter_names()[number])
        path = press_path(indenter, targets[point], way, surface, depth_m=depth)
        presses.append(BatchedPress(number, path))
    return presses


def fingertip(edge_m: float, tightened: float = 1.0) -> Fingertip:
    """The twin's, with tolerances that are ``tightened`` times smaller than usual."""
    usual = NewtonSettings()
    newton = replace(
        usual,
        tolerance=usual.tolerance / tightened,
        volume_tolerance=usual.volume_tolerance / tightened,
        gap_tolerance_m=usual.gap_tolerance_m / tightened,
        traction_tolerance=usual.traction_tolerance / tightened,
        iterations=usual.iterations if tightened == 1.0 else 3 * usual.iterations,
        mortar_updates=usual.mortar_updates if tightened == 1.0 else 30,
    )
    return Fingertip.pressurised(biotac(edge_m=edge_m), None, SolverSettings(newton=newton))


def on_cpu(
    edge_m: float, tightened: float, count: int, numbers: list[int]
) -> dict[int, dict[str, Any]]:
    """The same presses by the CPU's solver."""
    tip = fingertip(edge_m, tightened)
    presses = presses_on(tip, count)
    found = {}
    for k in numbers:
        indenter = make_indenter(indenter_names()[presses[k].indenter])
        started = time.process_time()
        result = tip.indent(indenter, presses[k].path)
        found[k] = summary(result) | {"cpu_s": time.process_time() - started}
    return found


def summary(result: IndentationResult) -> dict[str, Any]:
    """What is compared of a result."""
    return {
        "indenter": result.indenter,
        "outcome": str(result.outcome),
        "reason": result.reason,
        "travel_m": result.travel_m,
        "forces": result.forces,
        "last": result.steps[-1].displacement if result.steps else None,
        "iterations": sum(step.convergence.iterations for step in result.steps),
        "factorisations": sum(step.convergence.factorisations for step in result.steps),
        "increments": sum(step.convergence.increments for step in result.steps),
    }


def say(value: object) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{value}\n")
    sys.stdout.flush()


def differences(ours: dict[str, Any], cpu: dict[str, Any]) -> dict[str, Any]:
    """How far two summaries are apart."""
    steps = min(len(ours["forces"]), len(cpu["forces"]))
    size = float(np.linalg.norm(cpu["forces"], axis=1).max(initial=1e-9))
    force = float(np.abs(ours["forces"][:steps] - cpu["forces"][:steps]).max(initial=0.0)) / size
    field = float("nan")
    if len(ours["forces"]) == len(cpu["forces"]) and steps:
        field = float(np.linalg.norm(ours["last"] - cpu["last"], axis=1).max())
    return {
        "indenter": cpu["indenter"],
        "steps": [len(ours["forces"]), len(cpu["forces"])],
        "outcome": [ours["outcome"], cpu["outcome"]],
        "reason": [ours["reason"], cpu["reason"]],
        "force_relative": force,
        "last_field_m": field,
        "iterations": [ours["iterations"], cpu["iterations"]],
        "cpu_s": cpu["cpu_s"],
    }


def kernel_times(results: list[Any]) -> dict[str, float]:
    """Time of each kernel on a GPU [s], the longest first; ``results`` of `warp.timing_end`."""
    spent: dict[str, float] = defaultdict(float)
    for one in results:
        spent[one.name.removeprefix("forward kernel ")] += 1e-3 * one.elapsed
    return dict(sorted(spent.items(), key=lambda pair: -pair[1]))


@dataclass
class Progress:
    """How many slots were busy in each sweep, and when there was no press left to begin.

    The end of a batch, when slots are empty as no press is left, is short in a long sweep and long
    in a benchmark. So the time with all slots taken is told on its own.
    """

    at_work: list[int] = field(default_factory=list)
    full_sweeps: int = 0
    started: float = field(default_factory=time.perf_counter)
    full_s: float = 0.0

    def feed(self, presses: Sequence[BatchedPress]) -> Iterator[BatchedPress]:
        """The presses; notes when the last one is taken."""
        yield from presses
        self.full_s, self.full_sweeps = time.perf_counter() - self.started, len(self.at_work)

    def full_ms(self, presses: int) -> float:
        """Time of a trajectory while all slots were taken [ms]: by its share of the sweeps."""
        each = sum(self.at_work) / presses
        return 1e3 * self.full_s * each / max(1, sum(self.at_work[: self.full_sweeps]))


def time_slots(
    tip: Fingertip,
    presses: list[BatchedPress],
    slots: int,
    device: str,
    *,
    parts: bool = False,
    start: Barrier | None = None,
) -> tuple[dict[str, Any], dict[int, IndentationResult]]:
    """Solve presses in so many slots; kernels are compiled for one before, then all wait."""
    indenters = [make_indenter(name) for name in indenter_names()]
    batched = BatchedFingertip(tip, indenters, slots=slots, device=device)
    for chosen in (presses[:1], presses):
        if start is not None and chosen is presses:
            start.wait()
        if parts:
            wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
        progress = Progress()
        fed = progress.feed(chosen)
        results = dict(batched.indent(fed, on_sweep=progress.at_work.append))
        seconds = time.perf_counter() - progress.started
        spent = kernel_times(wp.timing_end()) if parts else {}
    found = [summary(result) for _, result in sorted(results.items())]
    slowest = sorted(range(len(found)), key=lambda k: -found[k]["iterations"])[:5]
    run = {
        "unknowns": len(tip.system.pattern.free),
        "slots": slots,
        "presses": len(presses),
        "seconds": seconds,
        "ms_a_trajectory": 1e3 * seconds / len(presses),
        "ms_while_full": progress.full_ms(len(presses)),
        "sweeps": len(progress.at_work),
        "full_sweeps": progress.full_sweeps,
        "outcomes": Counter(one["outcome"] for one in found),
        "iterations": float(np.mean([one["iterations"] for one in found])),
        "factorisations": float(np.mean([one["factorisations"] for one in found])),
        "slowest": [
            [k, found[k]["indenter"], found[k]["outcome"], found[k]["iterations"]] for k in slowest
        ],
        "kernels_s": spent,
    }
    return run, results


def time_share(
    edge_m: float, count: int, slots: int, device: str, number: int, start: Barrier
) -> dict[str, Any]:
    """Solve one process's share of the presses."""
    tip = fingertip(edge_m)
    presses = np.array_split(np.array(presses_on(tip, count), object), start.parties)[number]
    run, _ = time_slots(tip, list(presses), slots // start.parties, device, start=start)
    return run


def time_together(
    edge_m: float, count: int, slots: int, device: str, together: int
) -> dict[str, Any]:
    """Solve presses in several processes that share the device, its slots and the presses."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, context.Pool(together) as pool:
        start = manager.Barrier(together)
        shares = [(edge_m, count, slots, device, number, start) for number in range(together)]
        runs = pool.starmap(time_share, shares, chunksize=1)
    each = [run["presses"] / count for run in runs]
    mean = {
        key: float(np.average([run[key] for run in runs], weights=each))
        for key in ("iterations", "factorisations")
    }
    seconds = max(run["seconds"] for run in runs)
    return mean | {
        "unknowns": runs[0]["unknowns"],
        "slots": slots,
        "together": together,
        "presses": count,
        "seconds": seconds,
        "ms_a_trajectory": 1e3 * seconds / count,
        "ms_while_full": 1.0 / sum(1.0 / run["ms_while_full"] for run in runs),
        "outcomes": sum((run["outcomes"] for run in runs), Counter()),
    }


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--slots", type=int, nargs="+", default=[64])
    parser.add_argument("--rounds", type=float, default=2.0, help="presses for each slot")
    parser.add_argument("--edge-mm", type=float, nargs="+", default=[0.47])
    parser.add_argument("--parts", action="store_true", help="time each kernel")
    parser.add_argument("--together", type=int, default=1, help="processes that share the device")
    parser.add_argument("--check", type=int, default=0, help="presses to compare with the CPU's")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--tightened", type=float, default=1.0, help="divides all tolerances")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.together > 1 and (options.check or options.tightened != 1.0):
        parser.error("--check and --tightened are for one process: leave --together out")
    pool = multiprocessing.get_context("spawn").Pool(options.processes)
    edge, checked, tightened = 1e-3 * options.edge_mm[0], options.check, options.tightened
    shares = [list(range(k, checked, options.processes)) for k in range(options.processes)]
    running = [
        pool.apply_async(on_cpu, (edge, tightened, checked, share)) for share in shares if share
    ]
    report: dict[str, Any] = {
        "schema": "palpate.batched-benchmark 1",
        "device": wp.get_device(options.device).name,
        "command": "python tests/benchmarks/bench_batched.py " + shlex.join(sys.argv[1:]),
        "runs": [],
        "against_cpu": [],
    }
    for edge_mm in options.edge_mm:
        edge_m, together = 1e-3 * edge_mm, options.together
        tip = fingertip(edge_m, tightened) if together == 1 else None
        for slots in options.slots:
            count = max(3, int(options.rounds * slots), 0 if report["against_cpu"] else checked)
            results: dict[int, IndentationResult] = {}
            if tip is None:
                run = time_together(edge_m, count, slots, options.device, together)
            else:
                presses = presses_on(tip, count)
                run, results = time_slots(tip, presses, slots, options.device, parts=options.parts)
            report["runs"].append(run | {"edge_mm": edge_mm})
            say(report["runs"][-1])
            if running and not report["against_cpu"]:
                cpu = {k: one for some in running for k, one in some.get().items()}
                for k in sorted(cpu):
                    report["against_cpu"].append(differences(summary(results[k]), cpu[k]))
                    say(report["against_cpu"][-1])
            options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
