"""Field and synthesis as processes of a station: named in a profile, off by default."""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ConfigError
from palpate_deploy.diagnose.doctor import run_doctor
from palpate_deploy.station.processes import START_ORDER, service_named
from palpate_deploy.station.profile import SERVICES, load_profile

PATIENCE_S = 20.0


@pytest.fixture
def bundles() -> Any:
    pytest.importorskip("onnx")
    folder = str(Path(__file__).resolve().parents[1] / "services")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module("field_bundles")


@pytest.fixture
def profile(bundles: Any, link: LinkConfig, tmp_path: Path) -> Path:
    for task in ("field", "synthesis"):
        bundles.write(tmp_path / task, task)
    path = tmp_path / "mine.toml"
    path.write_text(
        'processes = ["field", "synthesis"]\n'
        f'[link]\nconnect = ["{link.connect[0]}"]\n'
        f'[field]\nbundle = "{tmp_path}/field"\nrate_hz = 10\n'
        f'[synthesis]\nbundle = "{tmp_path}/synthesis"\nsource = "estimate"\n',
        encoding="utf-8",
    )
    return path


def test_they_are_off_by_default_and_listen_before_their_source_speaks() -> None:
    assert not {"field", "synthesis"} & set(SERVICES)
    order = [START_ORDER.index(service_named(n)) for n in ("synthesis", "field", "gateway")]
    assert order == sorted(order)


def test_their_tables(profile: Path) -> None:
    read = load_profile(profile)
    assert (read.field.rate_hz, read.synthesis.source) == (10.0, "estimate")
    assert load_profile("virtual").field.bundle == "field-twin"
    profile.write_text('[synthesis]\nsource = "hearsay"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"synthesis\.source"):
        load_profile(profile)


def test_doctor_tries_each_bundle_that_is_served(
    profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def finding() -> dict[str, str]:
        run_doctor(str(profile), as_json=True)
        findings = json.loads(capsys.readouterr().out)
        (found,) = [found for found in findings if found["what"] == "bundle"]
        return dict(found)

    good = finding()
    assert good["grade"] == "ok"
    assert "field-test:1, synthesis-test:1" in good["found"]
    (tmp_path / "synthesis" / "mesh.npz").unlink()
    assert finding()["grade"] == "fail"


@pytest.mark.parametrize("service", ["field", "synthesis"])
def test_it_runs_and_ends(service: str, profile: Path, link: LinkConfig) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "run", service, "--profile", str(profile)],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        with Client(link.connect[0], timeout_s=5) as robot:
            deadline = time.monotonic() + PATIENCE_S
            while not any(found.ready for found in robot.alive()):
                assert time.monotonic() < deadline
                time.sleep(0.05)
            assert robot.model(service=service).name == f"{service}-test"
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert "Traceback" not in said
    finally:
        process.kill()
        process.wait()
