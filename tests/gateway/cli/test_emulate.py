"""``palpate emulate`` as a program of its own, read by ``palpate gateway probe``."""

from __future__ import annotations

import json
import random
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.config import parse_config
from palpate_deploy.cli.app import app
from palpate_gateway.config import GatewayConfig
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.twin import loop_options, make_loop

PATIENCE_S = 60.0
PALPATE = [sys.executable, "-m", "palpate_deploy"]

Emulate = Callable[..., "Program"]

EMULATORS = {
    "kms40": [""],
    "rdt": [""],
    "robotous": ["", "--interface virtual --channel faults"],
    "bota": [""],
    "biotac-can": ["--interface virtual --channel faults"],
    "biotac-bridge": [""],
    "biotac-pic32": [""],
}
"""Commands, and the words without which not all of them can run anywhere."""


class Program:
    """An emulator that runs; what it said of itself."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [*PALPATE, "emulate", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.said = ""
        # Its last line is the command that tries it.
        for line in self.process.stdout:
            self.said += line
            if line.startswith("# palpate gateway probe "):
                self.probe = shlex.split(line[2:])[1:]
                return
        raise AssertionError(self.process.communicate(timeout=PATIENCE_S)[1])

    @property
    def sensors(self) -> list[dict[str, Any]]:
        """The tables that it prints, as the gateway reads them."""
        tables = tomllib.loads(self.said)["gateway"]
        config = parse_config(GatewayConfig, tables, where="its snippet")
        return [sensor.model_dump() for sensor in config.sensors]

    def interrupt(self) -> str:
        """Ctrl-C; what it says at its end."""
        self.process.send_signal(signal.SIGINT)
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 0, errors
        assert "Traceback" not in errors
        return errors


@pytest.fixture
def emulate() -> Iterator[Emulate]:
    running: list[Program] = []

    def start(*arguments: str) -> Program:
        running.append(Program(*arguments))
        return running[-1]

    yield start
    for program in running:
        if program.process.poll() is None:
            program.process.kill()
            program.process.communicate()


def gateway(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["gateway", *arguments])


@pytest.mark.parametrize(
    "arguments",
    [
        ["kms40"],
        ["rdt", "--product", "ati_axia"],
        ["rdt", "--product", "onrobot_hex"],
        ["robotous", "--link", "./rft"],
        ["bota"],
        ["biotac-bridge", "--fingers", "1", "--play", "idle"],
        ["biotac-pic32", "--electrodes-first", "--play", "press"],
    ],
    ids=" ".join,
)
def test_what_an_emulator_prints_is_what_reads_it(
    arguments: list[str], emulate: Emulate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program = emulate(*arguments)
    (sensor,) = program.sensors
    assert make_device(sensor["driver"], sensor["options"])
    assert program.probe[:3] == ["gateway", "probe", sensor["driver"]]
    result = gateway(*program.probe[1:], "--seconds", "0.4", "--json")
    assert result.exit_code == 0, result.output
    (stream,) = json.loads(result.output)["streams"].values()
    assert stream["readings"] > 5
    assert "samples sent" in program.interrupt()
    assert not (tmp_path / "rft").is_symlink()


@pytest.mark.parametrize("kind", ["biotac-can", "robotous"])
def test_can_between_processes(kind: str, emulate: Emulate) -> None:
    pytest.importorskip("msgpack", reason="palpate[gateway] is not installed")
    # A group of our own, and a port: groups of one port are heard by all that listen at it.
    group = f"239.74.{random.randint(1, 254)}.{random.randint(1, 254)}"
    words = ["--interface", "udp_multicast", "--channel", group]
    if kind == "biotac-can":
        words += ["--slot-rate-hz", "1100", "--fingers", "2", "--play", "idle"]
        words += ["--bus", f"port={random.randint(20_000, 30_000)}"]
    program = emulate(kind, *words)
    result = gateway(*program.probe[1:], "--seconds", "0.5", "--json")
    assert result.exit_code == 0, result.output
    (stream,) = json.loads(result.output)["streams"].values()
    assert stream["readings"] > 3
    if kind == "biotac-can":
        assert [sensor["options"]["port"] for sensor in program.sensors] == [1, 2]
        assert stream["first"]["electrodes"][:2] == [2000, 2050]


def test_what_is_played_is_the_twin(emulate: Emulate) -> None:
    scene = ["--seed", "4", "--trajectory", "cube/00/normal", "--epoch", str(time.time() - 4.0)]
    finger = emulate("biotac-bridge", "--fingers", "1", *scene)
    wrench = emulate("kms40", *scene)
    loop = make_loop(loop_options(seed=4, trajectories=["cube/00/normal"]))
    told = [json.loads(gateway(*one.probe[1:], "--json").output) for one in (finger, wrench)]
    # Each first reading is one of the loop; between two of its frames all runs straight.
    electrodes = told[0]["streams"]["electrodes"]["first"]["electrodes"]
    frames = loop.frames[:, :19].astype(np.float64)
    between = [
        frames + part * (np.roll(frames, -1, axis=0) - frames) for part in (0.0, 0.25, 0.5, 0.75)
    ]
    assert np.abs(np.concatenate(between) - electrodes).max(axis=1).min() <= 8
    force = told[1]["streams"]["wrench"]["first"]["force_n"]
    begin = np.array(loop.wrench)[:, :3]
    way = np.diff(begin, axis=0, append=begin[:1])
    length = np.maximum((way**2).sum(axis=1), 1e-12)
    share = np.clip(((np.array(force) - begin) * way).sum(axis=1) / length, 0.0, 1.0)
    assert np.linalg.norm(begin + share[:, None] * way - force, axis=1).min() < 0.05


@pytest.mark.parametrize(("name", "lines"), EMULATORS.items())
def test_all_faults_that_the_help_names_can_be_had(
    name: str, lines: list[str], tmp_path: Path
) -> None:
    told = CliRunner().invoke(app, ["emulate", name, "--help"]).output
    named = " ".join(told.partition("Faults: ")[2].partition(". Example")[0].split())
    for more in lines:
        kind = more.split() if more else []
        faults = set(re.findall(r"\w+", named.partition(";")[0]))
        if "--interface" in kind:
            faults = faults - {"crc"} | {"busoff"}
        words = [word for fault in sorted(faults) for word in ("--fault", f"{fault}@0")]
        ran = ["emulate", name, *kind, "--play", "idle", "--seconds", "0.3", *words]
        result = CliRunner().invoke(app, ran)
        assert result.exit_code == 0, result.output
        assert result.stderr.count(" once") == len(faults) > 9
        # And there are no others.
        result = CliRunner().invoke(app, ["emulate", name, *kind, "--fault", "fire@1"])
        assert set(result.stderr.partition("its faults: ")[2].replace(",", "").split()) == faults


def test_faults_come_when_they_should(emulate: Emulate) -> None:
    program = emulate("kms40", "--fault", "error@0.1+60", "--seconds", "20")
    time.sleep(0.5)
    result = gateway(*program.probe[1:], "--seconds", "0.3")
    assert result.exit_code == 1
    assert "calibration fault" in result.stderr
    assert "error for 60 s" in program.interrupt()


def test_sigterm_ends_it_too(emulate: Emulate) -> None:
    program = emulate("rdt")
    program.process.terminate()
    assert program.process.wait(PATIENCE_S) == 0


def test_an_emulator_ends_by_itself(emulate: Emulate) -> None:
    program = emulate("bota", "--seconds", "0.2")
    assert program.process.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["kms40", "--fault", "fire@1"], "its faults: clock_drift, cut, error, junk"),
        (["biotac-bridge", "--baud", "7"], "one of 50, 75, 110"),
        (["biotac-can", "--unit", "none"], "choose a number from 1 to 3"),
        (["bota", "--trajectory", "cube/00/norml"], "did you mean 'cube/00/normal'"),
        (["bota", "--baud", "1"], "one of 57600, 115200"),
        (["robotous", "--model", "RFT"], "one of RFT40-SA01"),
        (["robotous", "--play", "idle", "--serial", "RFT-\u00e4"], "letter that is not ASCII"),
        (["robotous", "--link", "a-file"], "a file of this name is there"),
        (["bota", "--link", "a-link"], "a-link is a link to a-file, not the name of a line"),
        (["bota", "--link", "nowhere/line"], "there is no folder nowhere"),
        (["biotac-can", "--bus", "port"], "KEY=VALUE"),
    ],
)
def test_wrong_words_for_emulators(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a-file").write_text("precious")
    (tmp_path / "a-link").symlink_to("a-file")
    result = CliRunner().invoke(app, ["emulate", *arguments])
    assert result.exit_code == 2
    assert told in result.stderr
    assert (tmp_path / "a-file").read_text() == "precious"
    assert (tmp_path / "a-link").readlink() == Path("a-file")


def test_an_address_that_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        result = CliRunner().invoke(app, ["emulate", "kms40", "--port", port])
    assert result.exit_code == 1
    assert "the emulator cannot start there" in result.stderr
    result = CliRunner().invoke(app, ["emulate", "biotac-can", "--interface", "nonsense"])
    assert result.exit_code == 1
    assert "the emulator cannot start there" in result.stderr


def test_an_emulator_that_dies_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def die(self: Kms40Emulator) -> None:
        raise RuntimeError("no more")

    monkeypatch.setattr(Kms40Emulator, "_serve", die)
    result = CliRunner().invoke(app, ["emulate", "kms40"])
    assert result.exit_code == 3
    assert "no more" in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["kms40", "--fault", "fire@1"],
        ["biotac-can", "--fault", "silence@-1"],
        ["robotous", "--interface", "virtual", "--fault", "crc@1"],
    ],
)
def test_a_fault_is_checked_before_the_twin_is_computed(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def computed(*_: Any, **__: Any) -> None:
        raise AssertionError("the twin was computed first")

    monkeypatch.setattr("palpate_gateway.emulators.twin.make_loop", computed)
    result = CliRunner().invoke(app, ["emulate", *words])
    assert result.exit_code == 2, result.output
    assert "--fault" in str(result.output) + str(result.stderr)
