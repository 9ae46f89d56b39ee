"""The station of ``palpate bench faults``, and an observer that accounts for every estimate.

No supervisor runs here: a fault must show in the processes themselves, and a process that ends
unasked is an error of the trial.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import FEATURES
from palpate.errors import LinkError, StreamTimeout
from palpate.messages import ServiceRequest
from palpate_deploy.bench.station import wait_ready
from palpate_deploy.station.host import join, private_profile, write_profile
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile

SENSOR = "finger"
RATE_HZ = 100.0
FORGED_TICK = 1 << 60
"""The device's counter in frames that a stranger sends: no device has counted so far."""

RECOVERY_S = 20.0
"""How long a trial waits for a station to recover [s]."""

_PATIENCE_S = 30.0

Figures = dict[str, float | int | str]
"""What a trial measured; names end in the unit."""


@dataclass(frozen=True, slots=True)
class EstimateAccount:
    """What an observer received in a part of a trial.

    Attributes:
        received: Estimates.
        lost: Frames of the device without an estimate, between the first and the last.
        forged: Estimates of frames that the device did not take, see ``FORGED_TICK``.
        disordered: Estimates whose frame is not newer than the one before.
        p99_s: 99th percentile of the age at arrival, from the frame's stamp [s].
        youngest_s: Least age; negative = a stamp from the future [s].
        longest_gap_s: Longest time between two arrivals [s].
    """

    received: int
    lost: int
    forged: int
    disordered: int
    p99_s: float
    youngest_s: float
    longest_gap_s: float

    def figures(self) -> Figures:
        """Those figures that every row shows."""
        return {
            "estimates": self.received,
            "lost": self.lost,
            "p99_s": self.p99_s,
            "longest_gap_s": self.longest_gap_s,
        }


def account_of(received: npt.NDArray[np.int64]) -> EstimateAccount:
    """Account for estimates: tick, stamp and arrival [ns] of each, shape ``(N, 3)``.

    Raises:
        LinkError: There are not two, between which frames could be lost.
    """
    rows = received[received[:, 0] < FORGED_TICK]
    forged = len(received) - len(rows)
    if len(rows) < 2:
        raise LinkError(
            f"{len(rows)} estimates of {SENSOR!r} in a part of a trial",
            remedy="see the logs in the folder of the run",
        )
    steps = np.diff(rows[:, 0])
    ages_s = (rows[:, 2] - rows[:, 1]) * 1e-9
    return EstimateAccount(
        len(rows),
        int(np.maximum(steps - 1, 0).sum()),
        forged,
        int((steps <= 0).sum()),
        float(np.percentile(ages_s, 99)),
        float(ages_s.min()),
        float(np.diff(rows[:, 2]).max() * 1e-9),
    )


class EstimateObserver:
    """Receives every estimate of the finger in a thread; notes tick, stamp and arrival."""

    def __init__(self, profile: Profile) -> None:
        self.session = join(profile, wait_s=_PATIENCE_S)
        self._stream = self.session.subscriber(FEATURES, sensor=SENSOR, delivery=Delivery.QUEUE)
        self._rows: list[tuple[int, int, int]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                got = self._stream.next(0.1)
            except StreamTimeout:
                continue
            source = got.message.source
            self._rows.append((source.device_tick, source.monotonic_ns, got.received_monotonic_ns))

    def mark(self) -> int:
        """Wait for the next estimate: its place in the account, where a part of a trial begins.

        Raises:
            LinkError: None comes in time.
        """
        self.wait_for_next()
        return len(self._rows) - 1

    def wait_for_next(self, *, taken_after_ns: int = 0) -> float:
        """Wait for an estimate that is not received yet, of a frame taken after a time; how long.

        Frames that the device did not take do not count, see ``FORGED_TICK``.

        Raises:
            LinkError: None comes in time.
        """
        began_s, seen = time.monotonic(), len(self._rows)
        while not any(
            tick < FORGED_TICK and taken_ns > taken_after_ns
            for tick, taken_ns, _ in self._rows[seen:]
        ):
            if time.monotonic() - began_s > _PATIENCE_S:
                raise LinkError(
                    f"no estimate of {SENSOR!r} for {_PATIENCE_S:g} s",
                    remedy="see the logs in the folder of the run",
                )
            time.sleep(0.002)
        return time.monotonic() - began_s

    def account(self, since: int) -> EstimateAccount:
        """Account for the estimates since a mark, up to the first of a frame that is taken now.

        It is waited for: where estimates stop, the end of the part would hide the hole.

        Raises:
            LinkError: None comes in time.
        """
        self.wait_for_next(taken_after_ns=time.monotonic_ns())
        return account_of(np.array(self._rows[since:], np.int64).reshape(-1, 3))

    def close(self) -> None:
        """Stop receiving and leave the bus."""
        self._stop.set()
        self._thread.join(2.0)
        self.session.close()


class FaultStation:
    """Router, features, recorder and a gateway with one finger at 100 Hz; each started once.

    Args:
        sensor: Table of the finger in the profile; None = prepared frames.
        recorder: Keys of the recorder's table.
        emulator: Arguments of ``palpate emulate``, for the device of ``sensor``.
        prefix: Words in front of a process's command, by its name, e.g. ``env NAME=VALUE``.
    """

    def __init__(
        self,
        *,
        sensor: Mapping[str, Any] | None = None,
        recorder: Mapping[str, Any] | None = None,
        emulator: Sequence[object] = (),
        prefix: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._run = FiniteRun("bench-faults")
        self._prefix = dict(prefix or {})
        table = sensor or {"driver": "bench", "options": {"rate_hz": RATE_HZ}}
        records = {"out": str(self._run.folder / "records"), "rrd": False}
        self.profile = private_profile(
            "bench",
            gateway={"sensors": [{**table, "name": SENSOR}]},
            recorder={**records, **(recorder or {})},
            log={"level": "warning"},
        )
        self._path = write_profile(self.profile, self._run.folder)
        try:
            for name in ("router", "features", "recorder"):
                self.start(name)
            wait_ready(self.profile, {"features", "recorder"})
            self.observer = EstimateObserver(self.profile)
            if emulator:
                self._run.start_module("emulator", "__main__", "emulate", *emulator)
            self.start("gateway")
            try:
                self.observer.wait_for_next()
            except LinkError:
                self.check("gateway", "features")  # what has ended says why
                raise
        except BaseException:
            self._run.stop()
            raise

    @property
    def folder(self) -> Path:
        """Folder of the run: profile, logs, records."""
        return self._run.folder

    def start(self, name: str) -> None:
        """Start a process of the station, or start it again."""
        command = [sys.executable, "-m", "palpate_deploy.bench.parts", name, str(self._path)]
        self._run.start(name, [*self._prefix.get(name, ()), *command])

    def start_client(self, name: str) -> None:
        """Start a robot's client that queues every estimate, a process of its own."""
        where = self.profile.link.connect[0], self.profile.station
        out = self.folder / f"{name}.npz"
        self._run.start_module(name, "bench.parts", "client", *where, out, "queue")

    def pid(self, name: str) -> int:
        """Process id of a process."""
        return self._run.pid(name)

    def kill(self, name: str, signal_number: int) -> None:
        """Send a signal to a process."""
        os.kill(self.pid(name), signal_number)

    def check(self, *names: str) -> None:
        """Check that processes run; see ``FiniteRun.check``."""
        self._run.check(names)

    def stop_one(self, name: str) -> int:
        """Stop a process; its exit status."""
        return self._run.stop_one(name)

    def counters(self, service: str) -> dict[str, int]:
        """What a service has counted so far."""
        status = self.observer.session.query(
            endpoints.STATUS, ServiceRequest(), service=service, timeout_s=5.0
        )
        return dict(status.counters)

    def refusals(self) -> str:
        """What the features service has counted beside the good frames, for people."""
        usual = ("frames_received", "estimates_published", "untared")
        return ", ".join(
            f"{name} {count}"
            for name, count in sorted(self.counters("features").items())
            if count and name not in usual
        )

    @contextmanager
    def fresh_session(self) -> Iterator[Session]:
        """A session that knows nothing yet, as a robot that has just been switched on."""
        with join(self.profile, wait_s=_PATIENCE_S) as session:
            yield session

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.observer.close()
        self._run.stop()


def seconds_until(true: Callable[[], bool]) -> float:
    """Time until something holds [s]; infinity if it does not within ``RECOVERY_S``."""
    began_s = time.monotonic()
    while not true():
        if time.monotonic() - began_s > RECOVERY_S:
            return float("inf")
        time.sleep(0.005)
    return time.monotonic() - began_s
