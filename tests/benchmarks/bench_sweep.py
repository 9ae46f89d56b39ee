"""A sweep on GPUs, from the command to files on the disk, beside the device alone.

    python tests/benchmarks/bench_sweep.py --points 32 --device cuda:0 --out sweeps.json
    ... --device cuda:0 --device cuda:1   on two GPUs
    ... --ray HOST:PORT --device cuda     over a cluster that was started on this machine
    ... --kill 300                        after 300 results a device's process is killed (SIGKILL)
    ... --bare                            the same presses on a device in this process, no files

The sweep is the command ``palpate fem run --sweep`` with the twin's presses, 45 at each of
``--points``. When each result came tells its file. What no device solves goes to cores, in the end
alone, so the time is told to 99 % of the results, too. Each run is added to the file.
``docs/make_fem_batched.py`` makes a table of them.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from palpate_fem.batched.fingertip import BatchedFingertip, BatchedPress
from palpate_fem.indenter.approach import OuterSurface
from palpate_fem.indenter.catalogue import indenter_names, make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.service.device_batch import SLOTS
from palpate_fem.trajectory import Campaign, points_first

served: Any = importlib.import_module("bench_served")  # in this folder

LOOK_S = 0.2
ACTOR = b"ray::DeviceHost"
MOST = 0.99
"""Share of the results to which the time is told."""


def actor() -> int:
    """Process of a device's actor in a cluster on this machine."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().startswith(ACTOR):
                return int(path.parent.name)
        except OSError:  # it has ended
            continue
    raise SystemExit(f"no process of this machine is called {ACTOR.decode()}")


def sweep(words: list[str], store: Path, *, kill: int, ray: bool) -> dict[str, Any]:
    """Run the command.

    Args:
        words: Its options.
        store: Where results go.
        kill: Results after which a device's process is killed; 0 = none is.
        ray: Whether devices are those of a cluster.

    Returns:
        What the page shows.
    """
    began, killed_s = time.time(), None
    command = [sys.executable, "-m", "palpate_deploy", "fem", "run", "--sweep", *words]
    with store.with_suffix(".json").open("w+") as said:
        process = subprocess.Popen([*command, "--store", str(store), "--json"], stdout=said)
        while process.poll() is None:
            time.sleep(LOOK_S)
            if kill and killed_s is None and len(files_of(store)) >= kill:
                os.kill(actor() if ray else served.device_process(process.pid), signal.SIGKILL)
                killed_s = time.time() - began
        whole_s = time.time() - began
        said.seek(0)
        text = said.read()
    if not text:
        raise SystemExit(f"{shlex.join(command)} failed, see above")
    report = json.loads(text)
    came = sorted(path.stat().st_mtime - began for path in files_of(store))
    return {
        "results": len(came),
        "outcomes": report["outcomes"],
        "on_cpu": report["on_cpu"],
        **rate(came),
        "whole_s": whole_s,
        "killed_s": killed_s,
    }


def files_of(store: Path) -> list[Path]:
    """Files of the results that are on the disk."""
    return list((store / "trajectories").glob("*/*/*.h5"))


def bare(points: int, device: str, slots: int, edge_mm: float) -> dict[str, Any]:
    """The same presses in this process, without those that the device does not solve."""
    tip = Fingertip.pressurised(biotac(edge_m=1e-3 * edge_mm))
    surface = OuterSurface(tip.nodes, tip.geometry.mesh.outer_faces)
    names = indenter_names()
    presses = [
        BatchedPress(names.index(plan.indenter), plan.path)
        for plan in points_first(Campaign(surface, points=points))
    ]
    batched = BatchedFingertip(tip, [*map(make_indenter, names)], slots=slots, device=device)
    for _ in batched.solve(presses[:1]):
        pass  # kernels are compiled
    began = time.perf_counter()
    return rate([time.perf_counter() - began for _ in batched.solve(presses)])


def rate(came: Sequence[float]) -> dict[str, float]:
    """How fast results came, which came at these times [s], in order."""
    most = round(MOST * len(came))
    return {
        "first_s": came[0],
        "most_s": came[most - 1],
        "last_s": came[-1],
        "ms_a_trajectory": 1e3 * (came[most - 1] - came[0]) / (most - 1),
    }


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=32)
    parser.add_argument("--device", action="append", required=True)
    parser.add_argument("--ray", help="address of a cluster")
    parser.add_argument("--workers", type=int, help="processes that make files")
    parser.add_argument("--slots", type=int, default=SLOTS)
    parser.add_argument("--edge-mm", type=float, default=0.47)
    parser.add_argument("--limit-s", type=float, default=30.0, help="for a press on a core")
    parser.add_argument("--kill", type=int, default=0, metavar="RESULTS")
    parser.add_argument("--bare", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    words = ["--points", str(options.points), "--slots", str(options.slots)]
    words += ["--limit-s", f"{options.limit_s:g}", "--edge-mm", f"{options.edge_mm:g}"]
    for device in options.device:
        words += ["--device", device]
    if options.ray is not None:
        words += ["--ray", options.ray]
    if options.workers is not None:
        words += ["--workers", str(options.workers)]
    with tempfile.TemporaryDirectory() as folder:
        run = sweep(
            words, Path(folder, "bench.sim"), kill=options.kill, ray=options.ray is not None
        )
    run = {"command": f"palpate fem run --sweep {shlex.join(words)}"} | run
    run |= {"cores": os.cpu_count()}
    report: dict[str, Any] = {"schema": "palpate.sweep-benchmark 1", "runs": []}
    if options.out.exists():
        report = json.loads(options.out.read_text(encoding="utf-8"))
    report["runs"].append(run)

    def keep() -> None:
        served.say(run)
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

    keep()
    if options.bare:
        run["bare"] = bare(options.points, options.device[0], options.slots, options.edge_mm)
        keep()


if __name__ == "__main__":
    main()
