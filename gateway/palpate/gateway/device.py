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
from dataclasses import dataclass
from typing import ClassVar, Self

from palpate.gateway.readings import Reading
from palpate.protos.config import StrictConfig
from palpate.protos.errors import DeviceError
from palpate.protos.messages import Origin, SensorType


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
        serial: Serial number of the sensor.
        slot_period_s: Time between two slots of a frame [s].
        start_wall_ns: Wall clock at device time zero [ns since the Unix epoch], for recordings that
            know it; None = not known or live.
    """

    serial: str
    slot_period_s: float
    start_wall_ns: int | None = None


class Device(ABC):
    """A source of readings. Opening and closing twice is harmless; a closed one opens afresh.

    A driver is a subclass whose constructor takes one value of its ``options_class``.
    """

    options_class: ClassVar[type[StrictConfig]]
    """Options of the driver, checked before the device is made."""

    def __init__(self, info: DeviceInfo) -> None:
        self._info = info
        self._identity: DeviceIdentity | None = None

    @property
    def info(self) -> DeviceInfo:
        """What is known without opening the device."""
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
            self._identity = self._open()

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
