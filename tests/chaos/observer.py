"""A robot that notes all that it gets, in a process and on a host of its own.

python -m tests.chaos.observer tls/HOST:PORT CERTIFICATES OUT

Takes every estimate and frame; asks for the newest estimate a hundred times a second, as a
controller does; notes every status and token; asks the finite elements once a second. ``OUT/now``
says how things stand, five times a second. SIGTERM ends it; then ``OUT/*.npz`` and
``OUT/notes.json`` are there. Times are of the monotonic clock, which all on this host share [ns].
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate import Client, clock
from palpate.bus import Delivery, Subscriber
from palpate.bus.topics import ELECTRODES, FEATURES, STATUS, live_key
from palpate.bus.zenoh_session import open_zenoh
from palpate.client.simulations import GRACE_S, straight_path
from palpate.config import joining_link
from palpate.errors import PalpateError, RemoteError, StaleError, StreamTimeout
from palpate.messages import SimulationOutcome, SimulationRequest, Status
from palpate.process import stop_on_signals

SENSOR = "finger"
FRESH_S = 0.03
QUERY_S = 5.0
HUNG_S = QUERY_S + GRACE_S + 3.0
"""A client gives up ``GRACE_S`` after the time that it is given; what takes longer hangs [s]."""

_CONTROL_S = 0.01
_NOW_S = 0.2
_START_S = 420.0


class Robot:
    """All that is noted; ``run`` until a signal."""

    def __init__(self, endpoint: str, certificates: Path, out: Path) -> None:
        self.out = out
        self.stop = stop_on_signals()
        link = joining_link(endpoint, wait_s=_START_S, tls=certificates)
        self.client = Client(endpoint, tls=certificates, timeout_s=_START_S)
        self.watcher = open_zenoh(link, "client")
        self.rows: dict[str, list[tuple[int, ...]]] = {"features": [], "electrodes": []}
        self.statuses: list[dict[str, Any]] = []
        self.tokens: list[tuple[int, str, str, bool]] = []
        self.queries: list[tuple[float, float, str]] = []
        self.control = {"asked": 0, "fresh": 0, "too_old": 0, "negative": 0, "stale_used": 0}
        self._ready: set[str] = set()
        self._states: dict[str, str] = {}
        self._answered_ns = 0
        self._streams: dict[str, Subscriber[Any]] = {}
        self._asking: set[threading.Thread] = set()

    def run(self) -> None:
        """Note until a signal, then write."""
        session = self.client.session
        threads = []
        for topic in (FEATURES, ELECTRODES):
            stream: Subscriber[Any] = session.subscriber(
                topic, sensor=SENSOR, delivery=Delivery.QUEUE
            )
            self._streams[topic.name] = stream
            threads.append(threading.Thread(target=self._take, args=(topic.name, stream)))
        says = session.subscriber(STATUS, delivery=Delivery.QUEUE)
        threads += [
            threading.Thread(target=self._hear, args=(says,)),
            threading.Thread(target=self._control),
            threading.Thread(target=self._ask),
        ]
        watch = self.watcher.liveliness().declare_subscriber(
            live_key("lab", "*", "*", "*"), self._on_token, history=True
        )
        for thread in threads:
            thread.start()
        while not self.stop.wait(_NOW_S):
            self._tell()
        for thread in (*threads, *self._asking):
            thread.join(HUNG_S + 5.0)
        self._write()
        watch.undeclare()
        self.watcher.close()
        self.client.close()

    def _take(self, name: str, stream: Subscriber[Any]) -> None:
        rows = self.rows[name]
        while not self.stop.is_set():
            try:
                got = stream.next(0.2)
            except StreamTimeout:
                continue
            stamp = got.message.source if name == "features" else got.message.stamp
            rows.append(
                (
                    stamp.sequence,
                    stamp.device_tick,
                    stamp.monotonic_ns,
                    got.received_monotonic_ns,
                    stamp.session_id % (1 << 62),
                )
            )

    def _control(self) -> None:
        """What a controller does: act on the newest estimate, or know that there is none."""
        due_s = time.monotonic()
        while not self.stop.is_set():
            self.control["asked"] += 1
            try:
                estimate = self.client.features(SENSOR, max_age_s=FRESH_S)
            except StaleError:
                self.control["too_old"] += 1
            except PalpateError:
                self.control["too_old"] += 1
                time.sleep(0.1)
            else:
                # The clock is read after the answer: a thread may have waited for a processor.
                age_s = clock.age_s(estimate.source)
                self.control["fresh"] += 1
                self.control["negative"] += age_s < 0.0
                self.control["stale_used"] += age_s > 2 * FRESH_S
            due_s = max(due_s + _CONTROL_S, time.monotonic() - 1.0)
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _hear(self, says: Subscriber[Status]) -> None:
        while not self.stop.is_set():
            try:
                got = says.next(0.2)
            except StreamTimeout:
                continue
            status = got.message
            self._states[status.service] = status.state.name
            self.statuses.append(
                {
                    "at_ns": got.received_monotonic_ns,
                    "service": status.service,
                    "state": status.state.name,
                    "began_ns": status.monotonic_ns - round(status.uptime_s * 1e9),
                    "message": status.message,
                    "sensors": {one.name: one.state.name for one in status.sensor_states},
                    "steps": status.counters.get("wall_steps", 0),
                    "rejected": sum(
                        count for name, count in status.counters.items() if "rejected" in name
                    ),
                }
            )

    def _on_token(self, sample: zenoh.Sample) -> None:
        *_, service, _instance, what = str(sample.key_expr).split("/")
        there = sample.kind == zenoh.SampleKind.PUT
        self.tokens.append((time.monotonic_ns(), service, what, there))
        if what == "ready":
            (self._ready.add if there else self._ready.discard)(service)

    def _ask(self) -> None:
        """A small simulation each second, whether or not the last one has been answered."""
        due_s = time.monotonic()
        while not self.stop.is_set():
            self._asking = {thread for thread in self._asking if thread.is_alive()}
            thread = threading.Thread(target=self._ask_once)
            self._asking.add(thread)
            thread.start()
            due_s += 1.0
            self.stop.wait(max(0.0, due_s - time.monotonic()))

    def _ask_once(self) -> None:
        path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.0096), 2)
        request = SimulationRequest(uuid.uuid4().hex, "sphere_7mm", path)
        began_s = time.monotonic()
        try:
            reply = self.client.simulate(request, timeout_s=QUERY_S)
            said = "answered"
            if reply.outcome is not SimulationOutcome.COMPLETE:
                said = f"outcome {reply.outcome.name}"
            else:
                self._answered_ns = time.monotonic_ns()
        except RemoteError as error:
            said = f"error {error.code.name}"
        except PalpateError as error:
            said = f"error {type(error).__name__}"
        except Exception as error:
            said = f"untyped {type(error).__name__}: {error}"
        self.queries.append((began_s, time.monotonic() - began_s, said))

    def _tell(self) -> None:
        rows = self.rows["features"]
        now_ns = time.monotonic_ns()
        text = json.dumps(
            {
                "at_ns": now_ns,
                "age_s": (now_ns - rows[-1][2]) * 1e-9 if rows else None,
                "ready": sorted(self._ready),
                "states": dict(self._states),
                "answered_s": (now_ns - self._answered_ns) * 1e-9,
                "estimates": len(rows),
            }
        )
        new = self.out / "now.new"
        new.write_text(text, encoding="utf-8")
        new.replace(self.out / "now")

    def _write(self) -> None:
        for name, rows in self.rows.items():
            np.save(self.out / f"{name}.npy", np.array(rows, np.int64).reshape(-1, 5))
        counters = {name: stream.counters for name, stream in self._streams.items()}
        notes = {
            "statuses": self.statuses,
            "tokens": self.tokens,
            "queries": self.queries,
            "unanswered": sum(thread.is_alive() for thread in self._asking),
            "control": self.control,
            "counters": counters,
        }
        (self.out / "notes.json").write_text(json.dumps(notes), encoding="utf-8")


def read_now(out: Path) -> dict[str, Any]:
    """How things stand by ``OUT/now``; empty = it has not begun."""
    with contextlib.suppress(OSError, ValueError):
        found: dict[str, Any] = json.loads((out / "now").read_text(encoding="utf-8"))
        return found
    return {}


if __name__ == "__main__":
    os.makedirs(sys.argv[3], exist_ok=True)
    Robot(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])).run()
