"""What a person sees of a pose, and the example that a person starts from."""

from __future__ import annotations

import functools
import importlib
import json
import math
import re
import runpy
import shlex
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.bus import Session
from palpate.bus.topics import ROBOT_POSE
from palpate.client import Client
from palpate.config import LinkConfig
from palpate_deploy.cli.app import app
from palpate_gateway.cli.probe import device_of
from palpate_gateway.cli.streams import text_of, values_of
from palpate_gateway.readings import PoseReading

fakes: Any = importlib.import_module("pose_fakes")
PATIENCE_S: float = fakes.PATIENCE_S


def reading(position: Any, orientation: Any, in_contact: bool | None = None) -> PoseReading:
    where, turn = np.array(position), np.array(orientation)
    return PoseReading(1, 0.5, "cube", where, turn, in_contact)


def test_a_pose_in_words() -> None:
    half = math.sqrt(0.5)
    assert text_of(reading((-0.004, 0.0012, -0.011), (1.0, 0.0, 0.0, 0.0))) == [
        "tip        -4.00    +1.20   -11.00 mm: 4.0 proximal, 1.2 to +y, 11.0 ventral of the "
        "sensor frame's origin",
        "presses   +0.000   +0.000   +1.000: 0.0 deg from +z",
        "cube, contact not known",
    ]
    first, second, third = text_of(reading((0.006, -0.001, 0.0), (half, 0.0, -half, 0.0), True))
    assert "6.0 distal, 1.0 to -y, 0.0 dorsal" in first
    assert second == "presses   -1.000   +0.000   +0.000: 90.0 deg from +z"
    assert third == "cube, touches"
    assert text_of(reading((0, 0, 0), (1, 0, 0, 0), False))[2] == "cube, does not touch"


def test_a_pose_for_machines() -> None:
    values = values_of(reading((-0.004, 0.0, -0.011), (1.0, 0.0, 0.0, 0.0)))
    assert values["in_contact"] is None
    assert values["position_m"] == [-0.004, 0.0, -0.011]
    assert json.loads(json.dumps(values)) == values
    assert values_of(reading((0, 0, 0), (1, 0, 0, 0), True))["in_contact"] is True


class Quick(threading.Thread):
    """The example as a robot's program, until the block ends."""

    def __init__(self, link: LinkConfig) -> None:
        super().__init__(daemon=True)
        self.link = link
        self.stop = threading.Event()

    def run(self) -> None:
        with Session.open(self.link) as session:
            told = session.publisher(ROBOT_POSE, sensor="arm")
            number = 0
            while not self.stop.wait(0.004):
                number += 1
                told.put(fakes.frame(number))

    def __enter__(self) -> Quick:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        self.join(PATIENCE_S)


def words(link: LinkConfig) -> list[str]:
    out = ["pose_zenoh", "robot=arm", f"connect={link.connect[0]}", "indenter=sphere_7mm"]
    for name in ("base_sensor", "flange_indenter"):
        out += [f"{name}.{key}={list(value)}" for key, value in fakes.BENCH[name].items()]
    return out


def test_probe_says_where_the_tip_is(link: LinkConfig) -> None:
    with Quick(link):
        result = CliRunner().invoke(app, ["gateway", "probe", *words(link), "--seconds", "1"])
    assert result.exit_code == 0, result.output
    assert "robot arm, sphere_7mm (pose_zenoh)" in result.output
    assert re.search(r"pose +\d+\.\d\d Hz", result.output)
    assert "4.0 proximal, 0.0 to " in result.output
    assert "contact not known" in result.output


def test_probe_without_a_robot_says_what_to_do(link: LinkConfig) -> None:
    result = CliRunner().invoke(app, ["gateway", "probe", *words(link), "--seconds", "0.3"])
    assert result.exit_code == 1
    assert "no reading came within 0.3 s" in result.output
    assert "palpate topic list" in result.output


def test_the_example_tells_poses(
    root: Path, link: LinkConfig, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    example = root / "docs" / "examples" / "robot_pose.py"
    text = example.read_text(encoding="utf-8").replace("\\\n", " ")
    (command,) = re.findall(r"palpate gateway probe (.*)", text)
    driver, *options = shlex.split(command)
    ours = functools.partial(Client, link.connect[0], timeout_s=PATIENCE_S)
    monkeypatch.setattr("palpate.client.Client", ours)
    monkeypatch.setattr(sys, "argv", [str(example), "1.5"])
    with device_of(driver, [*options, f"connect={link.connect[0]}"]) as device:
        player = threading.Thread(
            target=runpy.run_path, args=(str(example),), kwargs={"run_name": "__main__"}
        )
        player.start()
        readings = fakes.take(device, 50)
        player.join(PATIENCE_S)
    assert {reading.indenter for reading in readings} == {"sphere_7mm"}
    for one in readings:  # over the origin, pressing towards the nail
        assert one.position[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
        assert abs(one.position[2] + 0.01) < 0.003
        assert abs(one.orientation[0]) == pytest.approx(1.0)
    put = re.fullmatch(r"(\d+) poses told, 0 dropped\n", capsys.readouterr().out)
    assert put is not None
    assert int(put[1]) > 50


def test_the_example_without_a_station_says_what_to_do(
    root: Path, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = functools.partial(Client, f"tcp/127.0.0.1:{free_port}", timeout_s=0.2)
    monkeypatch.setattr("palpate.client.Client", nowhere)
    monkeypatch.setattr(sys, "argv", ["robot_pose.py"])
    with pytest.raises(SystemExit, match="palpate up"):
        runpy.run_path(str(root / "docs" / "examples" / "robot_pose.py"), run_name="__main__")
