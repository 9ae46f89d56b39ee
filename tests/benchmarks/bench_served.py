"""The finite-element service with a GPU: many callers at once, beside the same presses without it.

    python tests/benchmarks/bench_served.py --callers 1 8 32 64 --out served.json

The service runs as a process of its own (``palpate fem serve --device``), behind a router on the
loopback interface; each caller is a thread that asks for one press after the other, as
``bench_batched`` makes them. ``bare`` is what the device takes for the same presses in this
process, with nothing between. With ``--kill`` the device's process is killed (SIGKILL) among
requests at the end: every caller has to get its answer, from the CPU's workers or the next process.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bus import run_router
from palpate.client import Client
from palpate.errors import PalpateError
from palpate.messages import SimulationRequest
from palpate_fem.batched.fingertip import BatchedPress
from palpate_fem.indenter.catalogue import indenter_names
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.service.requests import as_pose

beside: Any = importlib.import_module("bench_batched")  # in this folder
presses_on, say, time_slots = beside.presses_on, beside.say, beside.time_slots

PATIENCE_S = 900.0
ANSWER_S = 300.0
CALLERS_OF_SESSION = 8
"""Callers that share a session on the bus, as the threads of one robot do."""


@contextmanager
def router() -> Iterator[str]:
    """A router on a free port of the loopback interface; its endpoint."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
    thread.start()
    yield endpoint
    stop.set()
    thread.join(20)


@contextmanager
def service(endpoint: str, device: str, edge_mm: float, slots: int) -> Iterator[int]:
    """The service, from when its device is ready until it is stopped; its process id."""
    command = [sys.executable, "-m", "palpate_deploy", "fem", "serve", "--connect", endpoint]
    command += ["--device", device, "--slots", str(slots), "--waiting", "1000", "--workers", "2"]
    command += ["--edge-mm", str(edge_mm)]
    process = subprocess.Popen(command)
    try:
        with Client(endpoint, timeout_s=20.0) as client:
            await_device(client, f"{slots} at once", process)
        yield process.pid
    finally:
        process.terminate()
        process.wait(60)


def await_device(client: Client, words: str, process: subprocess.Popen[bytes]) -> None:
    """Until the service says that its device serves."""
    give_up_s = time.monotonic() + PATIENCE_S
    said = ""
    while words not in said:
        if process.poll() is not None or time.monotonic() > give_up_s:
            raise SystemExit(f"the service does not start: {said}")
        said = " ".join(one.message for one in client.status())
        time.sleep(0.5)
    say(said)


def ask(
    endpoint: str, presses: list[BatchedPress], callers: int, *, kill: int = 0
) -> dict[str, Any]:
    """All presses by so many callers; ``kill``: the process to kill after a third of them."""
    waiting = iter(enumerate(presses))
    lock, begun = threading.Lock(), time.perf_counter()
    answers: list[dict[str, Any]] = []
    clients = [Client(endpoint, timeout_s=20.0) for _ in range(-(-callers // CALLERS_OF_SESSION))]

    def call(client: Client) -> None:
        while True:
            with lock:
                number, press = next(waiting, (-1, None))
            if press is None:
                return
            started, first = time.perf_counter(), [float("nan")]
            request = SimulationRequest(
                f"{callers}-{kill}-{number}",
                indenter_names()[press.indenter],
                [as_pose(pose) for pose in press.path],
            )

            def on_step(*_: object, started: float = started, first: list[float] = first) -> None:
                if np.isnan(first[0]):
                    first[0] = time.perf_counter() - started

            try:
                reply = client.simulate(request, timeout_s=ANSWER_S, on_step=on_step)
                end, steps = reply.outcome.name.lower().replace("_", " "), len(reply.steps)
            except PalpateError as error:
                end, steps = type(error).__name__, 0
            with lock:
                answers.append(
                    {
                        "end": end,
                        "steps": steps,
                        "first_s": first[0],
                        "whole_s": time.perf_counter() - started,
                    }
                )

    threads = [
        threading.Thread(target=call, args=(clients[k // CALLERS_OF_SESSION],))
        for k in range(callers)
    ]
    for thread in threads:
        thread.start()
    if kill:
        while len(answers) < len(presses) // 3:
            time.sleep(0.02)
        os.kill(kill, signal.SIGKILL)
        say(f"killed {kill}")
    for thread in threads:
        thread.join()
    seconds = time.perf_counter() - begun
    for client in clients:
        client.close()
    return {
        "callers": callers,
        "presses": len(presses),
        "answers": len(answers),
        "killed": bool(kill),
        "seconds": seconds,
        "ms_a_trajectory": 1e3 * seconds / len(presses),
        "outcomes": Counter(one["end"] for one in answers),
        "steps": sum(one["steps"] for one in answers),
        "first_step_s": float(np.nanmedian([one["first_s"] for one in answers])),
        "whole_s": float(np.median([one["whole_s"] for one in answers])),
        "longest_s": max(one["whole_s"] for one in answers),
    }


def device_process(parent: int) -> int:
    """The process of the service's device."""
    for path in Path(f"/proc/{parent}/task").glob("*/children"):
        for pid in map(int, path.read_text().split()):
            if b"palpate_fem.service.device_worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return pid
    raise SystemExit("the service has no process for its device")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--callers", type=int, nargs="+", default=[1, 8, 32, 64])
    parser.add_argument("--rounds", type=float, default=3.0, help="presses for each caller")
    parser.add_argument("--slots", type=int, default=64)
    parser.add_argument("--edge-mm", type=float, default=0.47)
    parser.add_argument("--kill", action="store_true", help="at the end kill the device's process")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    report: dict[str, Any] = {
        "schema": "palpate.served-benchmark 1",
        "command": "python tests/benchmarks/bench_served.py " + shlex.join(sys.argv[1:]),
        "edge_mm": options.edge_mm,
        "slots": options.slots,
        "served": [],
        "bare": [],
    }

    def keep(part: str, run: dict[str, Any]) -> None:
        report[part].append(run)
        say(run)
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

    tip = Fingertip.pressurised(biotac(edge_m=1e-3 * options.edge_mm))
    presses = presses_on(tip, max(4, int(options.rounds * max(options.callers))))
    counts = {many: max(4, int(options.rounds * many)) for many in options.callers}
    with router() as endpoint:
        with service(endpoint, options.device, options.edge_mm, options.slots) as parent:
            for many, count in counts.items():
                keep("served", ask(endpoint, presses[:count], many))
            if options.kill:
                victim = device_process(parent)
                keep("served", ask(endpoint, presses[: counts[many]], many, kill=victim))
    for many, count in counts.items():
        run, _ = time_slots(
            tip, presses[:count], min(many, options.slots), options.device, parts=False
        )
        keep("bare", {key: run[key] for key in ("slots", "presses", "seconds", "ms_a_trajectory")})


if __name__ == "__main__":
    main()
