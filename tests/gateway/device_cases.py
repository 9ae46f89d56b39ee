"""Every driver with the device that it reads, in software: what the contract and the faults run on.

A case starts an emulator at an address of its own, gives the driver's options for it, and judges
what comes out by what the emulated device measured.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.gateway.scenes import COARSE, FINE, ramp

from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.emulators.emulator import Emulator

Options = dict[str, Any]

_channels = itertools.count()

_BENCH: Options = {
    "indenter": "sphere_7mm",
    "base_sensor": {"position_m": (0.4, 0.0, 0.1), "orientation_wxyz": (0.0, 1.0, 0.0, 0.0)},
    "flange_indenter": {"position_m": (0.0, 0.0, 0.12), "orientation_wxyz": (1.0, 0.0, 0.0, 0.0)},
}
"""Where the emulated robot's finger and tool are."""


@dataclass(frozen=True, slots=True)
class Case:
    """One driver and one kind of device that it reads.

    Attributes:
        name: Driver and kind.
        driver: Name in the driver table.
        emulate: The device in software, not started; for drivers of hardware.
        options: The driver's options for a started emulator.
        file: Options for a file or a simulation; given fixtures' makers and a folder.
        nowhere: Options of an address at which nothing is.
        names: What the error about it must name.
        tolerance: Of wrenches, see ``was_felt``.
        gone: A fault that takes the device away so that it shows.
        frames: Frames of a finite source.
        samples: What a finite source counts of a frame.
        packages: What must be installed.
    """

    name: str
    driver: str
    emulate: Callable[[], Emulator] | None = None
    options: Callable[[Any], Options] = lambda _: {}
    file: Callable[[Any, Path], Options] | None = None
    nowhere: Options = field(default_factory=dict)
    names: str = ""
    tolerance: tuple[float, ...] = FINE
    gone: str = "unplug"
    frames: int = 0
    samples: int = 44
    packages: tuple[str, ...] = ()

    def device(self, emulator: Emulator) -> Device:
        """A closed device at a running emulator."""
        return make_device(self.driver, self.options(emulator))


def _class(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"palpate_gateway.emulators.{module}"), name)


def _at(emulator: Any) -> Options:
    host, _, port = emulator.address.partition(":")
    return {"host": host, "port": int(port)}


def _pose(emulator: Any) -> Options:
    return {"robot": emulator.robot, "connect": emulator.address, **_BENCH}


def _ros_hand(kind: str) -> Case:
    message = {"all": "sr_robot_msgs/BiotacAll", "hand": "biotac_sensors/BioTacHand"}[kind]
    topic: Options = {"topic": "/hand/tactile", "message": message}
    return Case(
        f"ros_biotac-{kind}",
        "ros_biotac",
        lambda: _class("ros:RosHandEmulator")(whole_frames=kind == "hand"),
        # An untouched finger of constant counts repeats its readings.
        lambda emulator: {**topic, "connect": emulator.address, "repeats": "keep"},
        nowhere={**topic, "connect": "tcp/127.0.0.1:9", "timeout_s": 0.2},
        names="127.0.0.1:9",
        gone="absent",
        packages=("rosbags",),
    )


def _ros_bag(make: Any, folder: Path) -> Options:
    return {"path": make("ros_bag")(folder / "run.bag", 120), "wrench_topic": "/ft"}


def _pose_table(make: Any, folder: Path) -> Options:
    path = folder / "poses.csv"
    rows = ["time_s,x_m,y_m,z_m,qw,qx,qy,qz"]
    rows += [f"{0.004 * k},0.4,0.001,{0.2 + 1e-4 * k},0,1,0,0" for k in range(120)]
    path.write_text("\n".join(rows) + "\n", encoding="ascii")
    return {"path": path, **_BENCH}


def _rdt(product: str, kind: str) -> Case:
    def options(emulator: Any) -> Options:
        page = {} if kind == "hex" else {"http_port": emulator.page.port}
        return {"product": product, "rate_hz": emulator.rate_hz, **_at(emulator), **page}

    nowhere = {"product": product, "host": "127.0.0.1", "port": 9, "http_port": 9, "rate_hz": 100.0}
    return Case(
        f"wrench_rdt-{product}",
        "wrench_rdt",
        lambda: _class("rdt:RdtEmulator")(kind, ramp),
        options,
        nowhere=nowhere,
        names="127.0.0.1",
    )


def _serial(name: str, driver: str, make: Callable[[], Emulator], key: str, **more: Any) -> Case:
    options = {key: value for key, value in more.items() if key not in ("tolerance",)}
    return Case(
        name,
        driver,
        make,
        lambda emulator: {key: emulator.address, **options},
        nowhere={key: "/dev/no-such-line", **options},
        names="/dev/no-such-line",
        tolerance=more.get("tolerance", FINE),
        packages=("serial",),
    )


def _can_channel() -> str:
    return f"case-{next(_channels)}"


def _on_can(emulator: Any) -> Options:
    interface, _, channel = emulator.address.partition(":")
    return {"interface": interface, "channel": channel}


CASES: tuple[Case, ...] = (
    Case(
        "virtual-formula",
        "virtual",
        file=lambda _, folder: {"model": "formula", "realtime": False, "frames": 120},
        nowhere={"tape": "no/such/tape.npz"},
        names="no/such/tape.npz",
        frames=120,
    ),
    Case(
        "virtual-tape",
        "virtual",
        file=lambda make, folder: {
            "tape": str(make("tape_path")()), "realtime": False, "frames": 120, "seed": 3,
        },
        nowhere={"tape": "no/such/tape.npz"},
        names="no/such/tape.npz",
        frames=120,
    ),
    Case(
        "virtual-live",
        "virtual",
        file=lambda _, folder: {"model": "formula", "rate_hz": 1000, "frames": 120},
        nowhere={"tape": "no/such/tape.npz"},
        names="no/such/tape.npz",
        frames=120,
    ),
    Case(
        "text_log",
        "text_log",
        file=lambda make, folder: {"path": make("log")(120).write(folder / "a.btd.gz", gz=True)},
        nowhere={"path": "no/such/log.btd"},
        names="no/such/log.btd",
        frames=120,
    ),
    Case(
        "record",
        "record",
        file=lambda make, folder: {"path": make("record")(120)},
        nowhere={"path": "no/such/run.mcap"},
        names="no/such/run.mcap",
        frames=120,
    ),
    Case(
        "biotac_can",
        "biotac_can",
        lambda: _class("biotac_can:BiotacCanEmulator")("virtual", _can_channel(), fingers=1),
        lambda emulator: {**_on_can(emulator), "fingers": 1},
        nowhere={"interface": "virtual", "channel": "nobody-is-here", "fingers": 1},
        names="nobody-is-here",
        gone="absent",
        packages=("can",),
    ),
    _serial(
        "biotac_bridge",
        "biotac_bridge",
        lambda: _class("biotac_bridge:BiotacBridgeEmulator")(fingers=1, hello_s=0.2, status_s=0.1),
        "line",
    ),
    _serial(
        "biotac_pic32", "biotac_pic32",
        lambda: _class("biotac_pic32:BiotacPic32Emulator")(), "port",
    ),
    Case(
        "wrench_kms40",
        "wrench_kms40",
        lambda: _class("kms40:Kms40Emulator")(ramp),
        lambda emulator: {**_at(emulator), "flags_every_s": 0.1},
        nowhere={"host": "127.0.0.1", "port": 9},
        names="127.0.0.1",
    ),
    _rdt("ati_net_ft", "netft"),
    _rdt("ati_axia", "axia"),
    _rdt("schunk_ftn", "axia"),
    _rdt("onrobot_hex", "hex"),
    _serial(
        "wrench_robotous-serial",
        "wrench_robotous",
        lambda: _class("robotous:RobotousSerialEmulator")(ramp, baud=921600),
        "port",
        baud=921600,
        rate_hz=500,
        tolerance=COARSE,
    ),
    Case(
        "wrench_robotous-can",
        "wrench_robotous",
        lambda: _class("robotous:RobotousCanEmulator")(ramp, channel=_can_channel()),
        lambda emulator: {**_on_can(emulator), "rate_hz": 500},
        nowhere={"interface": "virtual", "channel": "nobody-is-here"},
        names="nobody-is-here",
        tolerance=COARSE,
        gone="silence",
        packages=("can",),
    ),
    _serial(
        "wrench_bota", "wrench_bota",
        lambda: _class("bota:BotaEmulator")(ramp, boot_s=0.05), "port",
        rate_hz=800, boot_s=0.5,
    ),
    _ros_hand("all"),
    _ros_hand("hand"),
    Case(
        "ros_wrench",
        "ros_wrench",
        lambda: _class("ros:RosWrenchEmulator")(ramp),
        lambda emulator: {"topic": "/ft/wrench", "connect": emulator.address, "rate_hz": 500},
        nowhere={"topic": "/ft/wrench", "connect": "tcp/127.0.0.1:9", "timeout_s": 0.2},
        names="127.0.0.1:9",
        gone="",
        packages=("rosbags",),
    ),
    Case(
        "ros_bag",
        "ros_bag",
        file=_ros_bag,
        nowhere={"path": "no/such/run.bag"},
        names="no/such/run.bag",
        frames=120,
        samples=1,
        packages=("rosbags",),
    ),
    Case(
        "pose_zenoh",
        "pose_zenoh",
        lambda: _class("robot:RobotEmulator")(),
        _pose,
        nowhere={"robot": "arm", "connect": "tcp/127.0.0.1:9", "timeout_s": 0.2, **_BENCH},
        names="127.0.0.1:9",
        gone="",
    ),
    Case(
        "pose_file",
        "pose_file",
        file=_pose_table,
        nowhere={"path": "no/such/poses.csv", **_BENCH},
        names="no/such/poses.csv",
        frames=120,
        samples=1,
    ),
)  # fmt: skip
"""All of them; ``test_device_contract`` checks that no driver is missing."""
