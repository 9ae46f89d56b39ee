"""The finite-element service on a bus of its own, its workers solving a formula (``fem_fakes``)."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate.fem import node
from palpate.fem.service_config import FemConfig
from palpate.protos.client import Client
from palpate.protos.config import LinkConfig, parse_config
from palpate.protos.errors import PalpateError
from palpate.protos.session import run_router

FOLDER = str(Path(__file__).parent)
sys.path.append(FOLDER)  # tests import the fakes by name, as worker processes do
PATIENCE_S = 20.0
FAKES = {"factory": "fem_fakes:make", "workers": 2, "waiting": 2, "grace_s": 0.3, "threads": 1}


class Served:
    """The service in a thread, and a robot."""

    def __init__(self, link: LinkConfig, values: dict[str, Any]) -> None:
        self.stop = threading.Event()
        self.error: BaseException | None = None
        self.link = link
        self._config = parse_config(FemConfig, {**FAKES, **values}, where="test")
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        self.robot = Client(link.connect[0], timeout_s=5)

    def _run(self) -> None:
        try:
            node.run(self._config, self.link, "lab", self.stop)
        except PalpateError as error:
            self.error = error

    def until(self, true: Callable[[], Any]) -> Any:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if value := true():
                return value
            time.sleep(0.02)
        raise AssertionError("it did not become true in time")

    def ready(self) -> bool:
        return any(a.service == "fem" and a.ready for a in self.robot.alive())

    def counters(self) -> dict[str, int]:
        return dict(self.robot.status()[0].counters)

    def close(self) -> None:
        self.robot.close()
        self.stop.set()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()

    def in_thread(self, *args: Any, **more: Any) -> tuple[threading.Thread, list[Any]]:
        """What ``simulate`` returns or raises."""
        out: list[Any] = []

        def run() -> None:
            try:
                out.append(self.robot.simulate(*args, **more))
            except PalpateError as error:
                out.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        return thread, out


@pytest.fixture
def own_bus(link: LinkConfig, monkeypatch: pytest.MonkeyPatch) -> LinkConfig:
    """A bus for a service that does not outlive its test."""
    monkeypatch.setenv("PYTHONPATH", FOLDER)
    return link


@pytest.fixture(scope="module")
def bus() -> Iterator[LinkConfig]:
    """A router on a free port, and workers that find the fakes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    stop = threading.Event()
    router = threading.Thread(target=run_router, args=((endpoint,), stop))
    router.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", FOLDER)
        yield LinkConfig(connect=(endpoint,), wait_for_router_s=PATIENCE_S)
    stop.set()
    router.join(PATIENCE_S)


@contextmanager
def _serving(bus: LinkConfig, **values: Any) -> Iterator[Served]:
    served = Served(bus, values)
    try:
        served.until(served.ready)
        yield served
    finally:
        served.close()


@pytest.fixture(scope="module")
def service(bus: LinkConfig) -> Iterator[Served]:
    """One service for all tests that leave it as it was."""
    with _serving(bus) as served:
        yield served


@pytest.fixture
def serving(own_bus: LinkConfig) -> Callable[..., AbstractContextManager[Served]]:
    """A ready service for one test, with other values of its configuration."""
    return lambda **values: _serving(own_bus, **values)


@pytest.fixture
def starting(own_bus: LinkConfig) -> Iterator[Callable[..., Served]]:
    """The same, from the moment it starts."""
    started: list[Served] = []

    def start(**values: Any) -> Served:
        started.append(Served(own_bus, values))
        return started[-1]

    yield start
    for served in started:
        served.close()


@pytest.fixture
def workers_find_fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that start worker processes themselves."""
    monkeypatch.setenv("PYTHONPATH", FOLDER)
