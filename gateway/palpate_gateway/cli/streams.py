"""Streams of a device: the readings of each, their rates, and their values as text and JSON."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.errors import DeviceTimeout
from palpate.messages import FrameLayout
from palpate_gateway.device import Device, silence_of
from palpate_gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)

_A_LINE = 10
_NAMED = 6
_READ_S = 0.2


def stream_of(reading: Reading) -> str:
    """Name of the stream of a reading."""
    if isinstance(reading, RecordedMessage):
        return reading.topic
    return {
        ElectrodeReading: "electrodes",
        WrenchReading: "wrench",
        PoseReading: "pose",
        FieldReading: "field",
    }[type(reading)]


def values_of(reading: Reading) -> dict[str, Any]:
    """Values for JSON: raw counts, and SI units."""
    if isinstance(reading, RecordedMessage):
        return {"bytes": len(reading.payload), "time_s": reading.time_s}
    place: dict[str, Any] = {"tick": reading.tick, "time_s": reading.time_s}
    if isinstance(reading, ElectrodeReading):
        return place | {
            "electrodes": reading.electrodes.tolist(),
            "pdc": int(reading.pdc),
            "pac": reading.pac.tolist(),
            "tac": int(reading.tac),
            "tdc": int(reading.tdc),
            "validity": int(reading.validity),
        }
    if isinstance(reading, WrenchReading):
        return place | {
            "force_n": _rounded(reading.force),
            "torque_n_m": _rounded(reading.torque),
            "overload": reading.overload,
        }
    if isinstance(reading, PoseReading):
        return place | {
            "indenter": reading.indenter,
            "position_m": _rounded(reading.position),
            "orientation_wxyz": _rounded(reading.orientation),
            "in_contact": None if reading.in_contact is None else bool(reading.in_contact),
        }
    largest = float(np.linalg.norm(reading.displacement, axis=1).max(initial=0.0))
    return place | {"nodes": len(reading.displacement), "largest_m": largest}


def text_of(reading: Reading) -> list[str]:
    """Values as lines of text."""
    values = values_of(reading)
    if isinstance(reading, ElectrodeReading):
        return _electrode_lines(reading)
    if isinstance(reading, WrenchReading):
        lines = [
            "force  " + " ".join(f"{value:+8.3f}" for value in values["force_n"]) + " N",
            "torque " + " ".join(f"{value:+8.4f}" for value in values["torque_n_m"]) + " N m",
        ]
        return [*lines, "OVERLOAD: its range is exceeded"] if reading.overload else lines
    if isinstance(reading, PoseReading):
        return _pose_lines(reading)
    shown = {key: value for key, value in values.items() if key not in ("tick", "time_s")}
    return ["  ".join(f"{key} {value}" for key, value in shown.items())]


def _electrode_lines(reading: ElectrodeReading) -> list[str]:
    """Electrodes, ten on each line, the other channels, and the names of channels not valid."""
    counts = reading.electrodes.tolist()
    layout = FrameLayout(len(counts))
    lines = []
    for first in range(0, len(counts), _A_LINE):
        some = counts[first : first + _A_LINE]
        name = f"E{first + 1}..E{first + len(some)}"
        lines.append(f"{name:8} " + " ".join(f"{count:4d}" for count in some))
    bad = [bit for bit in range(layout.slots) if not reading.validity >> bit & 1]
    pac = [
        count
        for number, count in enumerate(reading.pac.tolist())
        if layout.first_pac_bit + number not in bad
    ]
    span = f"{min(pac)}..{max(pac)}" if pac else "none"
    lines.append(f"PDC {reading.pdc}  TAC {reading.tac}  TDC {reading.tdc}  PAC {span} [counts]")
    if bad:
        more = f" and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
        names = ", ".join(layout.bit_name(bit) for bit in bad[:_NAMED])
        lines.append(f"not valid: {names}{more}")
    return lines


def _pose_lines(reading: PoseReading) -> list[str]:
    """Position of the tip and direction of the indenter in the sensor frame."""
    x, y, z = (1e3 * float(value) for value in reading.position)
    along = "distal" if x >= 0.0 else "proximal"
    above = "dorsal" if z >= 0.0 else "ventral"
    side = "+y" if y >= 0.0 else "-y"
    w, qx, qy, qz = (float(part) for part in reading.orientation)
    presses = (2 * (qx * qz + w * qy), 2 * (qy * qz - w * qx), 1 - 2 * (qx * qx + qy * qy))
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, presses[2]))))
    contact = {None: "contact not known", True: "touches", False: "does not touch"}
    touching = None if reading.in_contact is None else bool(reading.in_contact)
    return [
        f"tip     {x:+8.2f} {y:+8.2f} {z:+8.2f} mm: {abs(x):.1f} {along}, {abs(y):.1f} to {side}, "
        f"{abs(z):.1f} {above} of the sensor frame's origin",
        "presses "
        + " ".join(f"{round(part, 3) + 0.0:+8.3f}" for part in presses)
        + f": {tilt:.1f} deg from +z",
        f"{reading.indenter}, {contact[touching]}",
    ]


def _rounded(values: Any) -> list[float]:
    """Numbers without the rounding errors of 32-bit floats."""
    return [round(float(value), 7) for value in values]


@dataclass(slots=True)
class DeviceStream:
    """One kind of reading.

    Attributes:
        last_s: Time of the last reading, by the host's monotonic clock [s].
        shown_hz: Rate before the last ``restart`` [Hz]; None = not known.
    """

    first: Reading
    last: Reading
    readings: int
    last_s: float
    _since_s: float
    _counted: int = 0
    shown_hz: float | None = None

    @property
    def rate_hz(self) -> float | None:
        """Readings each second since ``restart``; None = not known."""
        passed_s = self.last_s - self._since_s
        # The first readings are not counted: they came after a wait of unknown length.
        return self._counted / passed_s if self._counted and passed_s > 0.0 else None

    def add(self, reading: Reading, now_s: float) -> None:
        """Count a reading."""
        self.last = reading
        self.readings += 1
        if now_s > self._since_s:
            self._counted += 1
        self.last_s = now_s

    def restart(self) -> None:
        """Start a new measurement of the rate, from the last reading on."""
        self.shown_hz = self.rate_hz
        self._since_s, self._counted = self.last_s, 0


class DeviceStreams:
    """All streams of a device."""

    def __init__(self) -> None:
        self.by_name: dict[str, DeviceStream] = {}

    def add(self, readings: Sequence[Reading], now_s: float) -> None:
        """Count readings that came together."""
        for reading in readings:
            stream = self.by_name.get(stream_of(reading))
            if stream is None:
                new = DeviceStream(reading, reading, 1, now_s, now_s)
                self.by_name[stream_of(reading)] = new
            else:
                stream.add(reading, now_s)

    def restart(self) -> None:
        """Start a new measurement of all rates."""
        for stream in self.by_name.values():
            stream.restart()


def measure(device: Device, seconds: float) -> DeviceStreams:
    """Read an open device for a time, or until it ends.

    Raises:
        DeviceError: It is lost, or gives no reading.
    """
    streams = DeviceStreams()
    until = time.monotonic() + seconds
    silence: DeviceTimeout | None = None
    while (left_s := until - time.monotonic()) > 0.0:
        try:
            readings = device.read(min(left_s, _READ_S))
        except DeviceTimeout as error:
            silence = error
            continue
        if not readings:
            break
        streams.add(readings, time.monotonic())
    if not streams.by_name and silence is not None:
        name = f"{device.info.model}: opened"
        problem, remedy = silence_of(name, seconds, device.counters, {}, silence.remedy)
        raise DeviceTimeout(problem, remedy=remedy) from silence
    return streams
