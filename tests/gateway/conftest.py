"""Logs and records made by code, so that no test needs real data; a bus with a gateway on it."""

from __future__ import annotations

import gzip
import importlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from tests.gateway.pipelines import pushed

from palpate.bus import Delivery, Session, Tap, endpoints
from palpate.bus.topics import TOPICS, sensor_key
from palpate.config import LinkConfig, parse_config
from palpate.errors import PalpateError
from palpate.files.record_writer import RecordWriter
from palpate.files.tape import write_tape
from palpate.messages import ServiceRequest, ServiceState, Status, Tare, TareRequest
from palpate_gateway.clock.stamps import FileClock
from palpate_gateway.config import GatewayConfig
from palpate_gateway.drivers import make_device
from palpate_gateway.service import node
from palpate_gateway.service.pipeline import Pipeline

sys.path.append(str(Path(__file__).parent))  # tests import the fakes by name

ELECTRODE_IDS = list(range(17, 36))


def sequence(start: str, electrodes: list[int]) -> list[int]:
    """Channel ids of one frame, PAC first (GUI) or E1 first (Cheetah library)."""
    slow = [*electrodes, 1, 2, 3]
    if start == "pac":
        return [channel for one in slow for channel in (0, one)]
    return [channel for one in slow for channel in (one, 0)]


def value_of(channel: int, frame: int, slot: int) -> int:
    """A value from which channel and frame can be told."""
    if channel == 0:
        return 2000 + slot
    return 1000 + 20 * channel + frame % 10


@dataclass
class Log:
    """Lines of a log; tests damage them before they are written."""

    lines: list[str]
    header: list[str] = field(default_factory=list)
    end: str = "\r\n"

    def content(self) -> bytes:
        lines = [*self.header, *self.lines]
        return "".join(line + self.end for line in lines).encode("latin-1")

    def write(self, path: Path, *, gz: bool = False, cut: int = 0) -> Path:
        data = self.content()
        data = data[: len(data) - cut] if cut else data
        path.write_bytes(gzip.compress(data) if gz else data)
        return path


def make_log(
    frames: int = 12,
    *,
    style: str = "btd",
    ports: int = 3,
    port: int = 3,
    start: str = "pac",
    electrodes: list[int] | None = None,
    frame_numbers: list[int] | None = None,
) -> Log:
    """A log of one finger; the other ports are empty (value 0, parity bad)."""
    numbers = frame_numbers or list(range(100, 100 + frames))
    channels = sequence(start, electrodes or ELECTRODE_IDS)
    lines = []
    for k, number in enumerate(numbers):
        for slot, channel in enumerate(channels):
            time_s = (k * len(channels) + slot) / 4400 if style == "btd" else 0.0
            pairs = ["0 1"] * ports
            pairs[port - 1] = f"{value_of(channel, number, slot)} 0"
            lines.append(f"{time_s:.6f} {k // 4} {number} {channel} {' '.join(pairs)}")
    if style == "log":
        return Log(lines, end="\n")
    header = [
        "DataStructure: 2.0",
        "Operator: N/A",
        "Date: 2020/7/14",
        "Time: 15:38",
        "Flex Version: ,, 1.0",
        "Firmware Version: ,, 6.2",
        "Serial Number: ,,BT0123456789ABCD\x00\x10",
        "SampStructure: Pac,E1",
        "SampRate: 4400",
        "FramesInBatch: 7",
        "OtherData: ",
        "",
        "Begin File",
    ]
    return Log(lines, header)


@pytest.fixture
def log() -> Callable[..., Log]:
    """Makes logs."""
    return make_log


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Makes a palpate record of virtual fingers, as the recorder would."""

    def make(frames: int = 120, *, sensors: tuple[str, ...] = ("finger",)) -> Path:
        path = tmp_path / "run.mcap"
        with RecordWriter(path) as writer:
            for unit, sensor in enumerate(sensors):
                options = {"model": "formula", "realtime": False, "frames": frames, "unit": unit}
                device = make_device("virtual", options)
                pipeline = Pipeline(device.info)
                with device:
                    pipeline.begin(device.identity, FileClock(device.identity.serial, 10**18))
                    while readings := device.read(1.0):
                        for item in pushed(pipeline, readings, 0):
                            topic = TOPICS[item.topic]
                            assert not isinstance(item.message, bytes)
                            writer.write(
                                sensor_key("lab", sensor, topic.name),
                                topic.codec.schema,
                                topic.codec.encode(item.message),
                                log_time_ns=item.message.stamp.wall_ns,
                            )
        return path

    return make


@pytest.fixture
def tape_path(tmp_path: Path) -> Callable[..., Path]:
    """Writes tapes; options are the units' electrics."""

    def write(**electrics: float) -> Path:
        path = tmp_path / "small.npz"
        write_tape(path, importlib.import_module("tape_fakes").make_tape(**electrics))
        return path

    return write


PATIENCE_S = 20.0


class Running:
    """A gateway in a thread."""

    def __init__(self, values: dict[str, Any], link: LinkConfig, instance: str) -> None:
        self.instance = instance
        self.stop = threading.Event()
        self.error: BaseException | None = None
        self._config = parse_config(GatewayConfig, values, where="test")
        self._link = link
        # One that cannot be stopped must not keep the run of the tests from ending.
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            node.run(self._config, self._link, "lab", self.stop, instance=self.instance)
        except PalpateError as error:
            self.error = error


@dataclass
class Bus:
    """A router, a session, and what tests ask of a gateway on it."""

    link: LinkConfig
    session: Session

    @contextmanager
    def gateway(self, values: dict[str, Any], *, instance: str = "gateway") -> Iterator[Running]:
        running = Running(values, self.link, instance)
        try:
            yield running
        finally:
            running.stop.set()
            running.thread.join(PATIENCE_S)
            assert not running.thread.is_alive()

    def until(self, true: Callable[[], Any]) -> Any:
        """Poll; tests wait for facts, not for times."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            value = true()
            if value:
                return value
            time.sleep(0.02)
        raise AssertionError("it did not become true in time")

    def status(self) -> Status | None:
        try:
            return self.session.query(endpoints.STATUS, ServiceRequest(), service="gateway")
        except PalpateError:
            return None

    def statuses(self) -> list[Status]:
        """Of all gateways."""
        answers = self.session.query_all(endpoints.STATUS, ServiceRequest(), service="gateway")
        return [answer for answer in answers if isinstance(answer, Status)]

    def state(self, wanted: ServiceState) -> Status:
        """The status when it says so."""

        def reached() -> Status | None:
            now = self.status()
            return now if now is not None and now.state is wanted else None

        found = self.until(reached)
        assert isinstance(found, Status)
        return found

    def ask_tare(self, sensor: str, tare_id: int = 0, frames: int = 0) -> Tare:
        return self.session.query(
            endpoints.TARE, TareRequest(tare_id, frames), sensor=sensor, timeout_s=PATIENCE_S
        )

    @contextmanager
    def consumer(self, name: str = "features") -> Iterator[Tap]:
        """A lossless consumer that declares itself ready, as features and recorder do."""
        topics = [TOPICS[topic] for topic in ("electrodes", "wrench", "pose", "tare")]
        tap = self.session.tap(topics, delivery=Delivery.EVERY)
        with self.session.presence(name, instance=name) as presence:
            presence.ready()
            yield tap

    def take(self, tap: Tap, count: int) -> list[tuple[str, Any]]:
        """Topic and message of the next samples."""
        samples = [tap.next(timeout_s=PATIENCE_S) for _ in range(count)]
        return [(s.topic, TOPICS[s.topic].codec.decode(s.payload)) for s in samples]


@pytest.fixture
def bus(link: LinkConfig) -> Iterator[Bus]:
    """A router of our own on a free port, and a session."""
    with Session.open(link) as session:
        yield Bus(link, session)


@pytest.fixture
def ros_bag() -> Callable[..., Path]:
    """Makes a bag of ROS: path, number of frames, dialect."""
    from tests.gateway.ros_fakes import make_bag

    return make_bag
