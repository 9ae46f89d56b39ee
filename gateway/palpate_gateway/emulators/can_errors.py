"""Error frames as SocketCAN hands them to whoever listens to a controller.

They never travel on a real bus: the receiver's own controller makes them. Emulators send them over
python-can's buses in software, which carry them like any frame.
"""

from __future__ import annotations

from typing import Any

BUS_ERROR, BUS_OFF, RESTARTED = 0x080, 0x040, 0x100
"""Classes, bits of the identifier (linux/can/error.h)."""


def error_frame(can: Any, kind: int) -> Any:
    """A message of python-can, which is given."""
    return can.Message(
        arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=bytes(8)
    )
