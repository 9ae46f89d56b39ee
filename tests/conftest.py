"""Fixtures that every room's tests may use, tiers of tests, and the order of a parallel run.

`make quick` and `make test` run a tier each, `make nightly` runs everything. A tier has of each
file the fastest tests until the file has used its time (`TIERS`); `make test` also has what is
marked ``essential``. `make durations` runs all tests, measures them, and writes to
`tests/durations.json` what each tier leaves out. A test that it does not know yet is in both tiers.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from palpate.bus import run_router
from palpate.config import LinkConfig

ROOT = Path(__file__).resolve().parents[1]
DURATIONS = Path(__file__).with_name("durations.json")


@dataclass(frozen=True, slots=True)
class Tier:
    """What a tier has of each test file.

    Attributes:
        file_s: Time that a file may take: its fastest tests are taken until then [s].
        always_s: Tests this short are taken however many a file has [s].
        first_s: The fastest test of a file is taken if it takes no longer [s].
        fixture_s: Tests that need a shared fixture of more than this are left out [s].
        without: Marker of tests that are left out however short they are.
        keeps: Marker of tests that are taken however long they are.
    """

    file_s: float
    always_s: float
    first_s: float
    fixture_s: float
    without: str | None = None
    keeps: str | None = None

    def left_out(self, seconds: dict[str, float]) -> set[str]:
        """Tests of one file that are not in the tier, by what each takes [s]."""
        names, used = set(), 0.0
        for number, (test, took) in enumerate(sorted(seconds.items(), key=lambda item: item[1])):
            fits = used + took <= self.file_s or took < self.always_s
            if fits or (number == 0 and took < self.first_s):
                used += took
            else:
                names.add(test)
        return names


TIERS = {
    "quick": Tier(file_s=0.7, always_s=0.02, first_s=2.0, fixture_s=2.0, without="slow"),
    "test": Tier(file_s=8.0, always_s=0.1, first_s=20.0, fixture_s=20.0, keeps="essential"),
}

SELECTING = ("keyword", "markexpr", "lf", "deselect", "tier")
"""Options that leave out some tests of a file."""

UNKNOWN_S = 20.0
"""What the order of a parallel run expects of a file that was never measured [s]: it may be long,
so it must not begin last."""

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
        "--tier", choices=list(TIERS), help="leave out what tests/durations.json says of this tier"
    )
    parser.addoption(
        "--record-durations", action="store_true", help="write tests/durations.json anew"
    )


def pytest_configure(config: pytest.Config) -> None:
    # Reports of a parallel run arrive at the process that started the workers.
    if config.getoption("--record-durations") and not hasattr(config, "workerinput"):
        some = any(config.getoption(name, None) for name in SELECTING)
        if some or any("::" in one for one in config.args):
            raise pytest.UsageError("--record-durations measures whole files: name no single tests")
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
    """Adds up what each test and each shared fixture takes, and writes what tiers leave out.

    What is known of files that do not run now is kept; all of it if the run was interrupted.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self._files: dict[str, float] = defaultdict(float)
        self._fixtures: dict[str, float] = {}

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
                self._fixtures[name] = round(seconds, 1)

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        if exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            return
        shortest = min(tier.fixture_s for tier in TIERS.values())
        files = {
            file: {"seconds": round(self._files[file], 1)}
            | {name: sorted(tier.left_out(tests)) for name, tier in TIERS.items()}
            for file, tests in self._seconds.items()
            if self._files[file] > TIERS["quick"].file_s
        }
        fixtures = {name: s for name, s in self._fixtures.items() if s > shortest}
        recorded: dict[str, dict[str, Any]] = json.loads(DURATIONS.read_text(encoding="utf-8"))
        for new, known in ((files, recorded["files"]), (fixtures, recorded["fixtures"])):
            for name, entry in known.items():
                file = name.partition("::")[0]
                anew = file in self._seconds or name in self._fixtures
                if not anew and (ROOT / file).exists():
                    new.setdefault(name, entry)
        table = {"fixtures": dict(sorted(fixtures.items())), "files": dict(sorted(files.items()))}
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


def _file(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _has(item: pytest.Item, marker: str | None) -> bool:
    return marker is not None and item.get_closest_marker(marker) is not None


def _fixtures(item: pytest.Item) -> set[str]:
    """Fixtures that a test needs, by where they are defined and by name."""
    defined = item._fixtureinfo.name2fixturedefs if isinstance(item, pytest.Function) else {}
    return {f"{found[-1].baseid}::{name}" for name, found in defined.items() if found}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select a tier; begin a parallel run with the files that take longest."""
    recorded: dict[str, Any] = json.loads(DURATIONS.read_text(encoding="utf-8"))
    files: dict[str, dict[str, Any]] = recorded["files"]
    if name := config.getoption("--tier"):
        tier = TIERS[name]
        long = {f"{file}::{test}" for file, entry in files.items() for test in entry[name]}
        dear = {one for one, took in recorded["fixtures"].items() if took > tier.fixture_s}

        def is_taken(item: pytest.Item) -> bool:
            if _has(item, tier.keeps):
                return True
            return not (_has(item, tier.without) or item.nodeid in long or _fixtures(item) & dear)

        taken = [item for item in items if is_taken(item)]
        config.hook.pytest_deselected(items=list(set(items) - set(taken)))
        items[:] = taken
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
