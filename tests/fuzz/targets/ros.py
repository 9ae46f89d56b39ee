"""Tactile messages and wrenches of ROS, and what rmw_zenoh attaches to them."""

from __future__ import annotations

from typing import Any

import numpy as np

from palpate.errors import WireError
from palpate.messages import COUNTS_MAX
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND, Dialect, encode, stamp_of
from palpate.ros.rmw_zenoh import SampleInfo
from palpate_gateway.protocols.ros_hands import decode_hand
from palpate_gateway.ros.finger_track import FingerTrack
from palpate_gateway.ros.wrench import decode_wrench

_DIALECTS: tuple[Dialect, ...] = ("cdr", "ros1")


def check(data: bytes) -> None:
    """The first byte chooses layout and kind of bytes; then comes the message."""
    mode, payload = (data[:1] or b"\0")[0], data[1:]
    dialect = _DIALECTS[mode & 1]
    reason = "parse"
    try:
        if mode & 6 == 6:
            assert SampleInfo.decode(payload).encode() == payload
        elif mode & 6 == 4:
            assert len(decode_wrench(payload, dialect).values) == 6
        else:
            _check_hand(payload, BIOTAC_HAND if mode & 2 else BIOTAC_ALL, dialect)
    except WireError as error:
        reason = error.reason
    assert reason in ("parse", "electrode_count", "attachment")


def _check_hand(payload: bytes, layout: str, dialect: Dialect) -> None:
    hand = decode_hand(payload, layout, dialect)
    assert 0 <= hand.end_ns - hand.time_ns < 1_000_000_000
    for place, finger in enumerate(hand.fingers, 1):
        reading = FingerTrack(place, rate_hz=100.0).take(hand)
        assert (reading is None) == (finger is None)
        if reading is None or finger is None:
            continue
        kind = finger.sensor_type.layout
        told = [*reading.electrodes, reading.pdc, reading.tac, reading.tdc, *reading.pac]
        assert len(told) == kind.slots
        sent = [*finger.slow, *finger.pac]
        for bit, value in enumerate(told):
            assert 0 <= value <= COUNTS_MAX
            if reading.validity >> bit & 1:
                assert value == sent[bit]


def seeds() -> list[bytes]:
    """A message of each kind, good and cut, and an attachment."""
    found = [b"\x06" + SampleInfo(1, 2, bytes(range(16))).encode()]
    for mode, dialect in enumerate(_DIALECTS):
        header: dict[str, Any] = {"stamp": stamp_of(1_700_000_000_000_000_000), "frame_id": "hand"}
        header |= {"seq": 7} if dialect == "ros1" else {}
        counts = np.arange(2000, 2024)
        tactiles: list[dict[str, Any]] = [
            {"pac0": 2040, "pac1": 2041, "pdc": 2600, "tac": 2045, "tdc": 1914}
            | {"electrodes": counts[:number].astype(np.int16)}
            for number in (19, 24, 0, 19, 3)
        ]
        zeros = {"pac0": 0, "pac1": 0, "pdc": 0, "tac": 0, "tdc": 0}
        tactiles[2] |= zeros
        whole = encode({"header": header, "tactiles": tactiles}, BIOTAC_ALL, dialect)
        tactiles[4] = tactiles[2]
        good = encode({"header": header, "tactiles": tactiles}, BIOTAC_ALL, dialect)
        finger = {
            "bt_serial": "BT1",
            "bt_position": 1,
            "tdc_data": 1914,
            "tac_data": 2045,
            "pdc_data": 2600,
            "pac_data": counts[:22].astype(np.uint16),
            "electrode_data": counts[:19].astype(np.uint16),
        }
        times = {
            "frame_start_time": stamp_of(5),
            "frame_end_time": stamp_of(10_000_005),
            **dict.fromkeys(("tdc_ns_offset", "tac_ns_offset", "pdc_ns_offset"), 1),
            "pac_ns_offset": np.arange(22, dtype=np.uint32) * 454_545,
            "electrode_ns_offset": np.arange(19, dtype=np.uint32) * 454_545,
        }
        hand = {"header": header, "hand_id": "left", "bt_data": [finger] * 2, "bt_time": times}
        frame = encode(hand, BIOTAC_HAND, dialect)
        found += [bytes([mode]) + one for one in (whole, good, good[:-9])]
        found += [bytes([mode | 2]) + one for one in (frame, frame[:-9])]
    return found
