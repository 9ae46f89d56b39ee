"""A bag of ROS 1 or ROS 2 as a finite device: one finger, and the wrench on it."""

from __future__ import annotations

import contextlib
import heapq
import logging
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from pydantic import field_validator

from palpate.errors import ConfigError, RecordingError, WireError
from palpate.messages import SensorType
from palpate.process import require
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND, MD5, WRENCH_STAMPED, Dialect, typestore
from palpate.ros.rmw_zenoh import check_topic_name
from palpate_gateway.device import DeviceIdentity, FileDevice, SerialOption
from palpate_gateway.protocols.ros_hands import RosFinger, RosHand, decode_hand
from palpate_gateway.readings import ElectrodeReading, WrenchReading
from palpate_gateway.ros.biotac import RosFingerOptions
from palpate_gateway.ros.wrench import RosWrenchMessage, decode_wrench
from palpate_gateway.wrench.device import Mount, MountOptions, is_measured

_log = logging.getLogger(__name__)

_TACTILE = (BIOTAC_ALL, BIOTAC_HAND)

_LOOK = 20
"""Messages that show which fingers a bag has."""

_BEGAN_ANEW = 10
"""So many messages in a row with an earlier time show that the clock of ROS was set back."""

_FALLS, _AMONG = 3, 20
"""So many numbers that go back, among so many messages, show that the messages are mixed."""


class RosBagOptions(RosFingerOptions):
    """Options of the ``ros_bag`` driver.

    Attributes:
        path: ``NAME.bag`` of ROS 1, or the folder of a bag of ROS 2.
        topic: Topic of the tactile messages; empty = the only one.
        wrench_topic: Topic of the force/torque sensor (``WrenchStamped``); empty = none.
        mount: How the force/torque sensor is mounted.
        wrench_serial: Its serial number to publish; empty = its topic.
    """

    path: Path
    topic: str = ""
    wrench_topic: str = ""
    mount: MountOptions = MountOptions()
    wrench_serial: SerialOption = ""

    @field_validator("topic", "wrench_topic")
    @classmethod
    def _is_topic(cls, value: str) -> str:
        return check_topic_name(value) if value else value


_Decoded = TypeVar("_Decoded", RosHand, RosWrenchMessage)


class BagMessage(NamedTuple):
    """An undecoded message of a bag: its bytes, and when it was recorded [ns since the epoch]."""

    payload: bytes
    recorded_ns: int


class _Timed(NamedTuple, Generic[_Decoded]):
    """A decoded message of a bag, when it was sampled and recorded [ns since the epoch]."""

    message: _Decoded
    time_ns: int
    recorded_ns: int


def _onward(
    messages: Iterable[_Timed[_Decoded]], counts: MutableMapping[str, int]
) -> Iterator[_Timed[_Decoded]]:
    """Messages whose times go on where their clock was set back for good.

    That is counted in ``time_jumps``. One message that was stamped ahead of many is no such clock:
    it is left out, and counted in ``early_messages``. A few earlier ones among later ones stay as
    they are.
    """
    shift_ns = 0
    before: _Timed[_Decoded] | None = None
    last: _Timed[_Decoded] | None = None  # held back until the next one shows that it is right
    earlier: list[_Timed[_Decoded]] = []
    damage: RecordingError | None = None
    try:
        for told in messages:
            one = told._replace(time_ns=told.time_ns + shift_ns)
            if last is None or one.time_ns >= last.time_ns:
                if last is not None:
                    yield last
                yield from earlier
                before, last, earlier = last, one, []
                continue
            earlier.append(one)
            if len(earlier) < _BEGAN_ANEW:
                continue
            if before is not None and earlier[0].time_ns > before.time_ns:
                counts["early_messages"] += 1
            else:
                counts["time_jumps"] += 1
                yield last
                # Only the recorder's clock spans both, also for the other topics of the bag.
                gained_ns = max(earlier[0].recorded_ns - last.recorded_ns, 1)
                back_ns = last.time_ns + gained_ns - earlier[0].time_ns
                shift_ns += back_ns
                earlier = [each._replace(time_ns=each.time_ns + back_ns) for each in earlier]
            earlier.sort(key=lambda each: each.time_ns)
            yield from earlier[:-1]
            before, last, earlier = earlier[-2], earlier[-1], []
    except RecordingError as error:  # after what was held back
        damage = error
    if last is not None:
        yield last
    yield from earlier
    if damage is not None:
        raise damage


class RosBagFile:
    """A bag, read as often as needed.

    Raises:
        RecordingError: It is no bag, or it is damaged.
        MissingExtraError: ``rosbags`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library: Any = require("rosbags.highlevel", extra="gateway")
        with self._opened() as reader:
            self.dialect: Dialect = "cdr" if reader.is2 else "ros1"
            self.topics = {one.topic: str(one.msgtype) for one in reader.connections}
            """Layout of each topic."""
            self._sums = {one.topic: str(one.digest) for one in reader.connections}

    def _opened(self) -> Any:
        if not self.path.exists():
            raise RecordingError(f"{self.path} does not exist", remedy="correct the path")
        try:
            reader = self._library.AnyReader([self.path], default_typestore=typestore("cdr"))
            reader.open()
        except Exception as error:
            raise RecordingError(
                f"{self.path} is no bag of ROS: {error}",
                remedy="name a NAME.bag, or the folder with metadata.yaml; `rosbag reindex` "
                "repairs one whose recorder was killed",
            ) from error
        return _Closed(reader)

    def choose(self, topic: str, layouts: tuple[str, ...]) -> str:
        """The topic, checked; or if it is empty, the only one of these layouts.

        Raises:
            ConfigError: There is none, or several, or its messages are of another kind.
            RecordingError: Its messages are of another version.
        """
        fitting = [name for name, layout in self.topics.items() if layout in layouts]
        listed = ", ".join(f"{name} ({layout})" for name, layout in sorted(self.topics.items()))
        if topic and topic not in fitting:
            raise ConfigError(
                f"{self.path}: {topic} holds no {' or '.join(layouts)}",
                remedy=f"it holds: {listed or 'nothing'}",
            )
        if not topic and len(fitting) != 1:
            raise ConfigError(
                f"{self.path}: {len(fitting)} topics hold {' or '.join(layouts)}",
                remedy=f"name one; it holds: {listed or 'nothing'}",
            )
        topic = topic or fitting[0]
        layout, told = self.topics[topic], self._sums[topic]
        if not self._is_of_this_version(topic):
            raise RecordingError(
                f"{self.path}: {topic} has a {layout} of another version (MD5 {told})",
                remedy=f"palpate reads the version with MD5 {MD5[layout]}; convert the bag",
            )
        return topic

    def readable(self, layouts: tuple[str, ...]) -> list[str]:
        """Topics of these layouts whose messages are of the version that palpate reads."""
        fitting = (name for name, layout in self.topics.items() if layout in layouts)
        return [name for name in fitting if self._is_of_this_version(name)]

    def _is_of_this_version(self, topic: str) -> bool:
        return self.dialect != "ros1" or self._sums[topic] in ("*", "", MD5[self.topics[topic]])

    def messages(self, topic: str) -> Iterator[BagMessage]:
        """Messages of a topic in the order of recording.

        Raises:
            RecordingError: The bag is damaged.
        """
        with self._opened() as reader:
            chosen = [one for one in reader.connections if one.topic == topic]
            try:
                for _, recorded_ns, payload in reader.messages(connections=chosen):
                    yield BagMessage(bytes(payload), int(recorded_ns))
            except Exception as error:
                raise RecordingError(
                    f"{self.path}: {topic} is damaged: {error}",
                    remedy="use what came before, or repair the bag with the tools of ROS",
                ) from error


class _Closed:
    """Closes an open reader, whatever its own ``with`` would open again."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> Any:
        return self._reader

    def __exit__(self, *exc_info: object) -> None:
        self._reader.close()


def fingers_of_bag(path: Path) -> list[tuple[str, int]]:
    """Topic and place of each finger in the first messages of a bag.

    Raises:
        RecordingError: It is no bag.
    """
    bag = RosBagFile(path)
    found: set[tuple[str, int]] = set()
    for topic, layout in bag.topics.items():
        if layout not in _TACTILE:
            continue
        for payload, _ in islice(bag.messages(topic), _LOOK):
            with contextlib.suppress(WireError):
                hand = decode_hand(payload, layout, bag.dialect)
                found |= {(topic, k) for k, one in enumerate(hand.fingers, 1) if one is not None}
    return sorted(found)


class RosBag(FileDevice):
    """One finger of a bag, and the wrench on it if there is one, in the order of their times."""

    options_class = RosBagOptions
    needs = ("rosbags",)

    def __init__(self, options: RosBagOptions) -> None:
        model = f"finger {options.finger} of bag {options.path.name}"
        super().__init__("ros_bag", SensorType.BIOTAC, model, options.rate_hz)
        self._options = options
        self._mount = Mount(options.mount)
        self._track = options.track("")
        self._told = False
        self._counts = dict.fromkeys(
            ("wrenches", "not_finite", "rejected_messages", "repeated_wrenches", "late_wrenches",
             "time_jumps", "early_messages"), 0,
        )  # fmt: skip

    @property
    def counters(self) -> Mapping[str, int]:
        """Readings, messages that are none, and what could not be decoded."""
        jumps = self._track.counters["time_jumps"] + self._counts["time_jumps"]
        return {**self._track.counters, **self._counts, "time_jumps": jumps}

    def _open(self) -> DeviceIdentity:
        options = self._options
        bag = RosBagFile(options.path)
        topic = bag.choose(options.topic, _TACTILE)
        wrench = bag.choose(options.wrench_topic, (WRENCH_STAMPED,)) if options.wrench_topic else ""
        self._track = options.track(bag.topics[topic])
        first, finger = self._first(bag, topic)
        origin_ns = self._origin_ns(bag)
        self._track.begin(origin_ns)
        self._counts = dict.fromkeys(self._counts, 0)
        self._told = False
        streams: list[Iterator[ElectrodeReading | WrenchReading]] = [self._fingers(bag, topic)]
        if wrench:
            streams.append(self._wrenches(bag, wrench, origin_ns))
        self._deliver(heapq.merge(*streams, key=lambda reading: reading.time_s))
        kind = finger.sensor_type
        period_s = first.slot_period_s
        if not first.whole_frames:
            period_s = 1.0 / (options.rate_hz * kind.layout.slots)
        serial = options.serial or finger.serial or f"{options.path.stem}-{options.finger}"
        return DeviceIdentity(
            serial,
            period_s,
            start_wall_ns=origin_ns,
            sensor_type=kind,
            rate_hz=options.rate_hz,
            unfilled=options.unfilled,
        )

    def _first(self, bag: RosBagFile, topic: str) -> tuple[RosHand, RosFinger]:
        """The first message with the finger."""
        places: set[int] = set()
        for hand, _, _ in self._hands(bag, topic):
            finger = self._track.find(hand)
            if finger is not None:
                return hand, finger
            places |= {k for k, one in enumerate(hand.fingers, 1) if one is not None}
        raise RecordingError(
            f"{bag.path}: {topic} has no readings of {self.info.model}",
            remedy=f"it has fingers {sorted(places) or 'none'}; correct finger or serial",
        )

    def _origin_ns(self, bag: RosBagFile) -> int:
        """The earliest first time of all topics, from which every finger of the bag counts.

        The recorder's own times are later: a message comes when it is over.
        """
        streams: list[Iterator[_Timed[Any]]] = [
            *(self._hands(bag, name) for name in bag.readable(_TACTILE)),
            *(self._stamped(bag, name) for name in bag.readable((WRENCH_STAMPED,))),
        ]
        firsts_ns: list[int] = []
        for stream in streams:
            # Damage is an error where it is read from, not in a topic that nobody chose.
            with contextlib.suppress(RecordingError):
                firsts_ns += [one.time_ns for one in islice(stream, 1)]
        return min(firsts_ns)

    def _hands(self, bag: RosBagFile, topic: str) -> Iterator[_Timed[RosHand]]:
        layout = bag.topics[topic]
        for payload, recorded_ns in bag.messages(topic):
            try:
                hand = decode_hand(payload, layout, bag.dialect)
            except WireError:
                self._counts["rejected_messages"] += 1
                continue
            if not hand.time_ns:
                hand = replace(hand, time_ns=recorded_ns, end_ns=recorded_ns)
            yield _Timed(hand, hand.time_ns, recorded_ns)

    def _fingers(self, bag: RosBagFile, topic: str) -> Iterator[ElectrodeReading]:
        before: int | None = None
        falls: deque[int] = deque(maxlen=_FALLS)
        timed = _onward(self._hands(bag, topic), self._counts)
        for number, (hand, time_ns, _) in enumerate(timed):
            # The header of ROS 1 has a number; drivers that do not fill it leave it at 0.
            now, lost = hand.sequence, None
            if before is not None and now is not None:
                if now > before:
                    lost = now - before - 1
                elif 0 < now < before:
                    falls.append(number)
                    # A driver that starts anew falls once, and two swapped messages once.
                    if len(falls) == _FALLS and number - falls[0] < _AMONG:
                        self._disordered(bag, topic)
                        falls.clear()
            before = now
            reading = self._track.take(replace(hand, time_ns=time_ns), lost=lost)
            if reading is not None:
                yield reading

    def _disordered(self, bag: RosBagFile, topic: str) -> None:
        """The numbers of a topic go back: its messages are sorted by a clock that was set back."""
        if not self._told:
            _log.warning(
                "%s: messages of %s are not in the order in which they were sent: the clock of its "
                "recorder was set back, or several programs published them; do not use this part",
                bag.path,
                topic,
            )
        self._told = True
        self._counts["time_jumps"] += 1

    def _stamped(self, bag: RosBagFile, topic: str) -> Iterator[_Timed[RosWrenchMessage]]:
        for payload, recorded_ns in bag.messages(topic):
            try:
                message = decode_wrench(payload, bag.dialect)
            except WireError:
                self._counts["rejected_messages"] += 1
                continue
            yield _Timed(message, message.time_ns or recorded_ns, recorded_ns)

    def _wrenches(self, bag: RosBagFile, topic: str, origin_ns: int) -> Iterator[WrenchReading]:
        serial = self._options.wrench_serial or topic.strip("/").replace("/", "-")
        last_ns = -1
        for message, time_ns, _ in _onward(self._stamped(bag, topic), self._counts):
            if not is_measured(message.values):
                self._counts["not_finite"] += 1
                continue
            if time_ns <= last_ns:
                late = "repeated_wrenches" if time_ns == last_ns else "late_wrenches"
                self._counts[late] += 1
                continue
            last_ns = time_ns
            force, torque = self._mount.on_biotac(np.array(message.values))
            self._counts["wrenches"] += 1
            yield WrenchReading(
                tick=self._counts["wrenches"],
                time_s=(time_ns - origin_ns) * 1e-9,
                force=force,
                torque=torque,
                serial=serial,
            )
