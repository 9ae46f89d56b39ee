"""A gateway that stood still passes nothing off as fresh that had to wait for it.

The devices measure the time, so that each message tells when it was taken.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import pytest

from palpate import clock
from palpate.bus import Delivery, ReceivedMessage
from palpate.bus.topics import ELECTRODES, WRENCH
from palpate.errors import StaleError
from palpate.messages import ElectrodeFrame, WrenchFrame
from palpate_gateway.emulators.biotac_bridge import BiotacBridgeEmulator
from palpate_gateway.emulators.emulator import HostTimed
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.robotous import RobotousSerialEmulator

PATIENCE_S = 20.0
STOPPED_S = 1.5
WAITED_S = 0.5
"""What is published this long after it was taken [s] has waited for the gateway to go on."""

TOO_NEW_S = 0.25
"""No stamp is newer than the truth by more [s]; a starved machine may read so late, and a gateway
that takes the time of reading for that of the sample would be wrong by up to ``STOPPED_S``."""

GATEWAY = """
import json, signal, sys, threading
from palpate_gateway.service import node
from palpate_gateway.config import GatewayConfig
from palpate.config import LinkConfig, parse_config
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
values, connect = json.loads(sys.argv[1]), sys.argv[2]
config = parse_config(GatewayConfig, values, where="test")
node.run(config, LinkConfig(connect=(connect,), wait_for_router_s=60.0), "lab", stop)
"""


class Now(HostTimed):
    """Wrenches and counts that tell the host's monotonic time at which they were felt."""

    def __init__(self) -> None:
        self.base_s = time.monotonic()
        self.late_s = 0.0
        """How far the emulator has fallen behind [s]: it does not make up for long pauses."""

    def since_s(self, t: float) -> float:
        """What is measured at a time of the emulator's clock [s]."""
        now_s = t + self.lead_s
        self.late_s = max(self.late_s, time.monotonic() - now_s)
        return now_s - self.base_s

    def wrench(self, message: WrenchFrame) -> float:
        """When it was felt [s]."""
        return self.base_s + float(message.torque[0])

    def frame(self, message: ElectrodeFrame) -> float:
        """When its first slots were sampled [s]."""
        low, high = int(message.electrodes[0]), int(message.electrodes[1])
        return self.base_s + 1e-3 * (low + 1024 * high)


class NowWrench(Now):
    def __call__(self, t: float) -> Sequence[float]:
        return (0.0, 0.0, 1.0, self.since_s(t), 0.0, 0.0)


class NowCounts(Now):
    def __call__(self, t: float, finger: int) -> Sequence[int]:
        since_ms = int(1e3 * self.since_s(t))
        return [since_ms % 1024, since_ms // 1024, *(3000,) * 17, 2400, 2050, 1900, 2040]


@pytest.fixture
def running(bus: Any) -> Iterator[tuple[subprocess.Popen[bytes], dict[str, Now]]]:
    """A gateway in a process of its own, and what its sensors measure."""
    kms, rft, biotac = NowWrench(), NowWrench(), NowCounts()
    with ExitStack() as stack:
        first = stack.enter_context(Kms40Emulator(kms))
        second = stack.enter_context(RobotousSerialEmulator(rft))
        third = stack.enter_context(BiotacBridgeEmulator(fingers=1, counts=biotac, hello_s=0.2))
        host, _, port = first.address.partition(":")
        sensors = [
            ("tcp", "wrench_kms40", {"host": host, "port": int(port)}),
            ("line", "wrench_robotous", {"port": second.address, "rate_hz": 200}),
            ("finger", "biotac_bridge", {"line": third.address}),
        ]
        values = {
            "sensors": [dict(zip(("name", "driver", "options"), s, strict=True)) for s in sensors]
        }
        process = subprocess.Popen(
            [sys.executable, "-c", GATEWAY, json.dumps(values), bus.link.connect[0]]
        )
        try:
            yield process, {"tcp": kms, "line": rft, "finger": biotac}
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait(PATIENCE_S)


def test_what_waited_is_published_with_its_true_time(
    bus: Any, running: tuple[subprocess.Popen[bytes], dict[str, Now]]
) -> None:
    process, sources = running
    queues = {
        name: bus.session.subscriber(topic, sensor=name, delivery=Delivery.QUEUE)
        for name, topic in (("tcp", WRENCH), ("line", WRENCH), ("finger", ELECTRODES))
    }
    newest = bus.session.subscriber(ELECTRODES, sensor="finger", delivery=Delivery.NEWEST)
    for queue in queues.values():
        for _ in range(50):
            queue.next(timeout_s=PATIENCE_S)
    process.send_signal(signal.SIGSTOP)
    stopped_s = time.monotonic()
    time.sleep(STOPPED_S)
    with pytest.raises(StaleError, match=r"is \d\.\d+ s old, 0\.05 s is allowed"):
        newest.latest(0.05)
    process.send_signal(signal.SIGCONT)
    went_on_s = time.monotonic()
    for name, queue in queues.items():
        source = sources[name]
        told = source.frame if name == "finger" else source.wrench
        if source.late_s > WAITED_S:
            pytest.skip("this machine stood still itself, and the emulated devices with it")
        waited = _check(queue, source, told, stopped_s, went_on_s)
        assert waited >= 5, f"{name}: {waited} messages had waited"


def _check(
    queue: Any, source: Now, told: Callable[[Any], float], stopped_s: float, went_on_s: float
) -> int:
    """Read until it is live again; the number of messages that had waited while it stood still."""
    waited, fresh = 0, 0
    while fresh < 20:
        received: ReceivedMessage[Any] = queue.next(timeout_s=PATIENCE_S)
        stamp = received.message.stamp
        taken_s = told(received.message)
        # What an emulator sends late it has measured before: no gateway can know that.
        assert 1e-9 * stamp.monotonic_ns - taken_s < TOO_NEW_S + source.late_s
        came_s = 1e-9 * received.received_monotonic_ns
        if taken_s > stopped_s and came_s - taken_s > WAITED_S:
            waited += 1
            # By its stamp a consumer sees that it is old.
            assert clock.age_s(stamp, monotonic_ns=received.received_monotonic_ns) > TOO_NEW_S
        fresh += taken_s > went_on_s
    return waited
