"""Fixtures that every room's tests may use, the quick tier, and the order of a parallel run.

`make quick` runs what `tests/durations.json` does not leave out: in each file the fastest tests
until the file has used `QUICK_S`, and none that needs a fixture of more than `FIXTURE_S`.
`make durations` measures all tests and writes that file anew; a test that it does not know yet
belongs to the quick tier.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from palpate.bus import run_router
from palpate.config import LinkConfig

ROOT = Path(__file__).resolve().parents[1]
DURATIONS = Path(__file__).with_name("durations.json")

QUICK_S = 0.7
"""What a test file may take in the quick tier [s]."""

ALWAYS_QUICK_S = 0.02
"""Tests this short are in the quick tier however many a file has [s]."""

FIRST_S = 2.0
"""The fastest test of a file is in the quick tier if it takes no longer [s]."""

UNKNOWN_S = 20.0
"""What the order of a parallel run expects of a file that was never measured [s]: it may be long,
so it must not begin last."""

FIXTURE_S = 2.0
"""A shared fixture that takes longer leaves its tests out of the quick tier [s]."""

PORTS = range(20_000, 32_000)
"""Below the ports that Linux hands out itself, so that no connection takes one meanwhile."""

# No example has a time limit: first calls import and compile, and machines here are noisy.
settings.register_profile("palpate", deadline=None)
settings.load_profile("palpate")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job ignores Ctrl-C, and so would the programs that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)

if "PYTEST_XDIST_WORKER" in os.environ:
    # readline, which pytest loads, sets it for child processes, and consoles made at import time
    # would print narrow tables in workers only.
    os.environ.pop("COLUMNS", None)
    # These are of the worker itself; the programs that it starts get their memory as a user's do.
    for variable in ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"):
        os.environ.pop(variable, None)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write golden files anew (review the diff)"
    )
    parser.addoption(
        "--quick", action="store_true", help="leave out what tests/durations.json calls slow"
    )
    parser.addoption(
        "--record-durations", action="store_true", help="write tests/durations.json anew"
    )


def pytest_configure(config: pytest.Config) -> None:
    # Reports of a parallel run arrive at the process that started the workers.
    if config.getoption("--record-durations") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Recording())


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare the garbage collector what is imported to collect: it stays until the end.

    There are half a million objects. While they are made, every worker would look through them
    again and again, and with each whole collection later.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


class _Recording:
    """Adds up what each test takes, and writes what the quick tier leaves out."""

    def __init__(self) -> None:
        self._seconds: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self._files: dict[str, float] = defaultdict(float)
        self._fixtures: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        file, _, test = report.nodeid.partition("::")
        self._seconds[file][test] += report.duration
        self._files[file] += report.duration
        if report.when == "setup":
            for name, seconds in report.user_properties:
                if name in self._fixtures or not isinstance(seconds, float):
                    continue
                # Whichever test needs it first pays for it.
                self._seconds[file][test] -= seconds
                if seconds > FIXTURE_S:
                    self._fixtures.add(name)

    def pytest_sessionfinish(self) -> None:
        files = {
            file: {"seconds": round(self._files[file], 1), "slow": slow_tests(tests)}
            for file, tests in sorted(self._seconds.items())
            if self._files[file] > QUICK_S
        }
        table = {"fixtures": sorted(self._fixtures), "files": files}
        DURATIONS.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """Tell the recording what a shared fixture took."""
    began = time.monotonic()
    value = yield
    if fixturedef.scope != "function" and request.config.getoption("--record-durations"):
        name = f"{fixturedef.baseid}::{fixturedef.argname}"
        request._pyfuncitem.user_properties.append((name, time.monotonic() - began))
    return value


def slow_tests(seconds: dict[str, float]) -> list[str]:
    """Tests of one file that the quick tier leaves out: all but the fastest."""
    slow, used = [], 0.0
    for number, (test, took) in enumerate(sorted(seconds.items(), key=lambda item: item[1])):
        fits = used + took <= QUICK_S or took < ALWAYS_QUICK_S
        if fits or (number == 0 and took < FIRST_S):
            used += took
        else:
            slow.append(test)
    return sorted(slow)


def _file(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _fixtures(item: pytest.Item) -> set[str]:
    """Fixtures that a test needs, by where they are defined and by name."""
    defined = item._fixtureinfo.name2fixturedefs if isinstance(item, pytest.Function) else {}
    return {f"{found[-1].baseid}::{name}" for name, found in defined.items() if found}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select the quick tier; begin a parallel run with the files that take longest."""
    recorded: dict[str, Any] = json.loads(DURATIONS.read_text(encoding="utf-8"))
    files: dict[str, dict[str, Any]] = recorded["files"]
    if config.getoption("--quick"):
        slow = {f"{file}::{test}" for file, entry in files.items() for test in entry["slow"]}
        dear = set(recorded["fixtures"])
        left_out = [
            item
            for item in items
            if item.nodeid in slow or item.get_closest_marker("slow") or _fixtures(item) & dear
        ]
        config.hook.pytest_deselected(items=left_out)
        gone = set(left_out)
        items[:] = [item for item in items if item not in gone]
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: -files.get(_file(item), {}).get("seconds", UNKNOWN_S))


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


class _Ports:
    """Loopback ports; each worker of a parallel run has its own share, and uses none twice."""

    def __init__(self) -> None:
        worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
        workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        share = PORTS[worker::workers]
        # Two runs on one machine begin at different places.
        start = os.getpid() * 37 % len(share)
        self._left: Iterator[int] = iter([*share[start:], *share[:start]])

    def __call__(self) -> int:
        for port in self._left:
            with socket.socket() as probe:
                try:
                    probe.bind(("127.0.0.1", port))
                except OSError:
                    continue
                return port
        raise AssertionError(f"no free port in {PORTS}")


@pytest.fixture(scope="session")
def new_port() -> Callable[[], int]:
    """Gives loopback ports that nobody listens on, each once."""
    return _Ports()


@pytest.fixture
def free_port(new_port: Callable[[], int]) -> int:
    """A loopback port that nobody listens on."""
    return new_port()


@pytest.fixture(scope="session")
def router(new_port: Callable[[], int]) -> Callable[[], AbstractContextManager[LinkConfig]]:
    """Starts routers on free loopback ports; each gives the link of a process that joins it."""

    @contextmanager
    def run() -> Iterator[LinkConfig]:
        port = new_port()
        endpoint = f"tcp/127.0.0.1:{port}"
        stop = threading.Event()
        thread = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
        thread.start()
        deadline = time.monotonic() + 60
        while True:  # so that no session has to wait for its second attempt to connect
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert time.monotonic() < deadline, "the router did not start"
                time.sleep(0.01)
        try:
            yield LinkConfig(connect=(endpoint,), wait_for_router_s=60)
        finally:
            stop.set()
            thread.join(timeout=20)

    return run


@pytest.fixture
def link(router: Callable[[], AbstractContextManager[LinkConfig]]) -> Iterator[LinkConfig]:
    """A bus of one's own: how to join a router that runs on a free loopback port."""
    with router() as link:
        yield link
