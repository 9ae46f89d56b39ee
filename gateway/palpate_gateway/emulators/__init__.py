"""Devices in software, with faults on request; written from the protocol page.

They import nothing of ``palpate_gateway.protocols``, ``biotac`` or ``wrench``: a decoder that
misreads the page must not agree with a mirror image of itself. This module is light: ``--help``
imports it.
"""

from __future__ import annotations

_WORDS = "absent error_word parity saturated stuck"
_ROS = "clock_drift cut late lost repeated restart silence stuck unplug wrong_time"
_ROBOTOUS = "clock_drift cut junk lost overload repeated restart silence stuck unplug"

FAULTS: dict[str, frozenset[str]] = {
    name: frozenset(faults.split())
    for name, faults in {
        "kms40": "clock_drift cut error junk lost nan overload repeated restart silence stopped "
        "stuck unplug",
        "rdt": "clock_drift cut deaf error junk late latched lost overload repeated restart "
        "silence stuck unplug",
        "robotous": f"{_ROBOTOUS} crc",
        "robotous on CAN": f"{_ROBOTOUS} busoff",
        "bota": "clock_drift crc cut error junk late lost nan overload raw repeated restart "
        "silence stuck unplug",
        "biotac-can": f"{_WORDS} bus_error busoff clock_drift foreign lost repeated restart short "
        "silence unplug",
        "biotac-bridge": f"{_WORDS} clock_drift crc cut junk lost overrun repeated restart "
        "silence unplug",
        "biotac-pic32": "absent clock_drift cut end high_bits junk lost repeated restart saturated "
        "silence stuck unplug",
        "robot": "clock_drift late long lost nan repeated restart silence stuck unplug wrong_time",
        "ros-hand": f"{_ROS} absent saturated",
        "ros-wrench": f"{_ROS} nan",
    }.items()
}
"""Faults that each emulated device can have; its class says what each of them does."""
