"""The finite-element service as a process of a station: named in a profile, off by default."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ConfigError
from palpate_deploy.station.processes import START_ORDER, service_named
from palpate_deploy.station.profile import load_profile, profile_names

FAKES = Path(__file__).resolve().parents[1] / "fem"
PATIENCE_S = 20.0


@pytest.mark.parametrize("name", profile_names())
def test_no_shipped_profile_runs_it(name: str) -> None:
    assert "fem" not in load_profile(name).processes


def test_it_can_be_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('processes = ["router", "fem"]\n[fem]\nworkers = 1\n', encoding="utf-8")
    profile = load_profile(path)
    assert profile.fem.workers == 1
    assert service_named("fem") in START_ORDER
    path.write_text("[fem]\nworker = 1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="unknown key"):
        load_profile(path)


def test_it_runs_and_ends(link: LinkConfig, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        f'[link]\nconnect = ["{link.connect[0]}"]\n'
        '[fem]\nworkers = 1\nfactory = "fem_fakes:make"\n',
        encoding="utf-8",
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "run", "fem", "--profile", str(path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(FAKES), *sys.path])},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        with Client(link.connect[0], timeout_s=5) as robot:
            deadline = time.monotonic() + PATIENCE_S
            while not any(found.ready for found in robot.alive()):
                assert time.monotonic() < deadline
                time.sleep(0.05)
            (status,) = robot.status()
            assert (status.service, status.sensors) == ("fem", ("twin",))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "Traceback" not in said
    finally:
        process.kill()
        process.wait()
