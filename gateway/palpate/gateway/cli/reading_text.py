"""Readings for people and for JSON: the name of their stream, and their values."""

from __future__ import annotations

from typing import Any

import numpy as np

from palpate.gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)


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
            "in_contact": bool(reading.in_contact),
        }
    largest = float(np.linalg.norm(reading.displacement, axis=1).max(initial=0.0))
    return place | {"nodes": len(reading.displacement), "largest_m": largest}


def text_of(reading: Reading) -> list[str]:
    """Its values in lines."""
    values = values_of(reading)
    if isinstance(reading, ElectrodeReading):
        counts = values["electrodes"]
        pac = values["pac"]
        return [
            "E1..E10  " + " ".join(f"{count:4d}" for count in counts[:10]),
            "E11..E19 " + " ".join(f"{count:4d}" for count in counts[10:]),
            f"PDC {values['pdc']}  TAC {values['tac']}  TDC {values['tdc']}"
            f"  PAC {min(pac)}..{max(pac)} [counts]",
        ]
    if isinstance(reading, WrenchReading):
        lines = [
            "force  " + " ".join(f"{value:+8.3f}" for value in values["force_n"]) + " N",
            "torque " + " ".join(f"{value:+8.4f}" for value in values["torque_n_m"]) + " N m",
        ]
        return [*lines, "OVERLOAD: its range is exceeded"] if reading.overload else lines
    shown = {key: value for key, value in values.items() if key not in ("tick", "time_s")}
    return ["  ".join(f"{key} {value}" for key, value in shown.items())]


def _rounded(values: Any) -> list[float]:
    """Plain numbers without the tail that 32 bits leave."""
    return [round(float(value), 7) for value in values]
