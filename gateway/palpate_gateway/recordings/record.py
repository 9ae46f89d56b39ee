"""Replay of a palpate record (MCAP): the readings of one sensor, byte for byte as recorded.

Frames, wrenches, poses, true fields and tares are published again unchanged, with their stamps and
tare ids, so everything that is computed from them is bit-identical. Recorded estimates are not
published again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH
from palpate.codec import ELECTRODE_FRAME
from palpate.config import StrictConfig
from palpate.errors import ConfigError, RecordingError, WireError
from palpate.files.record import RecordItem, read_record
from palpate.messages import ElectrodeFrame, Origin, SensorType
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import Reading, RecordedMessage

_REPLAYED = frozenset(topic.name for topic in (ELECTRODES, WRENCH, POSE, FIELD_TRUTH, TARE))
_BATCH = 64
"""Largest number of messages in one answer of ``read``."""


class RecordOptions(StrictConfig):
    """Options of the ``record`` driver.

    Attributes:
        path: The record, ``NAME.mcap``.
        sensor: Name of the recorded sensor; empty = the only one.
    """

    path: Path
    sensor: str = ""


def recorded_sensors(path: Path) -> list[str]:
    """Names of the sensors whose electrodes are in a record.

    Raises:
        RecordingError: The file is not a record, or it is damaged.
    """
    found = {item.address.sensor for item in read_record(path) if _is_electrodes(item)}
    return sorted(found)


class RecordReplay(Device):
    """One sensor of a palpate record as a finite device."""

    options_class = RecordOptions

    def __init__(self, options: RecordOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver="record",
                sensor_type=SensorType.BIOTAC,
                model=f"palpate record {options.path.name}",
                rate_hz=ELECTRODES.rate_hz,
                live=False,
                finite=True,
                origin=Origin.REPLAYED,
            )
        )
        self._options = options
        self._sensor = options.sensor
        self._items: Iterator[RecordItem] = iter(())
        self._damage: RecordingError | None = None
        self._slots = 0
        self._counters = {"messages": 0, "samples": 0}

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages, and slots of the electrode frames among them."""
        return dict(self._counters)

    def _open(self) -> DeviceIdentity:
        self._sensor = self._options.sensor or self._only_sensor()
        first = self._first_frame()
        self._items = read_record(self._options.path)
        self._damage = None
        self._slots = first.sensor_type.layout.slots
        self._counters = dict.fromkeys(self._counters, 0)
        return DeviceIdentity(
            serial=first.sensor_serial,
            slot_period_s=first.slot_period_ns * 1e-9,
            sensor_type=first.sensor_type,
        )

    def _close(self) -> None:
        self._items = iter(())

    def _read(self, timeout_s: float) -> list[Reading]:
        batch: list[Reading] = []
        try:
            for item in self._items:
                if item.address.sensor != self._sensor or item.address.topic not in _REPLAYED:
                    continue
                self._counters["messages"] += 1
                if _is_electrodes(item):
                    self._counters["samples"] += self._slots
                batch.append(
                    RecordedMessage(item.address.topic, item.payload, item.log_time_ns * 1e-9)
                )
                if len(batch) == _BATCH:
                    break
        except RecordingError as error:
            self._damage = error
        if not batch and self._damage is not None:
            damage, self._damage = self._damage, None
            raise damage
        return batch

    def _only_sensor(self) -> str:
        sensors: set[str] = set()
        try:
            for item in read_record(self._options.path):
                if _is_electrodes(item):
                    sensors.add(item.address.sensor)
        except RecordingError:
            # The messages before the damage are delivered, and the error comes after them.
            if not sensors:
                raise
        if len(sensors) > 1:
            raise ConfigError(
                f"{self._options.path} holds {len(sensors)} sensors: {', '.join(sorted(sensors))}",
                remedy="choose one with the option sensor",
            )
        if not sensors:
            raise self._no_frames()
        return sensors.pop()

    def _first_frame(self) -> ElectrodeFrame:
        for item in read_record(self._options.path):
            if item.address.sensor == self._sensor and _is_electrodes(item):
                try:
                    return ELECTRODE_FRAME.decode(item.payload)
                except WireError as error:
                    raise RecordingError(
                        f"{self._options.path}: the first electrode frame of "
                        f"{self._sensor!r} is damaged: {error.problem}",
                        remedy="replay another record; this one broke the contract when written",
                    ) from error
        raise self._no_frames()

    def _no_frames(self) -> RecordingError:
        of_whom = f" of sensor {self._sensor!r}" if self._sensor else ""
        return RecordingError(
            f"{self._options.path} holds no electrode frames{of_whom}",
            remedy="record with the gateway running, or name a sensor that is in the record",
        )


def _is_electrodes(item: RecordItem) -> bool:
    return item.address.topic == ELECTRODES.name
