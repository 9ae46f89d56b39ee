from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from palpate.errors import ConfigError, MissingExtraError
from palpate_gateway import drivers
from palpate_gateway.virtual.finger import VirtualFinger


def test_built_in_drivers() -> None:
    assert {"virtual", "text_log", "record"} <= set(drivers.driver_names())
    for name in drivers.DRIVERS:
        assert drivers.load_driver(name).options_class


def test_unknown_driver_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="unknown driver 'virtul' -> did you mean 'virtual'"):
        drivers.make_device("virtul")
    with pytest.raises(
        ConfigError, match="known drivers: biotac_bridge, biotac_can, biotac_pic32, pose_file, "
    ):
        drivers.make_device("zzzzzz")


@pytest.mark.parametrize("driver", ["biotac_can", "wrench_robotous"])
def test_bit_rate_that_would_be_ignored_is_refused(driver: str) -> None:
    bus = {"channel": "can0", "bitrate": 500_000}
    drivers.make_device(driver, {**bus, "interface": "slcan"})
    with pytest.raises(ConfigError, match=r"bitrate 500000 restart-ms 100\): leave it out"):
        drivers.make_device(driver, {**bus, "interface": "socketcan"})


def test_unknown_option_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"options of driver 'virtual'.*'sed'.*'seed'"):
        drivers.make_device("virtual", {"sed": 3})
    with pytest.raises(ConfigError, match="key 'path' is missing"):
        drivers.make_device("text_log", {})
    with pytest.raises(ConfigError, match="indenter"):
        drivers.make_device("virtual", {"indenter": "sphere_9mm"})


@pytest.mark.parametrize("serial", ["ünï çode", "x" * 65, "a\nb"])
@pytest.mark.parametrize("name", drivers.DRIVERS)
def test_a_serial_number_is_published_as_given_or_refused(name: str, serial: str) -> None:
    options = drivers.find_driver(name).options_class
    for key in {"serial", "wrench_serial"} & options.model_fields.keys():
        with pytest.raises(ValidationError) as caught:
            options.model_validate({key: serial})
        (problem,) = [one["msg"] for one in caught.value.errors() if one["loc"] == (key,)]
        assert "1 to 64 printable ASCII characters" in problem


def test_entry_points_add_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("mine", "palpate_gateway.virtual.finger:VirtualFinger", drivers.ENTRY_POINTS)

    def fake(**query: Any) -> EntryPoints:
        return EntryPoints([point]).select(**query)

    monkeypatch.setattr(drivers, "entry_points", fake)
    assert "mine" in drivers.driver_names()
    assert drivers.load_driver("mine") is VirtualFinger


@pytest.mark.parametrize(
    ("target", "error", "message"),
    [
        ("palpate_gateway.nothing:X", ConfigError, "module 'palpate_gateway.nothing'"),
        ("palpate_gateway.virtual.finger:Nothing", ConfigError, "no device class"),
        ("palpate_gateway.virtual.finger:math", ConfigError, "no device class"),
    ],
)
def test_broken_table_entry(
    monkeypatch: pytest.MonkeyPatch, target: str, error: type[Exception], message: str
) -> None:
    monkeypatch.setitem(drivers.DRIVERS, "broken", target)
    with pytest.raises(error, match=message):
        drivers.load_driver("broken")


@pytest.mark.parametrize("package", ["package_that_is_not_there", "driver_that"])
def test_missing_extra_gives_the_install_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str
) -> None:
    (tmp_path / "driver_that_needs_more.py").write_text(f"import {package}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(drivers.DRIVERS, "more", "driver_that_needs_more:X")
    with pytest.raises(MissingExtraError, match=rf"{package}.*palpate\[gateway\]"):
        drivers.load_driver("more")


def test_table_is_lazy() -> None:
    import subprocess

    code = (
        "import sys, palpate_gateway.drivers; "
        "print('palpate_gateway.virtual.finger' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
