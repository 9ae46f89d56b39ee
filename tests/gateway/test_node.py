"""The gateway as a process with live sensors: in a thread, on a real bus over loopback."""

from __future__ import annotations

import re
import socket
import sys
import threading
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Delivery
from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH
from palpate.config import LinkConfig, parse_config
from palpate.errors import ConfigError, DeviceLost, ErrorCode, LinkError, RemoteError
from palpate.messages import Origin, ServiceState
from palpate_gateway.config import GatewayConfig
from palpate_gateway.drivers import DRIVERS
from palpate_gateway.readings import Reading
from palpate_gateway.service import node
from palpate_gateway.virtual import finger as virtual

PATIENCE_S = 30.0


def test_live_virtual_finger(bus: Any) -> None:
    options = {"model": "formula", "seed": 1, "rate_hz": 200}
    sensor = {"name": "finger", "driver": "virtual", "options": options}
    with bus.gateway({"sensors": [sensor], "tare_frames": 20}) as running:
        electrodes = bus.session.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        wrench = bus.session.subscriber(WRENCH, delivery=Delivery.QUEUE)
        pose = bus.session.subscriber(POSE, delivery=Delivery.QUEUE)
        frames = [electrodes.next(timeout_s=PATIENCE_S).message for _ in range(60)]
        assert frames[-1].tare_id != 0
        assert frames[-1].stamp.origin is Origin.SIMULATED
        sequences = [frame.stamp.sequence for frame in frames]
        assert sequences == list(range(sequences[0], sequences[0] + 60))
        assert wrench.next(timeout_s=PATIENCE_S).sensor == "finger"
        assert pose.next(timeout_s=PATIENCE_S).message.indenter == "sphere_14mm"

        bus.until(lambda: [a for a in bus.session.alive() if a.service == "gateway" and a.ready])
        now = bus.state(ServiceState.READY)
        assert now.sensors == ("finger",)
        assert now.counters["frames_published"] >= 60
        assert now.counters["tares"] == 1

        known = bus.ask_tare("finger", tare_id=frames[-1].tare_id)
        assert known.tare_id == frames[-1].tare_id
        with pytest.raises(RemoteError, match="tare 77 is not known") as caught:
            bus.ask_tare("finger", tare_id=77)
        assert caught.value.code is ErrorCode.NOT_FOUND
        running.stop.set()
        running.thread.join(PATIENCE_S)
        assert running.error is None
        bus.until(lambda: not [a for a in bus.session.alive() if a.service == "gateway"])


def test_live_twin_publishes_the_true_field(bus: Any, tape_path: Callable[..., Path]) -> None:
    options = {"tape": str(tape_path()), "rate_hz": 200}
    values = {"sensors": [{"driver": "virtual", "options": options}], "tare_frames": 20}
    with bus.gateway(values):
        fields = bus.session.subscriber(FIELD_TRUTH, delivery=Delivery.QUEUE)
        first, second = (fields.next(timeout_s=PATIENCE_S).message for _ in range(2))
    assert first.sensor_serial == "VIRTUAL-unit1-S0"
    assert first.mesh_sha256 == bytes(range(32))
    assert first.displacement.shape == (9, 3)
    assert second.stamp.sequence == first.stamp.sequence + 1
    assert second.stamp.device_tick == first.stamp.device_tick + 10
    assert second.stamp.origin is Origin.SIMULATED


def test_a_finger_that_restarts_is_opened_again(bus: Any, tape_path: Callable[..., Path]) -> None:
    options = {
        "tape": str(tape_path()),
        "rate_hz": 200,
        "untouched_s": 60,
        "faults": [{"kind": "restart", "at_s": 0.5}],
    }
    with bus.gateway({"sensors": [{"driver": "virtual", "options": options}]}):
        electrodes = bus.session.subscriber(ELECTRODES, delivery=Delivery.QUEUE)
        frames = [electrodes.next(timeout_s=PATIENCE_S).message for _ in range(150)]
        now = bus.until(lambda: bus.status())
    ticks = [frame.stamp.device_tick for frame in frames]
    again = ticks.index(0, 1) if ticks[0] == 0 else ticks.index(0)
    assert ticks[again - 1] == 99
    assert ticks[again:] == list(range(len(ticks) - again))
    sequences = [frame.stamp.sequence for frame in frames]
    assert sequences == list(range(sequences[0], sequences[0] + 150))
    assert len({frame.sensor_serial for frame in frames}) == 1
    assert now.counters["device_lost"] == 1
    assert now.counters["fault_restart_frames"] == 1


def test_a_silent_finger_is_told_at_once_and_read_on(
    bus: Any, tape_path: Callable[..., Path]
) -> None:
    options = {
        "tape": str(tape_path()),
        "rate_hz": 200,
        "untouched_s": 60,
        "faults": [{"kind": "silence", "at_s": 1.0, "for_s": 1.0}],
    }
    with bus.gateway({"sensors": [{"driver": "virtual", "options": options}]}):
        now = bus.state(ServiceState.DEGRADED)
        assert now.last_error is not None
        assert re.fullmatch(r"sensor 'finger' is lost: silent for \d+ ms", now.last_error.message)
        now = bus.state(ServiceState.READY)
    assert now.counters["silences"] >= 1  # a starved machine may be silent once more
    assert now.counters.get("device_lost", 0) == 0
    assert now.counters["fault_silence_frames"] == 200


def test_tare_on_demand(bus: Any) -> None:
    options = {"rate_hz": 200, "untouched_s": 60}
    values = {"sensors": [{"driver": "virtual", "options": options}], "tare_frames": 20}
    with bus.gateway(values):
        tares = bus.session.subscriber(TARE, delivery=Delivery.QUEUE)
        bus.state(ServiceState.READY)
        asked = bus.ask_tare("finger", frames=10)
        assert asked.frames_averaged == 10
        seen = bus.until(lambda: tares.next(timeout_s=PATIENCE_S).message.tare_id == asked.tare_id)
        assert seen


def test_damaged_recording_does_not_end_the_other_sensor(bus: Any, tmp_path: Path) -> None:
    (tmp_path / "empty.btd").write_bytes(b"")
    values = {
        "sensors": [
            {"name": "broken", "driver": "text_log", "options": {"path": tmp_path / "empty.btd"}},
            {"name": "good", "driver": "virtual", "options": {"rate_hz": 200}},
        ]
    }
    with bus.gateway(values):
        frames = bus.session.subscriber(ELECTRODES, sensor="good", delivery=Delivery.QUEUE)
        now = bus.state(ServiceState.DEGRADED)
        assert now.last_error is not None
        assert "the file is empty" in now.last_error.message
        for _ in range(20):
            frames.next(timeout_s=PATIENCE_S)
        now = bus.until(lambda: bus.status())
        assert now.counters["good.frames_published"] >= 20
        assert now.counters["broken.frames_published"] == 0


class Flaky(virtual.VirtualFinger):
    """A virtual finger whose cable comes loose after 30 frames, and that cannot be opened once."""

    opened = 0

    def _open(self) -> Any:
        Flaky.opened += 1
        if Flaky.opened == 2:
            raise DeviceLost("the port is gone", remedy="plug it in")
        return super()._open()

    def _read(self, timeout_s: float) -> list[Reading]:
        if Flaky.opened == 1 and self.counters["frames"] >= 30:
            raise DeviceLost("the cable came loose", remedy="plug it in")
        return super()._read(timeout_s)


def test_lost_device_is_opened_again(bus: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DRIVERS, "flaky", "flaky_driver:Flaky")
    module = types.ModuleType("flaky_driver")
    module.Flaky = Flaky  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "flaky_driver", module)
    Flaky.opened = 0
    values = {
        "sensors": [
            {"name": "flaky", "driver": "flaky", "options": {"rate_hz": 200}},
            {"name": "good", "driver": "virtual", "options": {"rate_hz": 200}},
        ]
    }
    frames = bus.session.subscriber(ELECTRODES, sensor="flaky", delivery=Delivery.QUEUE)
    others = bus.session.subscriber(ELECTRODES, sensor="good", delivery=Delivery.QUEUE)
    with bus.gateway(values):
        sequences = [frames.next(timeout_s=PATIENCE_S).message.stamp.sequence for _ in range(60)]
        assert sequences == list(range(sequences[0], sequences[0] + 60))
        good = [others.next(timeout_s=PATIENCE_S).message.stamp.sequence for _ in range(60)]
        assert good == list(range(good[0], good[0] + 60))
        now = bus.state(ServiceState.READY)
    assert now.counters["flaky.device_lost"] == 1
    assert now.last_error is not None
    assert "device_lost" not in {k.removeprefix("good.") for k in now.counters}


def test_defect_of_a_driver_ends_the_process(bus: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: virtual.VirtualFinger, timeout_s: float) -> list[Reading]:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(virtual.VirtualFinger, "_read", broken)
    with pytest.raises(ZeroDivisionError):
        node.run(GatewayConfig(), bus.link, "lab", threading.Event())


def test_wrong_option_is_told_before_the_bus_is_joined() -> None:
    config = parse_config(
        GatewayConfig, {"sensors": [{"name": "a", "options": {"sed": 1}}]}, where="test"
    )
    with pytest.raises(ConfigError, match="options of sensor 'a': unknown key 'sed'"):
        node.run(config, LinkConfig(), "lab", threading.Event())


@pytest.mark.parametrize(
    ("driver", "options", "other"),
    [
        ("wrench_rdt", {"product": "ati_axia"}, {"host": "192.168.1.2"}),
        ("wrench_kms40", {"host": "a"}, {"host": "b"}),
        ("wrench_bota", {"port": "/dev/a"}, {"port": "/dev/b"}),
        ("wrench_robotous", {"port": "/dev/a"}, {"port": "/dev/b"}),
        (
            "wrench_robotous",
            {"interface": "virtual", "channel": "a"},
            {"first_id": 3, "second_id": 4},
        ),
    ],
)
def test_two_sensors_at_one_address_are_refused(
    driver: str, options: dict[str, Any], other: dict[str, Any]
) -> None:
    def run(more: dict[str, Any]) -> None:
        sensors = [
            {"name": "a", "driver": driver, "options": options},
            {"name": "b", "driver": driver, "options": options | more},
        ]
        config = parse_config(GatewayConfig, {"sensors": sensors}, where="test")
        link = LinkConfig(connect=("tcp/127.0.0.1:9",), wait_for_router_s=0.0)
        node.run(config, link, "lab", threading.Event())

    with pytest.raises(ConfigError, match="sensors 'a' and 'b' are both at "):
        run({})
    with pytest.raises(LinkError):
        run(other)


def test_no_router() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = LinkConfig(connect=(f"tcp/127.0.0.1:{port}",), wait_for_router_s=0.2)
    with pytest.raises(LinkError, match=f"no router at tcp/127.0.0.1:{port}"):
        node.run(GatewayConfig(), link, "lab", threading.Event())


def test_a_gateway_that_waits_for_a_service_can_be_stopped(bus: Any) -> None:
    values = {"sensors": [{"driver": "virtual"}], "wait_for": ["features"]}
    with bus.gateway(values) as running:
        bus.until(bus.status)
    assert running.error is None
