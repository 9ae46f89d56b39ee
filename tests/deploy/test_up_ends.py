"""``palpate up`` that cannot go on says why; one with finite sources ends in order."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate_deploy.station.host import free_endpoint
from palpate_deploy.station.processes import command_line

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

PATIENCE_S = 60.0

HIDES = """
import importlib.abc, sys

class Hides(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == {module!r}:
            raise ModuleNotFoundError(name=name)

sys.meta_path.insert(0, Hides())
"""

PROFILE = """
station = "test"
processes = {processes}
[router]
listen = ["{endpoint}"]
[gateway]
exit_at_end = true
linger_s = 0.2
{sensors}
[features]
bundle = "{bundle}"
[recorder]
out = "{out}"
"""

SENSOR = """
[[gateway.sensors]]
name = "{name}"
driver = "{driver}"
options = {{ {options} }}
"""


@pytest.fixture
def profile(tmp_path: Path) -> Callable[..., Path]:
    """A profile with processes, bundle and tables of sensors."""

    def write(*processes: str, sensors: str = "", bundle: str = "features-virtual") -> Path:
        path = tmp_path / "mine.toml"
        values = {
            "processes": list(processes),
            "endpoint": free_endpoint(),
            "sensors": sensors,
            "bundle": bundle,
            "out": tmp_path / "runs",
        }
        path.write_text(PROFILE.format(**values), encoding="utf-8")
        return path

    return write


def _logs(paths: list[Path]) -> str:
    return "".join(
        SENSOR.format(name=f"finger{k}", driver="text_log", options=f'path = "{path}"')
        for k, path in enumerate(paths)
    )


@pytest.mark.parametrize(
    ("module", "process", "driver", "extra"),
    [
        ("onnxruntime", "features", "virtual", "services"),
        ("rerun", "recorder", "virtual", "services"),
        ("warp", "fem", "virtual", "fem"),
        ("can", "gateway", "biotac_can", "gateway"),
        ("serial", "gateway", "biotac_pic32", "gateway"),
        ("cobs", "gateway", "biotac_bridge", "gateway"),
    ],
)
def test_a_missing_package_is_named_before_anything_starts(
    palpate: Palpate,
    profile: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    process: str,
    driver: str,
    extra: str,
) -> None:
    """The base install lacks the packages of the extras."""
    (tmp_path / "base").mkdir()
    hides = tmp_path / "base" / "sitecustomize.py"
    hides.write_text(HIDES.format(module=module), encoding="utf-8")
    paths = [str(tmp_path / "base"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    sensors = SENSOR.format(name="finger", driver=driver, options="")
    result = palpate("up", "--profile", profile("router", process, sensors=sensors))
    assert result.returncode == 2
    assert f"'{module}' is not installed" in result.stderr
    assert f'pip install "palpate[{extra}]"' in result.stderr
    assert not list(Path(os.environ["XDG_STATE_HOME"]).rglob("supervisord.conf"))


@pytest.mark.slow
def test_systemd_hears_when_a_station_is_up_alive_and_stops(
    profile: Callable[..., Path], tmp_path: Path
) -> None:
    """From `palpate up` itself: its processes are not the service manager's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(PATIENCE_S)
        where = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000"}
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_deploy", "up", "--profile", str(profile("router"))],
            env={**os.environ, **where},
            stdout=subprocess.DEVNULL,
        )
        try:
            said: list[str] = []
            while said.count("WATCHDOG=1") < 3 or "STATUS=1 of 1 processes run" not in said:
                said += systemd.recv(4096).decode().splitlines()
            assert said.count("READY=1") == 1
            process.terminate()
            while "STOPPING=1" not in said:
                said += systemd.recv(4096).decode().splitlines()
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_process_of_its_own_tells_systemd_too(
    profile: Callable[..., Path], tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(PATIENCE_S)
        process = subprocess.Popen(
            command_line("router", profile("router")),
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000"},
        )
        try:
            assert systemd.recv(4096).startswith(b"READY=1\n")
            assert systemd.recv(4096).endswith(b"WATCHDOG=1")
        finally:
            process.terminate()
            assert process.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_a_process_that_cannot_be_configured_ends_the_station(
    palpate: Palpate, profile: Callable[..., Path]
) -> None:
    """It would be started again for ever."""
    result = palpate("up", "--profile", profile("router", "features", bundle="not-there"))
    assert result.returncode == 2
    assert "not-there" in result.stderr
    assert "features" in result.stderr


@pytest.mark.slow
def test_finite_logs_end_the_station_in_order(
    palpate: Palpate, profile: Callable[..., Path], text_log: Path, bundle: str, tmp_path: Path
) -> None:
    path = profile("router", "gateway", "features", "recorder", sensors=_logs([text_log] * 3))
    result = palpate("up", "--profile", path, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "error" not in result.stderr
    lines = result.stdout.splitlines()
    assert any("all sources have ended" in line and "frames published" in line for line in lines)
    assert lines[-1] == "stopped"
    assert list((tmp_path / "runs").glob("*.mcap"))


@pytest.mark.slow
def test_a_damaged_log_ends_the_station_with_its_error(
    palpate: Palpate, profile: Callable[..., Path], text_log: Path, tmp_path: Path
) -> None:
    """All before the damage was delivered: to start again would play it twice."""
    damaged = tmp_path / "damaged.btd"
    shutil.copy(text_log, damaged)
    with open(damaged, "r+b") as file:
        file.truncate(damaged.stat().st_size // 2)
        file.seek(0, os.SEEK_END)
        file.write(b"\n0.9 not a sample\n")
    sensors = _logs([text_log, damaged, text_log])
    result = palpate("up", "--profile", profile("router", "gateway", sensors=sensors), timeout=120)
    assert result.returncode == 3, result.stdout + result.stderr
    assert "damaged.btd" in result.stderr
    assert "restart" not in result.stdout
    assert result.stdout.splitlines()[-1] == "stopped"
