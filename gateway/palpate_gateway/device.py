"""The contract of a device: anything that yields tactile readings.

::

    with make_device("virtual", {"seed": 1}) as device:
        readings = device.read(timeout_s=1.0)

Rules of ``read``, the same for hardware, virtual fingers and files:

* a list with at least one reading, in order of time;
* ``[]`` if and only if a finite source has ended (and on every call after that);
* ``DeviceTimeout`` if nothing came in time: try again;
* ``DeviceLost`` if the device is gone: close, open again;
* ``RecordingError`` if a file is damaged, after all readings before the damage were delivered.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from palpate.config import LinkConfig, StrictConfig
from palpate.errors import DeviceError
from palpate.messages import Origin, SensorType
from palpate_gateway.readings import Reading


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What is known before a device is opened.

    Attributes:
        driver: Name in the driver table.
        sensor_type: Kind of tactile sensor, which fixes the number of electrodes; None = no tactile
            sensor, but one of force and torque.
        model: One line for people.
        rate_hz: Nominal frame rate [Hz].
        live: The device sets the pace; False = a file or a simulation that waits for its reader.
        finite: ``read`` ends one day.
        origin: What the frames' stamps say of where they come from.
    """

    driver: str
    sensor_type: SensorType | None
    model: str
    rate_hz: float
    live: bool
    finite: bool
    origin: Origin


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """What is known once a device is open.

    Attributes:
        serial: Serial number of the sensor; ``Device.open`` keeps the last 64 characters.
        slot_period_s: Time between two slots of a frame [s].
        start_wall_ns: Wall clock at device time zero [ns since the Unix epoch], for recordings that
            know it; None = not known or live.
        sensor_type: Kind of tactile sensor where only the open device tells: it replaces that of
            ``DeviceInfo``, and the nominal rate follows; None = as said there.
        tells_time: Its readings' times are of a clock of its own; False = a live device that tells
            none, they are the host's monotonic times of arrival.
    """

    serial: str
    slot_period_s: float
    start_wall_ns: int | None = None
    sensor_type: SensorType | None = None
    tells_time: bool = True


SERIAL_MAX = 64
"""Longest serial number of a frame [characters]."""


def _fit_for_wire(name: str) -> str:
    """What stands for a serial number that is not told may be long, e.g. the path of a line."""
    printable = "".join(c if c.isascii() and c.isprintable() else "?" for c in name)
    return printable[-SERIAL_MAX:] or "unknown"


class Device(ABC):
    """A source of readings. Opening and closing twice is harmless; a closed one opens afresh.

    A driver is a subclass whose constructor takes one value of its ``options_class``.
    """

    options_class: ClassVar[type[StrictConfig]]
    """Options of the driver, checked before the device is made."""

    gone_s: ClassVar[float] = 2.0
    """A live device that has been silent for so long is closed and opened again [s]."""

    def __init__(self, info: DeviceInfo) -> None:
        self._info = info
        self._identity: DeviceIdentity | None = None

    @property
    def info(self) -> DeviceInfo:
        """What is known without opening the device, and once it has been opened, better."""
        return self._info

    @property
    def is_open(self) -> bool:
        """Whether ``read`` may be called."""
        return self._identity is not None

    @property
    def identity(self) -> DeviceIdentity:
        """Serial number and timing of the open device.

        Raises:
            DeviceError: The device is not open.
        """
        if self._identity is None:
            raise DeviceError(
                f"the {self._info.driver} device is not open", remedy="call open() first"
            )
        return self._identity

    def open(self) -> None:
        """Connect, or do nothing if connected.

        Raises:
            DeviceError: The device or file cannot be opened or is not what it should be.
        """
        if self._identity is None:
            identity = self._open()
            identity = self._identity = replace(identity, serial=_fit_for_wire(identity.serial))
            kind = identity.sensor_type
            if kind is not None and kind is not self._info.sensor_type:
                rate_hz = 1.0 / (identity.slot_period_s * kind.layout.slots)
                self._info = replace(self._info, sensor_type=kind, rate_hz=rate_hz)

    def close(self) -> None:
        """Disconnect, or do nothing if not connected; never raises."""
        if self._identity is not None:
            self._identity = None
            self._close()

    def read(self, timeout_s: float) -> list[Reading]:
        """The next readings; see the rules at the top of this file.

        Args:
            timeout_s: How long to wait for the first reading [s].
        """
        # Naming a closed device is worth one property access per call.
        _ = self.identity
        return self._read(timeout_s)

    @property
    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Events since it was opened last, e.g. ``samples``, ``time_jumps``."""

    @abstractmethod
    def _open(self) -> DeviceIdentity: ...

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _read(self, timeout_s: float) -> list[Reading]: ...

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


class BusDevice(Device):
    """A device whose readings come over the bus: somebody else's program is the sensor.

    It may start at any time and shall be heard at once, so opening again, which helps nobody while
    it does not run, is rare.
    """

    gone_s = 30.0

    @abstractmethod
    def join(self, link: LinkConfig, station: str) -> None:
        """How the gateway has joined the bus; told before the first opening, and only there."""
