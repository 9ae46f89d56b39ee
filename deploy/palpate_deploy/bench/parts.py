"""The services and the client of a benchmark, processes of their own.

``python -m palpate_deploy.bench.parts SERVICE PROFILE`` is a service as a station runs it, with the
benchmark's device in the gateway's driver table. ``... client ENDPOINT STATION OUT DELIVERY TOPIC``
is a robot's client, which notes the age of every estimate of a topic.
"""

from __future__ import annotations

import os
import select
import sys
import time
from pathlib import Path

from palpate.messages import StageTimings
from palpate_deploy.bench.harness import (
    STAGES,
    dropped_by,
    equal_terms,
    received,
    stop_on_sigterm,
    write_rows,
)

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


def client(endpoint: str, station: str, out: Path, delivery: str, topic: str) -> None:
    """Take estimates until ``SIGTERM``; then write sensor, sequence, stamp and arrival of each.

    ``delivery`` is ``newest``, as a robot's controller does, or ``queue`` to count what arrives.
    """
    from palpate.bus import Delivery, Session
    from palpate.bus.attachments import timings_of
    from palpate.bus.topics import TOPICS
    from palpate.config import LinkConfig

    stop = stop_on_sigterm()
    sensors: list[str] = []
    rows: list[tuple[int, ...]] = []
    timings: list[bytes] = []
    with Session.open(LinkConfig(connect=(endpoint,)), station=station) as session:
        stream = session.subscriber(TOPICS[topic], delivery=Delivery(delivery))
        with session.presence("client", instance="client") as presence:
            equal_terms()
            presence.ready()
            for got in received(stream, stop):
                now_ns = time.monotonic_ns()  # the client has the decoded estimate
                source = got.message.source
                rows.append((source.sequence, source.monotonic_ns, now_ns))
                timings.append(got.attachment)
                sensors.append(got.sensor)
        dropped = dropped_by(stream)
    full = [row + _stages_ns(timings_of(timing)) for row, timing in zip(rows, timings, strict=True)]
    write_rows(out, sensors, full, dropped=dropped, columns=3 + len(STAGES))


def _stages_ns(timings: StageTimings | None) -> tuple[int, ...]:
    values = (getattr(timings, f"{stage}_s", None) for stage in STAGES)
    return tuple(-1 if value is None else round(value * 1e9) for value in values)


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(sys.argv[2], sys.argv[3], Path(sys.argv[4]), sys.argv[5], sys.argv[6])
    else:
        service(sys.argv[1], sys.argv[2])
