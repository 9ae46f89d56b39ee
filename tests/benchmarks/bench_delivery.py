"""From `put` in one process to the consumer in another: Zenoh's bare ring, ours, and a callback.

Small messages at 100 Hz over loopback TCP, in turns of half a second, so that all meet the same
disturbances by the host. The floor is a blocking `recv` on a ring of Zenoh. Run it by hand on an
otherwise idle machine:

    .venv/bin/python tests/benchmarks/bench_delivery.py --seconds 60 --out delivery.json
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate.bus import run_router
from palpate.bus.delivery import NewestQueue
from palpate.bus.ring import Alarm, Ring
from palpate.bus.zenoh_session import open_zenoh
from palpate.config import LinkConfig
from palpate.process import avoid_pauses

RATE_HZ = 100
TURN = 50
"""Messages before another way has its turn."""

WAYS = ("zenoh's ring", "our ring", "callback and queue")
_TIME_BYTES = 8
_PAYLOAD_BYTES = 208
_WARM_UP = 20
_SETTLE_S = 2.0

Take = Callable[[], bytes]


def key(way: int) -> str:
    """Key of a way of delivery."""
    return f"bench/delivery/{way}"


def send(endpoint: str, seconds: float) -> None:
    """Publish the time, paced, to one way after the other; then an end to each."""
    with open_zenoh(LinkConfig(connect=(endpoint,)), "peer") as session:
        publishers = [
            session.declare_publisher(key(way), priority=zenoh.Priority.REAL_TIME)
            for way in range(len(WAYS))
        ]
        time.sleep(_SETTLE_S)
        avoid_pauses()
        due_ns = time.monotonic_ns()
        for number in range(round(seconds * RATE_HZ)):
            due_ns += 1_000_000_000 // RATE_HZ
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            now = time.monotonic_ns().to_bytes(_TIME_BYTES, "little")
            publishers[number // TURN % len(WAYS)].put(now.ljust(_PAYLOAD_BYTES, b"\0"))
        time.sleep(0.5)
        for publisher in publishers:
            publisher.put(bytes(_PAYLOAD_BYTES))
        time.sleep(0.5)


def takers(session: zenoh.Session, alarm: Alarm) -> list[Take]:
    """For each way the function that waits for the next message."""
    bare = session.declare_subscriber(key(0), zenoh.handlers.RingChannel(1))
    ours = Ring(session, key(1), capacity=4096, alarm=alarm)
    waiting: NewestQueue[zenoh.Sample] = NewestQueue(Counter(), depth=1)
    keep = session.declare_subscriber(
        key(2), lambda sample: waiting.put(str(sample.key_expr), sample)
    )

    def from_ring() -> bytes:
        while (sample := ours.wait(0.1)) is None:
            pass
        return sample.payload.to_bytes()

    def from_queue() -> bytes:
        assert keep is not None
        while (item := waiting.get(0.1)) is None:
            pass
        return item[0].payload.to_bytes()

    return [lambda: bare.handler.recv().payload.to_bytes(), from_ring, from_queue]


def note(take: Take, latencies_ns: list[int]) -> None:
    """Note the latency of each message until the end comes."""
    while (sent_ns := int.from_bytes((payload := take())[:_TIME_BYTES], "little")) != 0:
        assert len(payload) == _PAYLOAD_BYTES
        latencies_ns.append(time.monotonic_ns() - sent_ns)


def measure(endpoint: str, seconds: float) -> dict[str, dict[str, float]]:
    """Percentiles of each way [s], and its median in terms of the bare ring's."""
    stop = threading.Event()
    router = threading.Thread(target=run_router, args=((endpoint,), stop))
    router.start()
    latencies_ns: list[list[int]] = [[] for _ in WAYS]
    with open_zenoh(LinkConfig(connect=(endpoint,)), "peer") as session, Alarm() as alarm:
        threads = [
            threading.Thread(target=note, args=pair)
            for pair in zip(takers(session, alarm), latencies_ns, strict=True)
        ]
        for thread in threads:
            thread.start()
        avoid_pauses()
        sender = [sys.executable, __file__, "--send-to", endpoint, "--seconds", str(seconds)]
        subprocess.run(sender, check=True)
        for thread in threads:
            thread.join()
    stop.set()
    router.join()
    found: dict[str, dict[str, float]] = {}
    for way, values_ns in zip(WAYS, latencies_ns, strict=True):
        p50, p99 = np.percentile(np.array(values_ns[_WARM_UP:]) * 1e-9, (50, 99))
        found[way] = {"p50_s": float(p50), "p99_s": float(p99), "messages": len(values_ns)}
    floor_s = found[WAYS[0]]["p50_s"]
    for values in found.values():
        values["p50_ratio"] = round(values["p50_s"] / floor_s, 3)
    return found


def main() -> None:
    """Measure and print; ``--send-to`` is the sender's process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--endpoint", default="tcp/127.0.0.1:7999")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--send-to", default="")
    options = parser.parse_args()
    if options.send_to:
        send(options.send_to, options.seconds)
        return
    found: dict[str, Any] = measure(options.endpoint, options.seconds)
    for way, values in found.items():
        sys.stdout.write(
            f"{way:20} p50 {values['p50_s'] * 1e6:4.0f} us, p99 {values['p99_s'] * 1e6:5.0f} us, "
            f"{values['p50_ratio']:.2f} of the floor, {values['messages']} messages\n"
        )
    if options.out is not None:
        load = {"cpus": os.cpu_count(), "load_1min": round(os.getloadavg()[0], 2)}
        options.out.write_text(json.dumps({**found, "machine": load}, indent=2) + "\n")


if __name__ == "__main__":
    main()
