"""The contract of a device: any source of readings, live, simulated or recorded.

::

    with make_device("virtual", {"seed": 1}) as device:
        readings = device.read(timeout_s=1.0)

Rules of ``read``, the same for hardware, virtual fingers and files:

* a list with at least one reading, in order of time;
* ``[]`` if and only if a finite source has ended (and on every call after that);
* ``DeviceTimeout`` if nothing came in time: try again;
* ``DeviceLost`` if the device is gone: close it and open it again;
* ``RecordingError`` if a file is damaged, after all readings before the damage were delivered.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Annotated, ClassVar, Self, TypeVar

from pydantic import AfterValidator

from palpate.config import LinkConfig, StrictConfig
from palpate.errors import DeviceError, RecordingError
from palpate.messages import Origin, SensorType
from palpate_gateway.readings import Reading

SomeReading = TypeVar("SomeReading", bound=Reading)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What is known before a device is opened.

    Attributes:
        driver: Name in the driver table.
        sensor_type: Kind of tactile sensor, which fixes the number of electrodes; None = another
            kind of sensor, e.g. of force and torque.
        model: One line that names the device.
        rate_hz: Nominal frame rate [Hz].
        live: The device sets the pace; False = a file or a simulation that waits for its reader.
        finite: The source has an end.
        origin: Origin in the stamps of its frames.
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
        start_wall_ns: Wall clock at device time zero of a recording [ns since the epoch]; None =
            unknown, or live.
        sensor_type: Kind of tactile sensor, if only the open device shows it; replaces that of
            ``DeviceInfo``, and the nominal rate with it; None = both as in ``DeviceInfo``.
        rate_hz: Nominal frame rate [Hz] with ``sensor_type``; None = its frames follow one another
            without a pause.
        has_clock: The device has a clock of its own, and its readings carry that time; False = a
            live device without one: times are the host's monotonic times of arrival.
        unfilled: Those of the channels ``PDC``, ``PAC``, ``TAC`` and ``TDC`` that its driver never
            fills: that they are invalid is no fault.
    """

    serial: str
    slot_period_s: float
    start_wall_ns: int | None = None
    sensor_type: SensorType | None = None
    rate_hz: float | None = None
    has_clock: bool = True
    unfilled: frozenset[str] = frozenset()


SERIAL_MAX = 64
"""Longest serial number of a frame [characters]."""


def _check_given(serial: str) -> str:
    if serial and _fit_for_wire(serial) != serial:
        raise ValueError(f"a serial number has 1 to {SERIAL_MAX} printable ASCII characters")
    return serial


SerialOption = Annotated[str, AfterValidator(_check_given)]
"""A serial number given by a user, refused if a frame cannot carry it unchanged; empty = none."""


def _fit_for_wire(name: str) -> str:
    """A short printable name: what replaces an unknown serial number, e.g. a path, can be long."""
    printable = "".join(c if c.isascii() and c.isprintable() else "?" for c in name)
    return printable[-SERIAL_MAX:] or "unknown"


class Device(ABC):
    """A source of readings. Opening or closing it twice is harmless; a closed one can be reopened.

    A driver is a subclass whose constructor takes one value of its ``options_class``.
    """

    options_class: ClassVar[type[StrictConfig]]
    """Options of the driver, checked before the device is made."""

    needs: ClassVar[tuple[str, ...]] = ()
    """Optional packages that it imports when it is opened; those of the extra ``gateway``."""

    address = ""
    """Where only one sensor can be, e.g. ``host:port``; empty = several may share it."""

    gone_s: ClassVar[float] = 2.0
    """A live device that has been silent for so long is closed and opened again [s]."""

    def __init__(self, info: DeviceInfo) -> None:
        self._info = info
        self._identity: DeviceIdentity | None = None
        self._held_error: DeviceError | None = None

    @property
    def info(self) -> DeviceInfo:
        """What is known before the device is opened; corrected when it is opened."""
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
            self._held_error = None
            identity = self._open()
            identity = self._identity = replace(identity, serial=_fit_for_wire(identity.serial))
            kind = identity.sensor_type
            if kind is not None:
                slots_hz = 1.0 / (identity.slot_period_s * kind.layout.slots)
                rate_hz = slots_hz if identity.rate_hz is None else identity.rate_hz
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
        _ = self.identity  # raises if the device is closed
        if self._held_error is not None:
            raise self._held_error
        return self._read(timeout_s)

    def _before_error(self, readings: Iterable[SomeReading | None]) -> list[SomeReading]:
        """All of them up to an error, which the next ``read`` raises; at once if there are none."""
        good: list[SomeReading] = []
        try:
            for reading in readings:
                if reading is not None:
                    good.append(reading)
        except DeviceError as error:
            if not good:
                raise
            self._held_error = error
        return good

    @property
    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Numbers of events since it was last opened, e.g. ``samples``, ``time_jumps``."""

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


def silence_of(
    name: str, silent_s: float, counters: Mapping[str, int], before: Mapping[str, int], remedy: str
) -> tuple[str, str]:
    """Problem and remedy of a device that gave no reading.

    Args:
        name: What to call it.
        silent_s: For how long [s].
        counters: Its counters now.
        before: Its counters when the silence began.
        remedy: What to do where nothing was counted.
    """
    # Names only: numbers would make each of these errors another one in the log.
    rose = sorted(key for key, count in counters.items() if count > before.get(key, 0))
    if not rose:
        return f"{name}: no reading came within {silent_s:.3g} s", remedy
    return (
        f"{name}: no reading came within {silent_s:.3g} s, but it counted {', '.join(rose)}",
        "look these counters up on the device's page; then check its power and cable",
    )


class BusDevice(Device):
    """A device whose readings come over the bus, from another program.

    That program may start at any time, and its first readings must not be missed; so the device
    stays open for long while nothing comes.
    """

    gone_s = 30.0

    @abstractmethod
    def join(self, link: LinkConfig, station: str) -> None:
        """How the gateway has joined the bus; called once, before the first opening."""


_BATCH = 64
"""Largest number of readings of a file in one answer of ``read``."""


class FileDevice(Device):
    """A file as a finite device, which delivers as fast as it is read.

    Subclasses call ``_deliver`` when they open it. Damage is raised once, after all readings before
    it; then the source has ended.
    """

    def __init__(
        self, driver: str, sensor_type: SensorType | None, model: str, rate_hz: float
    ) -> None:
        super().__init__(
            DeviceInfo(
                driver, sensor_type, model, rate_hz, live=False, finite=True, origin=Origin.REPLAYED
            )
        )
        self._deliver(())

    def _deliver(self, readings: Iterable[Reading]) -> None:
        """Readings of the open file; taking one raises ``RecordingError`` at damage."""
        self._readings: Iterator[Reading] = iter(readings)
        self._damage: RecordingError | None = None

    def _close(self) -> None:
        self._deliver(())

    def _read(self, timeout_s: float) -> list[Reading]:
        batch: list[Reading] = []
        try:
            for reading in islice(self._readings, _BATCH):
                batch.append(reading)
        except RecordingError as error:
            self._damage = error
        if not batch and self._damage is not None:
            damage, self._damage = self._damage, None
            raise damage
        return batch
