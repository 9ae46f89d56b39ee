"""What a gateway says of each of its sensors, and the zero of a force/torque sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from palpate.messages.frames import FloatArray


class SensorState(IntEnum):
    """How a sensor does. Those from ``LIVE`` to ``ZERO_LOST`` deliver."""

    UNKNOWN = 0
    STARTING = 1
    LIVE = 2
    WARMING = 3
    ZERO_LOST = 4
    LOST = 5
    ENDED = 6


class FaultKind(IntEnum):
    """What is wrong with a channel."""

    UNKNOWN = 0
    SATURATED = 1
    DEAD = 2
    STUCK = 3
    ODD = 4


@dataclass(frozen=True, slots=True)
class ChannelFault:
    """Channels of a sensor that have the same fault.

    Attributes:
        kind: See ``FaultKind``.
        channels: Their names, e.g. ``E7`` or ``PAC``.
    """

    kind: FaultKind
    channels: Sequence[str]


@dataclass(frozen=True, slots=True)
class SensorStatus:
    """How one sensor of a gateway does.

    Attributes:
        name: Its name in keys.
        state: See ``SensorState``.
        since_monotonic_ns: Host monotonic clock when it came into this state [ns].
        faults: Channels that are not to be trusted; empty = none.
        message: One line for people; empty = nothing to say.
    """

    name: str
    state: SensorState
    since_monotonic_ns: int = 0
    faults: Sequence[ChannelFault] = ()
    message: str = ""


@dataclass(frozen=True, slots=True)
class WrenchZeroRequest:
    """Take the present load of a force/torque sensor as zero.

    Attributes:
        readings: How many to average before and after; 0 = the gateway's own number.
    """

    readings: int = 0


@dataclass(frozen=True, slots=True)
class WrenchZero:
    """The zero that a force/torque sensor took. All values as published, on the BioTac.

    Attributes:
        sensor_serial: Serial number of the force/torque sensor.
        device: One line for people: model and address.
        monotonic_ns: Host monotonic clock when it was taken [ns].
        wall_ns: Host wall clock when it was taken [ns since the Unix epoch].
        force_before: Mean force before it [N], shape ``(3,)``.
        torque_before: Mean torque before it [N m], shape ``(3,)``.
        force_after: Mean force after it [N], shape ``(3,)``.
        torque_after: Mean torque after it [N m], shape ``(3,)``.
        readings_averaged: How many readings each mean is of.
    """

    sensor_serial: str
    device: str
    monotonic_ns: int
    wall_ns: int
    force_before: FloatArray
    torque_before: FloatArray
    force_after: FloatArray
    torque_after: FloatArray
    readings_averaged: int
