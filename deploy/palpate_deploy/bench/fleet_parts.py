"""Processes of ``palpate bench fleet``, each on a host of its own.

``python -m palpate_deploy.bench.fleet_parts PART ...`` (see ``main``).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from palpate import clock
from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, FEATURES, TOPICS
from palpate.config import LinkConfig, TlsConfig
from palpate.errors import PalpateError, StreamTimeout
from palpate.messages import ElectrodeFrame, FeatureEstimate, Origin, SensorType, Stamp
from palpate_deploy.bench.harness import (
    KINDS,
    SERIAL,
    bench_counts,
    equal_terms,
    stop_on_sigterm,
    write_rows,
)

RATE_HZ = 100.0
_DIGEST = bytes(range(32))


def link_to(connect: str, certificates: str, *, listen: str = "") -> LinkConfig:
    """A link with the certificates of a folder; ``listen`` is an endpoint for direct links."""
    return LinkConfig(
        connect=(connect,) if connect else (),
        listen=(listen or "tls/127.0.0.1:0",),
        tls=TlsConfig.of_folder(certificates),
    )


def publisher(connect: str, certificates: str, station: str, listen: str = "") -> None:
    """Publish frames and estimates of one finger, as a gateway and a features service do."""
    stop = stop_on_sigterm()
    counts = bench_counts()
    # A gateway's certificate may not publish estimates, nor a service's frames: two sessions.
    gateway = link_to(connect, f"{certificates}/gateway", listen=listen)
    service = link_to(connect, f"{certificates}/service")
    with (
        Session.open(gateway, station=station) as first,
        Session.open(service, station=station) as second,
    ):
        frames = first.publisher(ELECTRODES, sensor="finger")
        estimates = second.publisher(FEATURES, sensor="finger")
        equal_terms()
        due_s, sequence = time.monotonic(), 0
        while not stop.is_set():
            due_s += 1.0 / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            sequence += 1
            stamp = Stamp(
                sequence=sequence,
                device_tick=sequence,
                monotonic_ns=time.monotonic_ns(),
                wall_ns=time.time_ns(),
                clock_id=clock.CLOCK_ID,
                origin=Origin.SIMULATED,
            )
            row = counts[sequence % KINDS]
            frames.put(
                ElectrodeFrame(
                    stamp,
                    SERIAL,
                    SensorType.BIOTAC,
                    row[:19],
                    int(row[19]),
                    row[20:42],
                    int(row[42]),
                    int(row[43]),
                    (1 << 44) - 1,
                    227_273,
                    1,
                )
            )
            three = row[:3].astype(np.float32)
            estimates.put(
                FeatureEstimate(stamp, SERIAL, _DIGEST, 1, True, three, three, three, three)
            )


def consumer(connect: str, certificates: str, topic: str, out: str, listen: str = "") -> None:
    """Take a stream of every station until ``SIGTERM``; then write its stamps and arrivals."""
    stop = stop_on_sigterm()
    kept: list[tuple[str, bytes, int]] = []
    link = link_to(connect, f"{certificates}/robot", listen=listen)
    with Session.open(link) as session:
        tap = session.tap([TOPICS[topic]], station="*", delivery=Delivery.QUEUE)
        equal_terms()
        Path(out).with_suffix(".up").touch()
        while not stop.is_set():
            try:
                sample = tap.next(0.1)
            except StreamTimeout:
                continue
            kept.append((sample.station, sample.payload, sample.received_monotonic_ns))
    decode = TOPICS[topic].codec.decode
    rows = []
    for _, payload, arrived_ns in kept:
        stamp = TOPICS[topic].stamp_of(decode(payload))
        assert stamp is not None
        rows.append((stamp.sequence, stamp.monotonic_ns, arrived_ns))
    write_rows(Path(out), [station for station, _, _ in kept], rows, dropped=0)


def asker(connect: str, certificates: str, station: str, seconds: str) -> None:
    """Ask for simulations one after another; a line for each event, with its time [ns]."""
    from palpate.client import Client
    from palpate.client.simulations import straight_path
    from palpate.messages import SimulationRequest

    stop = stop_on_sigterm()
    with Client(connect, station=station, tls=f"{certificates}/robot", timeout_s=10.0) as robot:
        path = straight_path((0.0, 0.0, -0.0095), (0.0, 0.0, -0.0065), 60)
        number = 0
        while not stop.is_set():
            number += 1
            request = SimulationRequest(f"ask-{number}", "sphere_medium", path)
            try:
                reply = robot.simulate(
                    request,
                    timeout_s=float(seconds),
                    on_progress=lambda one: print(
                        "progress", one.steps_done, time.monotonic_ns(), flush=True
                    ),
                )
                print("done", len(reply.steps), time.monotonic_ns(), flush=True)
            except PalpateError as error:
                print("error", type(error).__name__, time.monotonic_ns(), flush=True)


def main() -> None:
    """Run one part: its name and its arguments."""
    parts = {"publisher": publisher, "consumer": consumer, "asker": asker}
    parts[sys.argv[1]](*sys.argv[2:])  # type: ignore[operator]


if __name__ == "__main__":
    main()
