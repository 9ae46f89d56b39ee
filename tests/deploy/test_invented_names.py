"""Twenty thousand names that nobody has claimed cost a service no memory."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from palpate import clock
from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, sensor_key
from palpate.codec import ELECTRODE_FRAME
from palpate.config import LinkConfig
from palpate.errors import LinkError
from palpate.messages import (
    NO_TARE,
    PAC_SAMPLES,
    ElectrodeFrame,
    Origin,
    SensorType,
    ServiceRequest,
    Stamp,
)

NAMES = 20_000
GROWTH_MOST_BYTES = 20 << 20
"""A name that was followed cost 4 kB, all of them 82 MB; what a flood leaves behind is 2 MB."""


@pytest.fixture
def features(station: tuple[Path, LinkConfig], bundle: str) -> Iterator[subprocess.Popen[bytes]]:
    """Router and features service of a station without a gateway."""
    words = [sys.executable, "-m", "palpate_deploy", "run"]
    profile = ["--profile", str(station[0])]
    router, service = (
        subprocess.Popen([*words, name, *profile]) for name in ("router", "features")
    )
    yield service
    for process in (service, router):
        process.kill()
        process.wait()


def resident_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    (line,) = [line for line in lines if line.startswith("VmRSS:")]
    return int(line.split()[1]) * 1024


def joined(link: LinkConfig, deadline: float) -> Session:
    """A session, once there is a router and a features service that is ready."""
    while True:
        try:
            session = Session.open(link, station="test")
        except LinkError:
            assert time.monotonic() < deadline
            continue
        while not any(one.ready for one in session.alive()):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return session


@pytest.mark.slow
def test_memory_does_not_grow_with_names(
    features: subprocess.Popen[bytes], station: tuple[Path, LinkConfig]
) -> None:
    monotonic_ns, wall_ns = clock.now()
    counts = np.full(19, 3000, np.uint16)
    frame = ElectrodeFrame(
        Stamp(1, 1, monotonic_ns, wall_ns, clock.CLOCK_ID, Origin.SIMULATED),
        "INVENTED",
        SensorType.BIOTAC,
        counts,
        1500,
        np.full(PAC_SAMPLES, 2000, np.uint16),
        2100,
        1900,
        (1 << SensorType.BIOTAC.layout.slots) - 1,
        227_000,
        NO_TARE,
    )
    payload, encoding = ELECTRODE_FRAME.encode(frame), zenoh.Encoding(ELECTRODES.encoding)
    with joined(station[1], time.monotonic() + 60) as session:

        def flood(name: str, names: int) -> None:
            for number in range(names):
                session._raw.put(
                    sensor_key("test", f"{name}{number}", "electrodes"),
                    payload,
                    encoding=encoding,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
                if number % 100 == 0:
                    time.sleep(0.02)  # the service shall see most of them

        def seen() -> int:
            status = session.query(
                endpoints.STATUS, ServiceRequest(), service="features", timeout_s=20.0
            )
            return status.counters.get("unannounced", 0)

        flood("first", 1000)  # what the first messages need once
        before, began = resident_bytes(features.pid), seen()
        flood("invented", NAMES)
        deadline = time.monotonic() + 60
        while seen() - began < NAMES // 2:
            assert time.monotonic() < deadline, "the service has not seen half of the names"
            time.sleep(0.2)
        assert resident_bytes(features.pid) - before < GROWTH_MOST_BYTES
