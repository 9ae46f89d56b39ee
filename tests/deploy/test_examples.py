"""docs/examples run as they stand, against one virtual station in this process.

Those that need the finite-element service are tested in tests/fem.
"""

from __future__ import annotations

import functools
import re
import runpy
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from palpate import AsyncClient, Client
from palpate.admin import token_file
from palpate.config import LinkConfig, parse_config
from palpate_gateway.config import GatewayConfig
from palpate_gateway.service import node as gateway
from palpate_services.config import (
    FeaturesServiceConfig,
    FieldServiceConfig,
    ModelsConfig,
    RecorderConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.services import run_estimating
from palpate_services.recorder.service import run_recorder

LIVE_S = 60.0
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
NEED_SIMULATIONS = {"simulate.py", "simulate_cancel.py"}

RunExample = Callable[..., list[str]]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("records")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> ModelsConfig:
    folder = tmp_path_factory.mktemp("models")
    return ModelsConfig(folder=folder / "models", state=folder / "state")


@pytest.fixture(scope="module")
def station(
    router: Callable[[], AbstractContextManager[LinkConfig]], records: Path, models: ModelsConfig
) -> Iterator[Client]:
    """A finger that nobody touches, three services and a recorder, each in a thread."""
    finger = {
        "name": "finger",
        "driver": "virtual",
        "options": {"model": "formula", "untouched_s": 3600.0},
    }
    sensors = parse_config(GatewayConfig, {"sensors": [finger]}, where="test")
    recorder = parse_config(RecorderConfig, {"out": str(records), "rrd": False}, where="test")
    with router() as link:
        stop = threading.Event()
        patient = {"max_age_s": LIVE_S}  # a host on which other tests run, too
        parts: list[tuple[Callable[..., object], object]] = [
            (gateway.run, sensors),
            (
                functools.partial(run_estimating, models=models),
                parse_config(FeaturesServiceConfig, patient, where="test"),
            ),
            (run_estimating, parse_config(FieldServiceConfig, patient, where="test")),
            (run_estimating, parse_config(SynthesisServiceConfig, patient, where="test")),
            (run_recorder, recorder),
        ]
        threads = [
            threading.Thread(target=run, args=(config, link, "lab", stop), daemon=True)
            for run, config in parts
        ]
        for thread in threads:
            thread.start()
        try:
            with Client(link.connect[0], timeout_s=LIVE_S) as robot:
                robot.features("finger", max_age_s=LIVE_S)
                robot.field("finger", max_age_s=LIVE_S)
                yield robot
        finally:
            stop.set()
            for thread in threads:
                thread.join(LIVE_S)
    assert not any(thread.is_alive() for thread in threads)


@pytest.fixture
def run_example(
    station: Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> RunExample:
    """Runs a program with arguments, as `python docs/examples/...` does: the lines it printed."""
    (endpoint,) = station.session._link.connect
    monkeypatch.setenv("PALPATE_CONNECT", endpoint)
    # The examples' own ages are for a robot; this host may stand still for a moment.
    for name in ("features", "stream_features", "electrodes"):
        monkeypatch.setitem(getattr(Client, name).__kwdefaults__, "max_age_s", LIVE_S)

    def run(name: str, *arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run


def test_every_example_is_tested_and_listed() -> None:
    tests = Path(__file__).read_text(encoding="utf-8")
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f"[{path.name}]({path.name})" in listed
        assert path.name in NEED_SIMULATIONS or f'example("{path.name}"' in tests


def test_features_stream(run_example: RunExample) -> None:
    *lines, last = run_example("features_stream.py", "5")
    assert len(lines) == 5
    sequences = [int(line.split()[0]) for line in lines]
    assert sequences == sorted(set(sequences))
    assert re.fullmatch(r"\d+ were skipped", last)


def test_callbacks(run_example: RunExample) -> None:
    lines = run_example("callbacks.py", "1.0")
    assert any(re.fullmatch(r" *\d+ estimates, at most \d+\.\d\d N", line) for line in lines)


def test_async_tasks(run_example: RunExample) -> None:
    lines = run_example("async_tasks.py", "50")
    assert any(line.startswith("served by features-") for line in lines)
    assert [line.split(":")[0].strip() for line in lines if line.endswith(" N")] == ["25", "50"]


def test_swap_model(run_example: RunExample, models: ModelsConfig) -> None:
    token = str(token_file(models.memory_folder, "lab"))
    first, before, now, last = run_example("swap_model.py", "features-twin", token)
    assert first.startswith("finger: features-twin after ")
    assert before.split()[1] != now.split()[1], "another bundle made the second estimate"
    assert last.startswith("rolled back in ")


def test_grip_guard(run_example: RunExample) -> None:
    assert run_example("grip_guard.py", "0.5")[-1].startswith("done, ")


def test_the_guard_opens_at_too_much_force_and_at_no_news(station: Client) -> None:
    guard = runpy.run_path(str(EXAMPLES / "grip_guard.py"), run_name="guard")
    gripper = guard["Gripper"]()
    guard["guard"](station, gripper, max_age_s=LIVE_S)
    assert not gripper.is_open, "an untouched finger is held"
    guard["guard"](station, gripper, max_age_s=1e-9)
    assert gripper.is_open, "what is too old opens"
    guard["guard"](station, gripper, max_age_s=LIVE_S)
    assert not gripper.is_open
    guard["guard"].__globals__["MAX_FORCE_N"] = 0.0
    guard["guard"](station, gripper, max_age_s=LIVE_S)
    assert gripper.is_open, "too much force opens"


def test_tare(run_example: RunExample) -> None:
    first, *electrodes = run_example("tare.py")
    assert first.endswith("50 frames")
    assert len(electrodes) == 19


def test_field_query(run_example: RunExample) -> None:
    lines = run_example("field_query.py")
    assert re.match(r"frame \d+: \d+ nodes", lines[0])
    assert "moved most" in lines[1]


def test_synthesise(run_example: RunExample) -> None:
    assert len(run_example("synthesise.py")) == 20


def test_robot_pose(run_example: RunExample) -> None:
    (line,) = run_example("robot_pose.py", "0.2")
    told, dropped = map(int, re.findall(r"\d+", line))
    assert told > 5
    assert dropped == 0


def test_read_record(run_example: RunExample, station: Client, records: Path) -> None:
    """Of a copy of the file that is being written, as after a loss of power."""
    from palpate.files.record import recover

    deadline = time.monotonic() + LIVE_S
    while not (parts := list(records.rglob("*.mcap*"))) or not parts[0].stat().st_size:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    copy = records.parent / "copy" / parts[0].name
    copy.parent.mkdir(exist_ok=True)
    while True:
        copy.write_bytes(parts[0].read_bytes())
        record = recover(copy).path
        try:
            (line,) = run_example("read_record.py", str(record))
        except SystemExit:  # no estimate has been written yet
            assert time.monotonic() < deadline
            time.sleep(0.2)
        else:
            break
    assert re.fullmatch(r"\d+ estimates, the strongest force \d+\.\d\d N", line)


def test_without_a_station_an_example_says_what_to_do(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_CONNECT", f"tcp/127.0.0.1:{free_port}")
    for kind in (Client, AsyncClient):
        defaults: Any = kind.__init__.__kwdefaults__
        monkeypatch.setitem(defaults, "timeout_s", 0.2)
    for name in (
        "features_stream.py",
        "callbacks.py",
        "async_tasks.py",
        "tare.py",
        "synthesise.py",
    ):
        monkeypatch.setattr(sys, "argv", [name])
        with pytest.raises(SystemExit, match="palpate up"):
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
