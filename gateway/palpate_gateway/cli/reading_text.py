"""Readings for people and for JSON: the name of their stream, and their values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from palpate.messages import FrameLayout
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


def stream_of(reading: Reading) -> str:
    """Name of the stream that a reading becomes."""
    if isinstance(reading, RecordedMessage):
        return reading.topic
    return {
        ElectrodeReading: "electrodes",
        WrenchReading: "wrench",
        PoseReading: "pose",
        FieldReading: "field",
    }[type(reading)]


def values_of(reading: Reading) -> dict[str, Any]:
    """Its values as JSON has them: raw counts, and SI units."""
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
    """Its values in lines."""
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
    """Ten electrodes a line, the other channels, and which of all are not valid."""
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
    told = f"{min(pac)}..{max(pac)}" if pac else "none"
    lines.append(f"PDC {reading.pdc}  TAC {reading.tac}  TDC {reading.tdc}  PAC {told} [counts]")
    if bad:
        more = f" and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
        names = ", ".join(layout.bit_name(bit) for bit in bad[:_NAMED])
        lines.append(f"not valid: {names}{more}")
    return lines


def _pose_lines(reading: PoseReading) -> list[str]:
    """Where the tip is, in the words of the sensor frame, and where the indenter presses."""
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
    """Plain numbers without the tail that 32 bits leave."""
    return [round(float(value), 7) for value in values]
