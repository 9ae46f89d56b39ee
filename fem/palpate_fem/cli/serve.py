"""``palpate fem serve``."""

from __future__ import annotations

import signal
import threading
from dataclasses import asdict
from types import FrameType

from rich.console import Console

from palpate.config import LinkConfig, parse_config
from palpate_fem.cli.model import Model, workers_for
from palpate_fem.service import node
from palpate_fem.service.config import FemConfig

_ROUTER_WAIT_S = 5.0


def serve_command(
    model: Model,
    *,
    connect: str,
    station: str,
    sensor: str,
    workers: int,
    waiting: int,
    max_deadline_s: float,
) -> None:
    """Serve until ``SIGINT`` or ``SIGTERM``.

    Raises:
        ConfigError: An option is out of range.
        LinkError: There is no router.
        RemoteError: The solver does not start.
    """
    count, threads = workers_for(workers)
    config = parse_config(
        FemConfig,
        {
            "sensor": sensor,
            "workers": count,
            "threads": threads,
            "waiting": waiting,
            "max_deadline_s": max_deadline_s,
            "factory": model.factory,
            "options": dict(model.options),
            "fingertip": asdict(model.parameters),
        },
        where="command line",
    )
    link = parse_config(
        LinkConfig,
        {"connect": (connect,), "wait_for_router_s": _ROUTER_WAIT_S},
        where="--connect",
    )
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    Console(stderr=True).print(
        f"fem serves {sensor!r} at station {station!r} through {connect}: {count} workers, "
        f"{waiting} may wait\nready when `palpate status` says so; Ctrl-C stops it",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    node.run(config, link, station, stop)
