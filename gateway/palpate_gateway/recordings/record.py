"""Replay of a palpate record (MCAP): the readings of one sensor, byte for byte as recorded.

Frames, wrenches, poses, true fields and tares are published again unchanged, with their stamps and
tare ids, so everything that is computed from them is bit-identical. Recorded estimates are not
published again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH
from palpate.codec import ELECTRODE_FRAME
from palpate.config import StrictConfig
from palpate.errors import RecordingError, WireError
from palpate.files.record import RecordItem, only_name, read_record
from palpate.messages import ElectrodeFrame, SensorType
from palpate_gateway.device import DeviceIdentity, FileDevice
from palpate_gateway.readings import RecordedMessage
from palpate_gateway.recordings.pace import RecordPace

_REPLAYED = frozenset(topic.name for topic in (ELECTRODES, WRENCH, POSE, FIELD_TRUTH, TARE))


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
        RecordingError: The file is not a record, is damaged, or holds several stations.
    """
    found = {item.address.sensor for item in read_record(path) if _is_electrodes(item)}
    return sorted(found)


class RecordReplay(FileDevice):
    """One sensor of a palpate record as a finite device."""

    options_class = RecordOptions

    def __init__(self, options: RecordOptions) -> None:
        model = f"palpate record {options.path.name}"
        super().__init__("record", SensorType.BIOTAC, model, ELECTRODES.rate_hz)
        self._options = options
        self._sensor = options.sensor
        self._counters = {"messages": 0, "samples": 0}

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages, and slots of the electrode frames among them."""
        return dict(self._counters)

    def _open(self) -> DeviceIdentity:
        path = self._options.path
        self._sensor = self._options.sensor or only_name(path, ELECTRODES.name, "sensor")
        first = self._first_frame()
        self._counters = dict.fromkeys(self._counters, 0)
        self._deliver(self._messages(first.sensor_type.layout.slots))
        return DeviceIdentity(
            serial=first.sensor_serial,
            slot_period_s=first.slot_period_ns * 1e-9,
            sensor_type=first.sensor_type,
        )

    def _messages(self, slots: int) -> Iterator[RecordedMessage]:
        pace = RecordPace(self._options.path, self._sensor)
        for item in read_record(self._options.path):
            if item.address.sensor == self._sensor and item.address.topic in _REPLAYED:
                self._counters["messages"] += 1
                if _is_electrodes(item):
                    self._counters["samples"] += slots
                time_s = 1e-9 * pace.time_ns(item)
                yield RecordedMessage(item.address.topic, item.payload, time_s)

    def _first_frame(self) -> ElectrodeFrame:
        """The first one that can be decoded."""
        for item in read_record(self._options.path):
            if item.address.sensor == self._sensor and _is_electrodes(item):
                with suppress(WireError):  # the recorder keeps what breaks the contract
                    return ELECTRODE_FRAME.decode(item.payload)
        raise self._no_frames()

    def _no_frames(self) -> RecordingError:
        of_whom = f" of sensor {self._sensor!r}" if self._sensor else ""
        tactile = [one for one in recorded_sensors(self._options.path) if one != self._sensor]
        return RecordingError(
            f"{self._options.path} holds no electrode frames{of_whom}",
            remedy=f"name a tactile sensor of the record: {', '.join(tactile)}"
            if tactile
            else "record while the gateway reads a tactile sensor",
        )


def _is_electrodes(item: RecordItem) -> bool:
    return item.address.topic == ELECTRODES.name
