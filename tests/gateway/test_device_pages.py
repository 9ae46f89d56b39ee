"""The pages on devices: their examples are valid, their options and counters exist."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from palpate.config import parse_config
from palpate_gateway.cli.probe import device_of
from palpate_gateway.config import GatewayConfig
from palpate_gateway.drivers import make_device

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "devices").glob("*.md"))
SOURCES = "\n".join(
    path.read_text(encoding="utf-8")
    for path in (ROOT / "gateway" / "palpate_gateway").rglob("*.py")
)
OF_STATIONS = {
    "biotac_bridge",
    "biotac_can",
    "biotac_pic32",
    "pose_file",
    "pose_zenoh",
    "ros_bag",
    "ros_biotac",
    "ros_wrench",
    "wrench_bota",
    "wrench_kms40",
    "wrench_rdt",
    "wrench_robotous",
}

pytestmark = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)


def test_examples_of_profiles_are_valid(page: Path) -> None:
    blocks = re.findall(r"^```toml\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    assert blocks
    for block in blocks:
        values = tomllib.loads(block)["gateway"]
        for sensor in parse_config(GatewayConfig, values, where=page.name).sensors:
            assert sensor.driver in OF_STATIONS
            make_device(sensor.driver, sensor.options)


def test_examples_of_commands_are_valid(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    commands = re.findall(r"palpate gateway (?:probe|monitor) (\w+ [^`#\n]*)", text)
    assert commands
    for command in commands:
        driver, *words = shlex.split(command)
        device_of(driver, words)


def test_counters_exist(page: Path) -> None:
    table = page.read_text(encoding="utf-8").partition("| counter |")[2].partition("\n\n")[0]
    names = {
        name
        for row in table.splitlines()
        for name in re.findall(r"`([^`]+)`", row.split("|")[1] if row.startswith("|") else "")
        if not name.endswith("...") and not name.startswith("_")
    }
    assert len(names) > 4
    for name in names - {"status_overload_fx"}:  # made of a prefix and the name of an axis
        assert f'"{name}"' in SOURCES, name
