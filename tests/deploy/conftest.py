"""Stations for tests: on free ports, with their state and records in temporary folders."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from palpate.config import LinkConfig
from palpate_deploy.demo.bundles import write_virtual_record
from palpate_deploy.station.host import free_endpoint
from palpate_services.inference.repository import available

ROOT = Path(__file__).resolve().parents[2]
BUNDLE = "features-virtual"

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No run folder of a test lands in the user's state, no setting of the user in a test."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("COLUMNS", "160")
    for name in [name for name in os.environ if name.upper().startswith("PALPATE_")]:
        monkeypatch.delenv(name)


@pytest.fixture(scope="session")
def bundle() -> str:
    """The bundle that ships."""
    if not any(name.startswith(f"{BUNDLE}:") for name in available()):
        pytest.skip(f"bundle {BUNDLE} is not there; make it with: make bundle")
    return BUNDLE


@pytest.fixture
def palpate() -> Palpate:
    """Run the command to its end, as a user does; ``first``: a program that it runs before."""

    def run(
        *arguments: str | Path, timeout: float = 60, first: str = ""
    ) -> subprocess.CompletedProcess[str]:
        program = ["-c", f"{first}\nfrom palpate_deploy.cli import main\nmain()"]
        return subprocess.run(
            [
                sys.executable,
                *(program if first else ["-m", "palpate_deploy"]),
                *map(str, arguments),
            ],
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run


@pytest.fixture
def station(tmp_path: Path) -> tuple[Path, LinkConfig]:
    """A profile of the virtual finger on a free port, and the link of a client to it."""
    endpoint = free_endpoint()
    profile = tmp_path / "station.toml"
    profile.write_text(
        f"""
        station = "test"
        [router]
        listen = ["{endpoint}"]
        [[gateway.sensors]]
        name = "finger"
        options = {{ model = "formula", seed = 3, untouched_s = 0.5 }}
        [recorder]
        out = "{tmp_path / "runs"}"
        """,
        encoding="utf-8",
    )
    return profile, LinkConfig(connect=(endpoint,), wait_for_router_s=60)


@pytest.fixture
def up(station: tuple[Path, LinkConfig], bundle: str) -> Iterator[subprocess.Popen[bytes]]:
    """``palpate up`` with that profile; stopped, or if need be killed, afterwards."""
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "up", "--profile", str(station[0])],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    yield process
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture(scope="session")
def virtual_record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of 300 frames of the virtual finger."""
    path = tmp_path_factory.mktemp("record") / "virtual.mcap"
    write_virtual_record(path, frames=300, seed=5)
    return path


@pytest.fixture(scope="session")
def text_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small log in the vendor's format, written here: 120 frames, 2 missing, first ones at rest.

    Rows: time, batch, frame, channel, value, parity flag (0 = good).
    """
    path = tmp_path_factory.mktemp("log") / "small.btd"
    path.write_text(_log_text(frames=120, missing=(80, 81)), encoding="ascii")
    return path


def _log_text(*, frames: int, missing: tuple[int, ...]) -> str:
    names = [name for number in range(1, 20) for name in ("Pac", f"E{number}")]
    structure = ",".join([*names, "Pac", "Pdc", "Pac", "Tac", "Pac", "Tdc"])
    channels = [code for number in range(19) for code in (0, 17 + number)]
    channels += [0, 1, 0, 2, 0, 3]  # PDC, TAC, TDC between readings of PAC
    lines = [
        "DataStructure: 2.0",
        "Operator: test",
        "Date: 2020/1/2",
        "Time: 03:04",
        "Flex Version: 1.0",
        "Firmware Version: 6.2",
        "Serial Number: TEST0001",
        f"SampStructure: {structure}",
        "SampRate: 4400",
        "FramesInBatch: 1",
        "OtherData: ",
        "",
        "Begin File",
    ]
    for frame in range(frames):
        if frame in missing:
            continue
        for slot, channel in enumerate(channels):
            time_s = (frame * len(channels) + slot) / 4400
            value = 2040 if channel == 0 else 3000 + (frame * 7 + slot) % 3
            lines.append(f"{time_s:.6f} {frame + 1} {frame + 1} {channel} {value} 0")
    return "\n".join(lines) + "\n"


@pytest.fixture
def process_ids() -> Callable[[Path], dict[str, int]]:
    """Ids of processes whose command line names a folder, by service."""
    return _process_ids


def _process_ids(folder: Path) -> dict[str, int]:
    found: dict[str, int] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            command = (entry / "cmdline").read_bytes().decode().split("\0")
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # it ended meanwhile
            continue
        if not any(str(folder) in word for word in command) or state == "Z":
            continue
        if "run" in command:
            found[command[command.index("run") + 1]] = int(entry.name)
        elif any("station.supervisord" in word for word in command):
            found["supervisord"] = int(entry.name)
    return found


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool], float, str], float]:
    """Wait for a condition; the time it took [s], or a failure that says what did not happen."""
    return _wait_until


def _wait_until(condition: Callable[[], bool], timeout_s: float, what: str) -> float:
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > timeout_s:
            pytest.fail(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.02)
    return time.monotonic() - began
