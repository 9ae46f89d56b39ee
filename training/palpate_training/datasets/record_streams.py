"""Streams of each finger of a record: read, checked to be of one finger, and forces at any time."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.alignment import AlignmentClock, Stamped, common_clock, linear, times_of
from palpate.bus import topics
from palpate.errors import DatasetError, WireError
from palpate.files.record import read_record
from palpate.messages import ElectrodeFrame, IndenterPoseFrame, SensorType, Tare, WrenchFrame
from palpate.sampling import sample_offsets

_log = logging.getLogger(__name__)

_STREAMS: Mapping[str, topics.Topic[Any]] = {
    topic.name: topic for topic in (topics.ELECTRODES, topics.WRENCH, topics.POSE, topics.TARE)
}

Times = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


OVERLOAD = "the force/torque sensor was overloaded"
"""Why frames are left out."""


@dataclass(slots=True)
class SensorStreams:
    """What a record holds of one sensor."""

    frames: list[ElectrodeFrame] = field(default_factory=list)
    wrenches: list[WrenchFrame] = field(default_factory=list)
    poses: list[IndenterPoseFrame] = field(default_factory=list)
    tares: dict[int, Tare] = field(default_factory=dict)

    @property
    def clock(self) -> AlignmentClock:
        """By which all its messages can be compared."""
        return common_clock(self.frames, self.wrenches, self.poses)


def read_streams(path: Path) -> dict[str, SensorStreams]:
    """Streams of every sensor of a record, by name, in order of writing.

    Messages that break the contract, which the recorder keeps, are left out, and the log tells it.

    Raises:
        RecordingError: Not a whole record.
    """
    sensors: dict[str, SensorStreams] = {}
    rejected = 0
    for item in read_record(path):
        topic = _STREAMS.get(item.address.topic)
        if topic is None:
            continue
        streams = sensors.setdefault(item.address.sensor, SensorStreams())
        try:
            message = topic.codec.decode(item.payload)
        except WireError:
            rejected += 1
            continue
        if isinstance(message, ElectrodeFrame):
            streams.frames.append(message)
        elif isinstance(message, WrenchFrame):
            streams.wrenches.append(message)
        elif isinstance(message, IndenterPoseFrame):
            streams.poses.append(message)
        else:
            streams.tares[message.tare_id] = message
    if rejected:
        _log.warning("%s: %d messages break the contract and are left out", path, rejected)
    return sensors


def check_streams(path: Path, name: str, streams: SensorStreams) -> None:
    """Refuse a sensor that a data set cannot hold, or that is not one sensor.

    That is one without a wrench, with other electrodes, with two serial numbers, or times twice.

    Raises:
        DatasetError: It is such; no frame is left out in silence.
    """
    if not streams.wrenches:
        raise DatasetError(
            f"{path}: sensor {name!r} has no wrench stream",
            remedy="record the force/torque sensor in the finger's keys: of = NAME in its table",
        )
    others = [f.sensor_type for f in streams.frames if f.sensor_type is not SensorType.BIOTAC]
    if others:
        raise DatasetError(
            f"{path}: {len(others)} of {len(streams.frames)} frames of {name!r} are of a "
            f"{others[0].name} with {others[0].layout.electrodes} electrodes; a data set has "
            f"{SensorType.BIOTAC.layout.electrodes}",
            remedy="record BioTacs with 19 electrodes alone; models are trained for no other",
        )
    if len(serials := serials_of(streams)) > 1:
        raise DatasetError(
            f"{path}: {name!r} is {len(serials)} fingers, exchanged while it was recorded: "
            f"{', '.join(serials)}",
            remedy="make a record of its own of each finger: each has another rest and response",
        )
    clock = streams.clock
    _check_times(path, name, streams.frames, clock, "electrodes")
    _check_times(path, name, streams.wrenches, clock, "wrench")
    _check_times(path, name, streams.poses, clock, "pose")


def _check_times(
    path: Path, name: str, stream: Sequence[Stamped], clock: AlignmentClock, what: str
) -> None:
    """Refuse a stream whose clock went back, so that some of its times come twice."""
    stamps = [message.stamp for message in stream]
    times = times_of(stream, clock)
    pairs = zip(itertools.pairwise(stamps), np.diff(times) < 0, strict=True)
    # What was overtaken on the bus, or is played again, goes back in its sequence as well.
    set_back = [
        earlier and not (new.session_id == old.session_id and new.sequence < old.sequence)
        for (old, new), earlier in pairs
    ]
    parts = np.cumsum([False, *set_back])
    in_time = parts[np.argsort(times, kind="stable")]
    if np.count_nonzero(np.diff(in_time)) > parts[-1]:
        at = set_back.index(True)
        back_s = (times[at] - times[at + 1]) * 1e-9
        raise DatasetError(
            f"{path}: the {clock.value} clock of the {what} of {name!r} goes back by {back_s:.2f} "
            "s: some times come twice, and what belongs together is unknown",
            remedy="record again, and leave the clocks alone meanwhile (docs/time.md)",
        )


def serials_of(streams: SensorStreams) -> list[str]:
    """Serial numbers that the frames of a sensor name, in order of the alphabet."""
    return sorted({frame.sensor_serial for frame in streams.frames})


def force_at(
    path: Path, name: str, times: Times, streams: SensorStreams, clock: AlignmentClock
) -> tuple[Values, npt.NDArray[np.bool_], int]:
    """Force on a sensor at times of a clock [N], shape (T, 3), and where it is known.

    Beside a reading in which the force/torque sensor was overloaded it is unknown; the log tells at
    how many times, which is also returned.
    """
    forces = np.array([w.force for w in streams.wrenches], dtype=np.float64)
    forces[np.array([w.overload for w in streams.wrenches])] = np.nan
    force, aligned = linear(times, times_of(streams.wrenches, clock), forces)
    known = aligned & np.isfinite(force).all(axis=1)
    if overloaded := int(np.count_nonzero(aligned & ~known)):
        _log.warning(
            "%s: %d of %d frames of %s are left out: %s",
            path,
            overloaded,
            len(times),
            name,
            OVERLOAD,
        )
    return force, known, overloaded


def middles(frames: Sequence[ElectrodeFrame]) -> Times:
    """From each frame's stamp to the mean instant of its electrodes [ns]: 4 ms, live."""
    return np.array([sample_offsets(frame).middle_ns for frame in frames], dtype=np.int64)
