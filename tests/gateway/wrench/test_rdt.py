"""The RDT driver against sensors in software, over UDP and HTTP on loopback."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
import pytest
from tests.gateway.rdt_sensors import PRODUCTS, device_at, running

from palpate.config import parse_config
from palpate.errors import ConfigError, DeviceError
from palpate_gateway.emulators.rdt import RdtEmulator
from palpate_gateway.wrench.rdt import RdtOptions

fakes: Any = importlib.import_module("wrench_fakes")


@pytest.mark.parametrize("product", PRODUCTS)
def test_wrenches_are_those_that_were_felt(product: str) -> None:
    with running(product) as (emulator, device):
        readings = fakes.read_until(device, lambda readings: len(readings) >= 300)
        assert emulator.rate_hz == device.info.rate_hz == 1000.0
        assert device.identity.serial == emulator.address
    assert max(r.force[0] for r in readings) - min(r.force[0] for r in readings) > 0.1
    assert not any(r.overload for r in readings)
    counters = device.counters
    assert counters["samples"] == len(readings) == counters["records"]
    for name in ("lost_samples", "bad_lengths", "invalid_samples"):
        assert not counters.get(name)


@pytest.mark.parametrize("product", ["ati_net_ft", "onrobot_hex"])
def test_time_is_the_devices_counter(product: str) -> None:
    with running(product) as (_, device):
        readings = fakes.take(device, 50)
    times = np.array([r.time_s for r in readings])
    assert 0.0 < times[0] < fakes.PATIENCE_S
    np.testing.assert_allclose(np.diff(times), 1e-3, atol=1e-9)


def test_the_page_tells_what_a_count_is_worth() -> None:
    units = (("lbf", 4.4482216152605), ("N-mm", 1e-3))
    with (
        RdtEmulator("netft", fakes.wave, counts_per=(2e5, 3e2), units=units) as emulator,
        device_at(emulator) as device,
    ):
        fakes.read_until(device, lambda readings: len(readings) >= 50)


def test_or_the_options_do() -> None:
    with RdtEmulator("netft", fakes.wave, counts_per=(2e5, 3e5)) as emulator:
        with device_at(emulator, counts_per_n=2e5, counts_per_n_m=3e5, http_port=1) as device:
            fakes.read_until(device, lambda readings: len(readings) >= 50)


def test_what_else_the_page_tells() -> None:
    with RdtEmulator("axia", fakes.wave, counter_hz=4000.0) as emulator:
        more = b"<cfgcalsn>FT12345</cfgcalsn><runrate>4000</runrate><comrdtrate>500</comrdtrate>"
        assert emulator.page.content is not None
        emulator.page.content = emulator.page.content.replace(b"</netft>", more + b"</netft>")
        with device_at(emulator, "ati_axia") as device:
            assert device.identity.serial == "FT12345"
            readings = fakes.take(device, 20)
            assert device.counters["rate_not_as_configured"] == 1
        np.testing.assert_allclose(np.diff([r.time_s for r in readings]), 1e-3, atol=1e-9)
        # Where the counter's rate is not known, the host's clock counts.
        with device_at(emulator, "ati_axia", counter_hz=0.0) as device:
            assert abs(fakes.take(device, 1)[0].time_s - time.monotonic()) < fakes.PATIENCE_S


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "404"),
        (b"hello", "not XML"),
        (b"<netft><cfgcpf>1</cfgcpf></netft>", "nothing in the tags cfgcpt, scfgfu, scfgtu"),
        (b" " * (2 << 20), "more than 1048576 bytes"),
    ],
)
def test_a_wrong_page_is_named(content: bytes | None, message: str) -> None:
    with RdtEmulator("netft", fakes.wave) as emulator:
        emulator.page.content = content
        with pytest.raises(DeviceError, match=message):
            device_at(emulator).open()


def test_no_page_no_device() -> None:
    with RdtEmulator("netft", fakes.wave) as emulator:
        device = device_at(emulator)
    with pytest.raises(DeviceError, match=r"netftapi2\.xml: .*refused.* -> open this address"):
        device.open()
    device.close()


def test_a_hex_is_set_up() -> None:
    with running("onrobot_hex", rate_hz=250.0, filter_code=6) as (emulator, device):
        assert emulator.rate_hz == 250.0
        assert emulator.filter == 6
        assert device.info.rate_hz == 250.0
        assert [command for command, _ in emulator.requests[:4]] == [0x00, 0x81, 0x82, 0x02]
        np.testing.assert_allclose(
            np.diff([r.time_s for r in fakes.take(device, 20)]), 4e-3, atol=1e-9
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "key 'product' is missing"),
        ({"product": "onrobot_hex", "rate_hz": 300.0}, "not 1000 divided by a whole number"),
        ({"product": "onrobot_hex", "rate_hz": 2.0}, "not 1000 divided by a whole number"),
        ({"product": "ati_axia", "filter_code": 2}, "options of the onrobot_hex only"),
        ({"product": "ati_axia", "counts_per_n": 2.0}, "must be given together"),
    ],
)
def test_options_that_do_not_fit(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(RdtOptions, options, where="test")


@pytest.mark.parametrize("product", ["ati_net_ft", "onrobot_hex"])
def test_zero_is_the_devices_own(product: str) -> None:
    with running(product, fakes.constant) as (_, device):
        np.testing.assert_allclose(fakes.take(device, 1)[0].force, fakes.CONSTANT[:3], atol=1e-6)
        device.zero()
        for reading in fakes.take(device, 20):
            np.testing.assert_array_equal(reading.force, 0.0)
            np.testing.assert_array_equal(reading.torque, 0.0)


def test_zero_at_the_start() -> None:
    with running(source=fakes.constant, zero_at_start=True) as (_, device):
        np.testing.assert_array_equal(fakes.take(device, 1)[0].force, 0.0)


def test_a_zero_that_is_not_heard_is_asked_for_again_and_then_refused() -> None:
    with running(source=fakes.constant) as (emulator, device):
        emulator.inject("deaf")
        device.zero()
        np.testing.assert_array_equal(fakes.take(device, 1)[0].force, 0.0)
    with running(source=fakes.constant) as (emulator, device):
        emulator.inject("deaf", 100.0)
        with pytest.raises(DeviceError, match="3 bias requests did not change"):
            device.zero()
