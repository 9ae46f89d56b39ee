"""``palpate gateway``: what is there, whether it answers, what it sends."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from palpate.errors import MissingExtraError
from palpate_deploy.cli.app import app
from palpate_gateway.cli import inventory
from palpate_gateway.drivers import driver_names
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.rdt import RdtEmulator

PATIENCE_S = 30.0


@pytest.fixture
def kms40() -> Iterator[Kms40Emulator]:
    with Kms40Emulator() as emulator:
        yield emulator


def at(emulator: Kms40Emulator) -> list[str]:
    host, _, port = emulator.address.rpartition(":")
    return ["wrench_kms40", f"host={host}", f"port={port}", "rate_hz=100"]


def gateway(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["gateway", *arguments])


def test_list_names_every_driver_and_says_what_is_not_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    monkeypatch.setattr("can.detect_available_configs", lambda kind, timeout: [])
    result = gateway("list")
    assert result.exit_code == 0
    for name in driver_names():
        assert f"\n  {name} " in result.output
    assert result.output.count("none found") == 2
    assert "hardware reference" not in result.output


def test_list_for_machines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tty, steady = tmp_path / "ttyUSB0", tmp_path / "by-id"
    tty.touch()
    steady.mkdir()
    (steady / "usb-one").symlink_to(tty)

    class Port:
        device, description = str(tty), "n/a"

    def detect(kind: str, timeout: float) -> list[dict[str, Any]]:
        if kind == "pcan":
            raise RuntimeError("a vendor's driver")
        if kind == "socketcan":
            return [{"interface": kind, "channel": "can0", "bitrate": 5}]
        return []

    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [Port()])
    monkeypatch.setattr("can.detect_available_configs", detect)
    monkeypatch.setattr(inventory, "BY_ID", steady)
    found = json.loads(gateway("list", "--json").output)
    assert {driver["name"] for driver in found["drivers"]} == set(driver_names())
    (port,) = found["serial_ports"]
    assert port == {"by_id": str(steady / "usb-one"), "port": str(tty), "what": ""}
    (bus,) = found["can_interfaces"]
    assert bus == {"interface": "socketcan", "channel": "can0", "more": "bitrate=5"}


def test_list_says_which_extra_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str, *, extra: str) -> Any:
        raise MissingExtraError(module, extra=extra)

    monkeypatch.setattr(inventory, "require", missing)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    output = gateway("list").output
    robotous = next(line for line in output.splitlines() if "wrench_robotous" in line)
    assert 'python-can, pyserial; pip install "palpate[gateway]"' in robotous
    assert "[ready]" in next(line for line in output.splitlines() if "wrench_kms40" in line)
    assert output.count("is not installed") == 2


def test_probe_tells_who_it_is_and_how_fast(kms40: Kms40Emulator) -> None:
    result = gateway("probe", *at(kms40), "--seconds", "0.5", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert (found["serial"], found["nominal_rate_hz"]) == ("310042", 100.0)
    wrench = found["streams"]["wrench"]
    assert wrench["readings"] > 5
    assert wrench["rate_hz"] == pytest.approx(100.0, rel=0.5)
    assert len(wrench["first"]["force_n"]) == 3
    assert found["counters"]["samples"] == wrench["readings"]


def test_probe_takes_tables(kms40: Kms40Emulator) -> None:
    words = [*at(kms40), "mount.carries=indenter", "serial=007"]
    result = gateway("probe", *words, "--seconds", "0.3")
    assert result.exit_code == 0, result.output
    assert "serial     007" in result.output
    assert " N m" in result.output
    assert "counters   " in result.output


def test_probe_of_a_file_ends_with_it(log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(12).write(tmp_path / "small.btd")
    result = gateway("probe", "text_log", f"path={path}", "port=3")
    assert result.exit_code == 0, result.output
    assert "(12 readings)" in result.output
    assert "E1..E10" in result.output


def test_probe_of_nothing_fails_with_a_remedy(free_port: int) -> None:
    result = gateway("probe", "wrench_kms40", "host=127.0.0.1", f"port={free_port}")
    assert result.exit_code == 1
    problem, fix = result.stderr.splitlines()
    assert problem.startswith(f"error: 127.0.0.1:{free_port}: no connection")
    assert fix.startswith("  fix: check address")


def test_probe_of_a_device_that_falls_silent(kms40: Kms40Emulator) -> None:
    kms40.inject("silence", PATIENCE_S)
    result = gateway("probe", *at(kms40), "--seconds", "0.3")
    assert result.exit_code == 1
    assert "was not answered" in result.stderr


def test_probe_says_why_a_device_that_sends_gives_no_reading() -> None:
    with RdtEmulator("netft") as rdt:
        rdt.inject("error", PATIENCE_S)
        host, _, port = rdt.address.partition(":")
        words = ["product=ati_net_ft", f"host={host}", f"port={port}", f"http_port={rdt.page.port}"]
        result = gateway("probe", "wrench_rdt", *words, "--seconds", "0.3")
        assert result.exit_code == 1
        assert "no reading came within 0.3 s, but it counted datagrams, invalid" in result.stderr
        assert "fix: look these counters up" in result.stderr
        assert re.search(r"counters   .*invalid_samples [1-9]", result.stdout)
        result = gateway("probe", "wrench_rdt", *words, "--seconds", "0.3", "--json")
        assert json.loads(result.stdout)["counters"]["invalid_samples"] > 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["wrench_kms4", "host=a"], "did you mean 'wrench_kms40'"),
        (["wrench_kms40", "host=a", "hots=a"], "did you mean 'host'"),
        (["wrench_kms40", "host"], "KEY=VALUE"),
    ],
)
@pytest.mark.parametrize("command", ["probe", "monitor"])
def test_wrong_options_are_usage_errors(command: str, words: list[str], told: str) -> None:
    result = gateway(command, *words)
    assert result.exit_code == 2
    assert told in result.stderr


def test_monitor_for_machines(kms40: Kms40Emulator) -> None:
    result = gateway("monitor", *at(kms40), "--seconds", "1.5", "--json")
    assert result.exit_code == 0, result.output
    first, last = map(json.loads, result.output.splitlines())
    assert first["streams"]["wrench"]["rate_hz"] == pytest.approx(100.0, rel=0.5)
    assert last["streams"]["wrench"]["readings"] > first["streams"]["wrench"]["readings"]
    assert last["state"] == "open"
    assert last["streams"]["wrench"]["age_s"] < 1.0
    assert last["counters"]["device_lost"] == 0


def test_monitor_opens_a_lost_device_again(kms40: Kms40Emulator) -> None:
    def restart() -> None:
        while kms40.sent < 20:
            time.sleep(0.01)
        kms40.inject("restart")

    breaker = threading.Thread(target=restart, daemon=True)
    breaker.start()
    result = gateway("monitor", *at(kms40), "--seconds", "4", "--json")
    breaker.join(1.0)
    last = json.loads(result.stdout.splitlines()[-1])
    assert last["counters"]["device_lost"] == 1
    assert last["state"] == "open"


def test_monitor_draws_a_table(kms40: Kms40Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes the output for a terminal
    result = gateway("monitor", *at(kms40), "--seconds", "0.6")
    assert result.exit_code == 0
    for word in ("wrench", "force", "device_lost", "open"):
        assert word in result.output


def test_ctrl_c_ends_the_monitor(kms40: Kms40Emulator) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "gateway", "monitor", *at(kms40), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["state"] == "open"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, errors) == (0, "")
    assert not kms40.streaming


def test_monitor_without_a_terminal_writes_lines(kms40: Kms40Emulator) -> None:
    result = gateway("monitor", *at(kms40), "--seconds", "0.4")
    (line,) = result.output.splitlines()
    assert "open" in line
    assert "force" in line
