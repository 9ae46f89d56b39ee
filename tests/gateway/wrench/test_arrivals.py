"""What force/torque drivers tell of arrivals, and whether they tell a time of their own."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.rdt import RdtEmulator
from palpate_gateway.ports.sockets import ReceivedBytes
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.kms40 import Kms40Options, WrenchKms40
from palpate_gateway.wrench.rdt import RdtOptions, WrenchRdt

MS = 1_000_000
LINE = b"F={1.0,0,0,0,0,0},4\n"


def test_samples_of_a_kms_40_that_came_together_were_taken_one_after_the_other() -> None:
    device = WrenchKms40(Kms40Options(host="127.0.0.1"))
    start_ns = 10**12
    late = device._readings(ReceivedBytes(LINE, start_ns + 100 * MS))
    five = device._readings(ReceivedBytes(5 * LINE, start_ns + 150 * MS))
    two = device._readings(ReceivedBytes(2 * LINE, start_ns + 153 * MS))
    times_ns = np.rint([1e9 * reading.time_s for reading in (*late, *five, *two)])
    # 2 ms apart, as it samples; or closer if less time has passed.
    expected_ms = [100.0, 142.0, 144.0, 146.0, 148.0, 150.0, 151.5, 153.0]
    np.testing.assert_allclose((times_ns - start_ns) / MS, expected_ms, atol=1e-3)
    # The rest of a line that was cut comes with the next.
    assert device._readings(ReceivedBytes(LINE[:5], start_ns + 154 * MS)) == []
    (whole,) = device._readings(ReceivedBytes(LINE[5:], start_ns + 156 * MS))
    assert round(1e9 * whole.time_s) == pytest.approx(start_ns + 156 * MS, abs=1000)


def test_a_kms_40_tells_no_time() -> None:
    with Kms40Emulator() as kms:
        host, _, port = kms.address.rpartition(":")
        with WrenchKms40(Kms40Options(host=host, port=int(port))) as device:
            assert not device.identity.has_clock


@pytest.mark.parametrize(("counter_hz", "tells"), [(None, True), (0.0, False)])
def test_an_rdt_sensor_tells_time_if_the_rate_of_its_counter_is_known(
    counter_hz: float | None, tells: bool
) -> None:
    with RdtEmulator("netft") as rdt:
        host, _, port = rdt.address.rpartition(":")
        options = RdtOptions(
            product="ati_net_ft",
            host=host,
            port=int(port),
            counts_per_n=1e6,
            counts_per_n_m=1e6,
            counter_hz=counter_hz,
        )
        with WrenchRdt(options) as device:
            assert device.identity.has_clock is tells
            reading = device.read(5.0)[0]
    assert isinstance(reading, WrenchReading)
    assert reading.observed is not None
    own = reading.time_s != pytest.approx(1e-9 * reading.observed.arrival_ns, abs=1e-6)
    assert own is tells
