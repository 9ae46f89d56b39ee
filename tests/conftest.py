"""Fixtures that every room's tests may use."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from palpate.bus import run_router
from palpate.config import LinkConfig

ROOT = Path(__file__).resolve().parents[1]

# No example has a time limit: first calls import and compile, and machines here are noisy.
settings.register_profile("palpate", deadline=None)
settings.load_profile("palpate")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write golden files anew (review the diff)"
    )


@pytest.fixture(scope="session")
def root() -> Path:
    """Root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real BioTac data beside the project; tests skip where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real BioTac data not present beside the project (../shared/data)")
    return folder


@pytest.fixture
def free_port() -> int:
    """A loopback port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def link(free_port: int) -> Iterator[LinkConfig]:
    """A bus of one's own: how to join a router that runs on a free loopback port."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    stop = threading.Event()
    router = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
    router.start()
    deadline = time.monotonic() + 10
    while True:  # so that no session has to wait for its second attempt to connect
        try:
            socket.create_connection(("127.0.0.1", free_port), timeout=1).close()
            break
        except OSError:
            assert time.monotonic() < deadline, "the router did not start"
            time.sleep(0.01)
    yield LinkConfig(connect=(endpoint,), wait_for_router_s=5)
    stop.set()
    router.join(timeout=5)
