"""Tactile messages and bags of ROS made by code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from palpate.ros.layouts import (
    BIOTAC_HAND,
    WRENCH_STAMPED,
    Dialect,
    encode,
    stamp_of,
    typestore,
)

BEGAN_NS = 1_700_000_000_000_000_000
"""Time of the first message [ns since the epoch]."""

Fields = dict[str, Any]


def header(time_ns: int, sequence: int, dialect: Dialect) -> Fields:
    """A header; only that of ROS 1 has a sequence number."""
    fields: Fields = {"stamp": stamp_of(time_ns), "frame_id": "hand"}
    return fields | ({"seq": sequence} if dialect == "ros1" else {})


def electrodes_of(k: int) -> list[int]:
    """E1 to E19 of reading ``k``, which differ between readings and channels."""
    return [1000 + 50 * channel + k % 40 for channel in range(19)]


def all_fields(
    k: int, time_ns: int, dialect: Dialect = "cdr", *, fingers: Sequence[int] = (1,)
) -> Fields:
    """A ``BiotacAll`` with reading ``k`` at some places."""
    tactiles = []
    for place in range(1, 6):
        there = place in fingers
        values = electrodes_of(k) if there else []
        slow = {"pac0": 2040, "pac1": 2041, "pdc": 2600 + k % 40, "tac": 2045, "tdc": 1914}
        tactiles.append(
            {name: value if there else 0 for name, value in slow.items()}
            | {"electrodes": np.array(values, np.int16)}
        )
    return {"header": header(time_ns, k, dialect), "tactiles": tactiles}


def hand_fields(
    k: int,
    time_ns: int,
    dialect: Dialect = "cdr",
    *,
    serials: Sequence[str] = ("BT1",),
    offsets: bool = True,
) -> Fields:
    """A ``BioTacHand`` whose frame begins at a time and lasts 10 ms."""
    data = [
        {
            "bt_serial": serial,
            "bt_position": position,
            "tdc_data": 1914,
            "tac_data": 2045,
            "pdc_data": 2600 + k % 40,
            "pac_data": np.arange(2000, 2022, dtype=np.uint16),
            "electrode_data": np.array(electrodes_of(k), np.uint16) + 7 * position,
        }
        for position, serial in enumerate(serials, 1)
    ]
    slot_ns = 227_273 if offsets else 0
    times = {
        "frame_start_time": stamp_of(time_ns),
        "frame_end_time": stamp_of(time_ns + 10_000_000),
        "tdc_ns_offset": 0,
        "tac_ns_offset": 0,
        "pdc_ns_offset": 0,
        "pac_ns_offset": (np.arange(22) * 2 + 1).astype(np.uint32) * slot_ns,
        "electrode_ns_offset": (np.arange(19) * 2).astype(np.uint32) * slot_ns,
    }
    head = header(time_ns + 10_000_000, k, dialect)
    return {"header": head, "hand_id": "left", "bt_data": data, "bt_time": times}


def wrench_fields(k: int, time_ns: int, dialect: Dialect = "cdr") -> Fields:
    """A ``WrenchStamped`` that tells ``k`` by its z."""
    force, torque = {"x": 0.5, "y": -1.5, "z": float(k)}, {"x": 0.1, "y": 0.2, "z": 0.3}
    return {
        "header": header(time_ns, k, dialect),
        "wrench": {"force": force, "torque": torque},
    }


Written = tuple[str, str, int, bytes]
"""Topic, layout, time of recording [ns], bytes."""


def write_bag(
    path: Path, messages: Sequence[Written], dialect: Dialect, storage: str = "sqlite3"
) -> Path:
    """A bag of ROS 1 (a file) or ROS 2 (a folder) with these messages."""
    store = typestore(dialect)
    connections: dict[str, Any] = {}
    if dialect == "ros1":
        with Writer1(path) as bag1:
            for topic, layout, time_ns, payload in messages:
                if topic not in connections:
                    connections[topic] = bag1.add_connection(topic, layout, typestore=store)
                bag1.write(connections[topic], time_ns, payload)
        return path
    with Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag2:
        for topic, layout, time_ns, payload in messages:
            if topic not in connections:
                connections[topic] = bag2.add_connection(topic, layout, typestore=store)
            bag2.write(connections[topic], time_ns, payload)
    return path


def make_bag(
    path: Path,
    frames: int,
    dialect: Dialect = "ros1",
    *,
    layout: str = BIOTAC_HAND,
    leave_out: Callable[[int], bool] = lambda k: False,
    storage: str = "sqlite3",
) -> Path:
    """A bag of one finger at 100 Hz on ``/hand/tactile``, and a wrench at 50 Hz on ``/ft``."""
    fields = hand_fields if layout == BIOTAC_HAND else all_fields
    messages: list[Written] = []
    for k in range(frames):
        time_ns = BEGAN_NS + 10_000_000 * k
        if not leave_out(k):
            payload = encode(fields(k, time_ns, dialect), layout, dialect)
            messages.append(("/hand/tactile", layout, time_ns + 11_000_000, payload))
        if k % 2 == 0:
            payload = encode(
                wrench_fields(k, time_ns + 3_000_000, dialect), WRENCH_STAMPED, dialect
            )
            messages.append(("/ft", WRENCH_STAMPED, time_ns + 12_000_000, payload))
    return write_bag(path, messages, dialect, storage)
