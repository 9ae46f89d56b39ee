"""The bridge to ROS as a process of a station: named in a profile, off by default."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.errors import ConfigError
from palpate_deploy.station.processes import START_ORDER, check_packages, service_named
from palpate_deploy.station.profile import SERVICES, load_profile

PATIENCE_S = 20.0


@pytest.fixture
def profile(link: LinkConfig, tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(
        'station = "rosy"\nprocesses = ["ros_bridge"]\n'
        f'[link]\nconnect = ["{link.connect[0]}"]\n[ros_bridge]\ndomain = 5\n',
        encoding="utf-8",
    )
    return path


def test_it_is_off_by_default_and_listens_before_its_source_speaks() -> None:
    assert "ros_bridge" not in SERVICES
    assert START_ORDER.index(service_named("ros_bridge")) < START_ORDER.index("features")


def test_its_table(profile: Path) -> None:
    read = load_profile(profile)
    assert read.ros_bridge.domain == 5
    check_packages(read)
    profile.write_text('[ros_bridge]\nnamespace = "touch"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="namespace"):
        load_profile(profile)


def test_it_runs_as_a_process_and_leaves_the_graph_of_ros(profile: Path, link: LinkConfig) -> None:
    with Session.open(link) as session:
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_deploy", "run", "ros_bridge", "--profile", str(profile)]
        )
        try:
            until = time.monotonic() + PATIENCE_S
            while not session.foreign_tokens("@ros2_lv/5/**"):
                assert time.monotonic() < until
                assert process.poll() is None
                time.sleep(0.1)
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) == 0
        assert not session.foreign_tokens("@ros2_lv/5/**")
