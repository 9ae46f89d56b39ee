"""Draw the way of a frame and of a simulation through the files, recorded from running stations.

``python docs/make_walks.py`` starts a gateway with an emulated BioTac on CAN, the features service
and a robot; then the finite-element service and a robot that asks for an indentation. In every
process it records which file calls which. It writes docs/walks.json and the pictures
docs/pictures/walk-frame.svg and walk-simulation.svg.

``python docs/make_walks.py --check`` records again and exits 1 if a walk enters other files.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate import Client
from palpate.client.simulations import straight_path
from palpate.errors import PalpateError
from palpate.messages import SimulationRequest

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "docs" / "walks.json"
PICTURES = ROOT / "docs" / "pictures"
PATIENCE_S = 90.0
RECORDED_S = 4.0
SELDOM = 0.05
"""Calls on a smaller share of the frames belong to reports and clock keeping, not to the walk."""
USUAL = 0.5
"""A file that is new in a walk counts as a change if it is called on this share of the frames."""


@dataclass(frozen=True, slots=True)
class Lane:
    """A thread of a process that the walk goes through.

    Attributes:
        title: As drawn.
        process: A word of its command line.
        thread: Pattern of the thread's name.
        entry: A file that its paths must enter; tells threads with the same name apart.
    """

    title: str
    process: str
    thread: str
    entry: str = ""


FRAME = (
    Lane("gateway: thread of the CAN bus", "run gateway", r"line .*"),
    Lane("gateway: thread of the sensor", "run gateway", r"sensor .*"),
    Lane("features: its loop", "run features", r"MainThread", "inference/loop"),
    Lane("robot: the caller", "robot", r"MainThread", "client/"),
)
SIMULATION = (
    Lane("robot: the caller", "robot", r"MainThread", "client/"),
    Lane("service: Zenoh's thread", "run fem", r".*pyo3.*", "bus/"),
    Lane(
        "service: its threads", "run fem", r"(?!MainThread|.*pyo3|health|departures).*", "service/"
    ),
    Lane("worker: its process", "palpate_fem.service", r"MainThread"),
)

Tree = dict[str, Any]
"""File -> the tree of what it calls, in the order of first call."""


def _command(*words: str) -> list[str]:
    return [sys.executable, "-m", "palpate_deploy", *words]


@contextmanager
def _processes(folder: Path) -> Iterator[Callable[[list[str]], None]]:
    """Starts commands that record themselves, and ends them."""
    (folder / "sitecustomize.py").write_text("import walk_recorder\n", encoding="utf-8")
    paths = [str(folder), str(ROOT / "docs"), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "WALK_FOLDER": str(folder),
    }
    running: list[subprocess.Popen[bytes]] = []

    def start(command: list[str]) -> None:
        log = (folder / f"{len(running)}.log").open("wb")
        running.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))

    try:
        yield start
    finally:
        for process in reversed(running):
            process.send_signal(signal.SIGTERM)
        for process in running:
            process.wait(20)


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _until_it_works(call: Callable[[], object]) -> None:
    """Call again until no palpate error comes, for at most ``PATIENCE_S``."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            call()
            return
        except PalpateError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


def _recorded(folder: Path, processes: int, walk: Callable[[], None]) -> list[dict[str, Any]]:
    """What all processes recorded during ``walk``."""
    flag = folder / "record"
    flag.touch()
    time.sleep(0.2)  # every process has seen the flag
    walk()
    flag.unlink()
    deadline = time.monotonic() + PATIENCE_S
    while len(found := list(folder.glob("*.json"))) < processes:
        if time.monotonic() > deadline:
            raise SystemExit(f"only {len(found)} of {processes} processes recorded")
        time.sleep(0.05)
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(found)]


def _robot(endpoint: str, what: str) -> list[str]:
    """The robot is this program again, as a process of its own."""
    return [sys.executable, str(Path(__file__)), "robot", what, endpoint]


def be_robot(what: str, endpoint: str) -> None:
    """Ask as a robot does, while the other processes record."""
    folder = Path(os.environ["WALK_FOLDER"])
    with Client(endpoint) as robot:
        if what == "frame":
            _until_it_works(lambda: robot.tare("finger"))
            _until_it_works(lambda: robot.features("finger", max_age_s=1.0))
            time.sleep(1.0)
            (folder / "ready").touch()
            while True:
                robot.features("finger", max_age_s=5.0)
                time.sleep(0.02)
        path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.008), 6)
        request = SimulationRequest("walk", "sphere_7mm", path)
        _until_it_works(lambda: robot.simulate(request, timeout_s=PATIENCE_S))
        (folder / "ready").touch()
        while not (folder / "record").exists():
            time.sleep(0.01)
        time.sleep(0.1)
        robot.simulate(request, timeout_s=PATIENCE_S)
        (folder / "done").touch()
        time.sleep(PATIENCE_S)


def _wait_for_port(endpoint: str) -> None:
    """Wait until the router listens."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2])), 1.0).close()
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not path.exists():
        if time.monotonic() > deadline:
            logs = "\n".join(log.read_text() for log in sorted(path.parent.glob("*.log")))
            raise SystemExit(f"the station did not get ready:\n{logs}")
        time.sleep(0.05)


def record_frames() -> tuple[list[dict[str, Any]], float]:
    """Walks of some hundred frames: what each process recorded, and how many frames."""
    port, bus_port = _free_port(socket.SOCK_STREAM), _free_port(socket.SOCK_DGRAM)
    endpoint, channel, rate_hz = f"tcp/127.0.0.1:{port}", "239.74.163.9", 2200.0
    with tempfile.TemporaryDirectory() as name, _processes(folder := Path(name)) as start:
        profile = folder / "walk.toml"
        profile.write_text(
            f"""
[link]
connect = ["{endpoint}"]
[router]
listen = ["{endpoint}"]
[features]
bundle = "features-twin"
[[gateway.sensors]]
name = "finger"
driver = "biotac_can"
[gateway.sensors.options]
interface = "udp_multicast"
channel = "{channel}"
bus_options = {{ port = {bus_port} }}
can_id = 1
fingers = 1
slot_rate_hz = {rate_hz}
""",
            encoding="utf-8",
        )
        can = ["--channel", channel, "--bus", f"port={bus_port}", "--fingers", "1"]
        can += ["--slot-rate-hz", str(rate_hz), "--play", "idle"]
        start(_command("emulate", "biotac-can", *can))
        for service in ("router", "features", "gateway"):
            start(_command("run", service, "--profile", str(profile)))
        _wait_for_port(endpoint)
        start(_robot(endpoint, "frame"))
        _wait_for(folder / "ready")
        return _recorded(folder, 5, lambda: time.sleep(RECORDED_S)), RECORDED_S * rate_hz / 44


def record_simulation() -> tuple[list[dict[str, Any]], float]:
    """The walk of one request; the fingertip was pressurised by a request before."""
    endpoint = f"tcp/127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    with tempfile.TemporaryDirectory() as name, _processes(folder := Path(name)) as start:
        profile = folder / "walk.toml"
        profile.write_text(
            f'[link]\nconnect = ["{endpoint}"]\n[router]\nlisten = ["{endpoint}"]\n'
            "[fem]\nworkers = 1\noptions = { edge_m = 1.5e-3 }\n",
            encoding="utf-8",
        )
        for service in ("router", "fem"):
            start(_command("run", service, "--profile", str(profile)))
        _wait_for_port(endpoint)
        start(_robot(endpoint, "simulation"))
        _wait_for(folder / "ready")
        return _recorded(folder, 4, lambda: _wait_for(folder / "done")), 1.0


def _tree(paths: Iterable[tuple[list[str], int]], least: float) -> Tree:
    tree: Tree = {}
    for path, count in paths:
        if count < least:
            continue
        branch = tree
        for file in path:
            branch = branch.setdefault(file, {})
    return tree


def walk_of(
    lanes: Iterable[Lane], recorded: list[dict[str, Any]], times: float, share: float = SELDOM
) -> list[tuple[str, Tree]]:
    """Lane -> tree of the files that are called on at least ``share`` of all ``times``."""
    walk = []
    for lane in lanes:
        paths = [
            (path, count)
            for entry in recorded
            if lane.process in " ".join(entry["command"])
            for thread, found in entry["threads"].items()
            if re.fullmatch(lane.thread, thread)
            for path, count in found
            if lane.entry in " ".join(path)
        ]
        if not (tree := _tree(paths, max(1.0, share * times))):
            threads = [(entry["command"], list(entry["threads"])) for entry in recorded]
            raise SystemExit(f"no calls in lane {lane.title!r}; recorded: {threads}")
        walk.append((lane.title, tree))
    return walk


def files_of(tree: Tree) -> Iterator[tuple[str, str]]:
    """(file, the file that calls it) for every place in a tree; "" calls the outermost."""
    todo = [("", tree)]
    while todo:
        caller, branch = todo.pop()
        for file, inner in branch.items():
            yield file, caller
            todo.append((file, inner))


def entries(walk: list[tuple[str, Tree]]) -> dict[str, set[str]]:
    """File -> the files that call it in this walk."""
    found: dict[str, set[str]] = {}
    for _, tree in walk:
        for file, caller in files_of(tree):
            found.setdefault(file, set()).add(caller)
    return found


COLOURS = {
    "gateway": "#d8e8d0", "services": "#d5e3f0", "fem": "#efd9d9", "protos": "#e6e6e6",
    "deploy": "#f3e3c3", "training": "#e4dcf0",
}  # fmt: skip
ROW, INDENT, LETTER, WIDTH = 22, 26, 7.3, 900


def draw(walk: list[tuple[str, Tree]]) -> str:
    """A walk as SVG: a file below and to the right of the file that calls it.

    A file is a box where it is entered first, and grey text wherever it is called again.
    """
    rows: list[str] = []
    seen: set[str] = set()
    y = 12

    def place(branch: Tree, depth: int) -> None:
        nonlocal y
        for file, inner in branch.items():
            x = 20 + depth * INDENT
            label = re.sub(r"^\w+/palpate", "palpate", file)
            if file in seen:
                rows.append(f'<text x="{x + 6}" y="{y + 15}" fill="#999">{label}</text>')
            else:
                seen.add(file)
                width = LETTER * len(label) + 12
                rows.append(
                    f'<rect x="{x}" y="{y}" width="{width:.0f}" height="{ROW - 3}" rx="3"'
                    f' fill="{COLOURS[file.split("/")[0]]}" stroke="#888"/>'
                    f'<text x="{x + 6}" y="{y + 14}">{label}</text>'
                )
            y += ROW
            place(inner, depth + 1)

    for title, tree in walk:
        rows.append(f'<text x="12" y="{y + 14}" font-weight="bold">{title}</text>')
        y += ROW
        place(tree, 0)
        y += 8
    size = f'width="{WIDTH}" height="{y + 8}"'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y + 8}"'
        f' font-family="monospace" font-size="12"><rect {size} fill="white"/>'
    )
    return "\n".join([head, *rows, "</svg>", ""])


def main() -> None:
    """Record, then write or check."""
    if sys.argv[1:2] == ["robot"]:
        be_robot(*sys.argv[2:])
        return
    recorded = {
        "frame": (FRAME, *record_frames()),
        "simulation": (SIMULATION, *record_simulation()),
    }
    if sys.argv[1:] == ["--check"]:
        kept = json.loads(KEPT.read_text(encoding="utf-8"))
        for name, recording in recorded.items():
            old = set(entries(kept[name]))
            gone = old - set(entries(walk_of(*recording, share=0.0)))
            new = set(entries(walk_of(*recording, share=USUAL))) - old
            if gone or new:
                raise SystemExit(
                    f"the walk of a {name} has changed: new {sorted(new)}, gone {sorted(gone)};"
                    " run: python docs/make_walks.py"
                )
        return
    walks = {name: walk_of(*recording) for name, recording in recorded.items()}
    KEPT.write_text(json.dumps(walks, indent=1) + "\n", encoding="utf-8")
    for name, walk in walks.items():
        (PICTURES / f"walk-{name}.svg").write_text(draw(walk), encoding="utf-8")
        found = entries(walk)
        again = sorted(file for file, callers in found.items() if len(callers) > 1)
        sys.stdout.write(f"{name}: {len(found)} files, {len(again)} called by more than one:\n")
        sys.stdout.writelines(f"  {file} by {sorted(found[file])}\n" for file in again)


if __name__ == "__main__":
    main()
