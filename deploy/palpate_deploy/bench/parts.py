"""The services and the client of a benchmark, processes of their own.

``python -m palpate_deploy.bench.parts SERVICE PROFILE`` is a service as a station runs it, with the
benchmark's device in the gateway's driver table. ``... client ENDPOINT STATION OUT DELIVERY`` is a
robot's client, which notes the age of every estimate.
"""

from __future__ import annotations

import os
import select
import sys
import time
from pathlib import Path

from palpate_deploy.bench.harness import dropped_by, received, stop_on_sigterm, write_rows

DRIVER = "palpate_deploy.bench.device:BenchDevice"


def service(name: str, profile: str) -> None:
    """Run a service of a profile, the gateway with the benchmark's driver."""
    from palpate_deploy.station.processes import run_service, service_named
    from palpate_deploy.station.profile import load_profile

    if name == "gateway":
        from palpate_gateway.drivers import DRIVERS

        DRIVERS["bench"] = DRIVER
    if "FAKETIME_TIMESTAMP_FILE" in os.environ:
        # libfaketime 0.9.10 breaks clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME), which is how
        # Python sleeps.
        time.sleep = lambda seconds: select.select([], [], [], float(seconds)) and None
    run_service(service_named(name), load_profile(profile))


def client(endpoint: str, station: str, out: Path, delivery: str) -> None:
    """Take estimates until ``SIGTERM``; then write sensor, sequence, stamp and arrival of each.

    ``delivery`` is ``newest``, as a robot's controller does, or ``queue`` to count what arrives.
    """
    from palpate.bus import Delivery, Session
    from palpate.bus.topics import FEATURES
    from palpate.config import LinkConfig

    stop = stop_on_sigterm()
    sensors: list[str] = []
    rows: list[tuple[int, int, int]] = []
    with Session.open(LinkConfig(connect=(endpoint,)), station=station) as session:
        stream = session.subscriber(FEATURES, delivery=Delivery(delivery))
        with session.presence("client", instance="client") as presence:
            presence.ready()
            for got in received(stream, stop):
                now_ns = time.monotonic_ns()  # the client has the decoded estimate
                source = got.message.source
                rows.append((source.sequence, source.monotonic_ns, now_ns))
                sensors.append(got.sensor)
        dropped = dropped_by(stream)
    write_rows(out, sensors, rows, dropped=dropped)


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(sys.argv[2], sys.argv[3], Path(sys.argv[4]), sys.argv[5])
    else:
        service(sys.argv[1], sys.argv[2])
