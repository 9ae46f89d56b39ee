"""Reading a record, and recovering one that was cut off or is damaged."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError
from mcap.records import Channel, Metadata, Schema

from palpate.bus.continuity import Holes
from palpate.bus.topics import CONTRACT_VERSION, ROOT, SCHEMAS, TOPICS, StreamAddress, parse_key
from palpate.codec.base import stamp_from_wire
from palpate.errors import ConfigError, RecordingError, WireError, printable
from palpate.files.bounded import open_regular
from palpate.files.mcap_stream import (
    DAMAGED,
    Damage,
    McapMessage,
    NoMcapError,
    OnDamage,
    Part,
    check_summary,
    parts_of,
)
from palpate.files.record_writer import METADATA, RecordWriter
from palpate.messages import Origin

_WALL_STEP_NS = 100_000_000
"""A smaller step of the wall clock is not told [ns]: no time that is shown changes by it."""

DAMAGED_ENDING = ".damaged"
"""Of a record from which all that could be read was recovered: ``NAME.mcap.damaged``."""


@dataclass(frozen=True, slots=True)
class RecordItem:
    """One recorded message.

    Attributes:
        key: Zenoh key it was published on.
        address: Station, sensor and topic of the key.
        schema: Full name of its protobuf message.
        payload: Its bytes.
        log_time_ns: When the recorder received it, wall clock [ns].
        publish_time_ns: Wall clock of its stamp [ns], or of arrival where it has none.
        sequence: Sequence of its stamp (modulo 2^32), or 0.
    """

    key: str
    address: StreamAddress
    schema: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


class SeveralStationsError(RecordingError):
    """A file holds messages of more than one station; their sensors may have the same names."""


def read_record(
    path: Path,
    *,
    allow_partial: bool = False,
    on_damage: OnDamage | None = None,
    any_station: bool = False,
) -> Iterator[RecordItem]:
    """Messages of a record in order of writing.

    With ``allow_partial`` the end may be missing, as of ``NAME.mcap.part``, and what is damaged is
    left out; ``on_damage`` is told of it.

    Args:
        path: The record.
        allow_partial: Whether it may be cut off or damaged.
        on_damage: Is told what is left out.
        any_station: Whether it may hold several stations, as of ``mcap merge``: for those that tell
            sensors apart by the whole key.

    Raises:
        RecordingError: Not a record of palpate, or damaged (after the messages before the damage).
        SeveralStationsError: It holds several (after the messages before the second one).
    """
    streams = _Streams(path, allow_partial=allow_partial, any_station=any_station)
    count = 0
    complete = searched = False
    tell = on_damage or _ignore
    try:
        with open_regular(path) as stream:
            for part in parts_of(stream, tell if allow_partial else None):
                if not isinstance(part, McapMessage):
                    streams.learn(part)
                    continue
                if allow_partial and part.channel_id not in streams.known:
                    # Its chunk is damaged, but a whole file says it once more at its end.
                    if not searched:
                        searched = True
                        streams.learn_all()
                    if part.channel_id not in streams.known:
                        tell(Damage(0, len(part.data), "a message of a stream without name"))
                        continue
                key, address, schema = streams.known[part.channel_id]
                count += 1
                yield RecordItem(
                    key,
                    address,
                    schema,
                    part.data,
                    part.log_time_ns,
                    part.publish_time_ns,
                    part.sequence,
                )
        complete = True
    except RecordingError:  # an OSError, too
        raise
    except FileNotFoundError as error:
        raise RecordingError(f"{path} does not exist", remedy="check the path") from error
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="check the path and the disk",
        ) from error
    except WireError as error:
        raise RecordingError(f"{path}: {error.problem}", remedy=error.remedy) from error
    except NoMcapError as error:
        raise RecordingError(
            f"{path} is no MCAP file", remedy="give a record written by palpate"
        ) from error
    except DAMAGED as error:
        if not (allow_partial and streams.known and isinstance(error, EOFError)):
            raise RecordingError(
                f"{path} is damaged or cut off after {count} messages: "
                f"{printable(str(error)) or type(error).__name__}",
                remedy="recover the whole messages with `palpate recover`",
            ) from error
    if complete and not streams.known and not allow_partial:
        raise RecordingError(
            f"{path} holds no palpate messages", remedy="give a record written by palpate"
        )


def _ignore(damage: Damage) -> None:
    """What is left out is of no interest."""


class _Streams:
    """Streams of a file, as its schemas and channels name them.

    Attributes:
        known: Key, its parts, and the message's full name, by the number of the channel.
    """

    def __init__(self, path: Path, *, allow_partial: bool, any_station: bool) -> None:
        self._path, self._allow_partial, self._any_station = path, allow_partial, any_station
        self._stations: set[str] = set()
        self._schemas: dict[int, Schema] = {}
        self.known: dict[int, tuple[str, StreamAddress, str]] = {}

    def learn(self, part: Part) -> None:
        """Take up a schema or a channel; metadata and messages say nothing.

        Raises:
            RecordingError: The channel is not of palpate, of a contract that is not known, or of a
                second station.
            WireError: Its key is not of this contract.
        """
        if isinstance(part, Schema):
            self._schemas[part.id] = part
        elif isinstance(part, Channel) and part.id not in self.known:
            schema = self._schemas.get(part.schema_id)
            if schema is None and self._allow_partial:
                return  # its chunk may be damaged; the end of a whole file names both once more
            if schema is None or schema.encoding != "protobuf":
                raise RecordingError(
                    f"{self._path}: channel {part.topic!r} has no protobuf schema",
                    remedy="give a record written by palpate",
                )
            if schema.name not in SCHEMAS:
                upgrade = "read it with the palpate that wrote it, or upgrade palpate"
                made_for = schema.name.startswith("foxglove.")  # palpate review --foxglove
                raise RecordingError(
                    f"{self._path}: schema {schema.name!r} is not of contract v{CONTRACT_VERSION}",
                    remedy="open it in Foxglove; palpate reads the record it was made from"
                    if made_for
                    else upgrade,
                )
            address = parse_key(part.topic)
            self._stations.add(address.station)
            if len(self._stations) > 1 and not self._any_station:
                raise SeveralStationsError(
                    f"{self._path} holds the stations {', '.join(sorted(self._stations))}",
                    remedy="give a record of one: mcap filter FILE -o ONE.mcap -y "
                    f"'{ROOT}/{address.station}/.*'",
                )
            self.known[part.id] = part.topic, address, schema.name

    def learn_all(self) -> None:
        """Take up those of the whole file, wherever they are named."""
        with open_regular(self._path) as stream, contextlib.suppress(EOFError):
            for part in parts_of(stream, _ignore):
                self.learn(part)


def only_name(path: Path, topic: str, what: str) -> str:
    """The name under which a record holds a stream; empty if it does not hold it.

    Args:
        path: The record.
        topic: Name of the stream.
        what: What has the name, and the driver's option that chooses one.

    Raises:
        RecordingError: The file is not a record, is damaged before the first message, or holds
            several stations.
        ConfigError: There are several names.
    """
    names: set[str] = set()
    try:
        for item in read_record(path):
            if item.address.topic == topic:
                names.add(item.address.sensor)
    except RecordingError as error:
        # The messages before the damage are delivered, and the error comes after them.
        if not names or isinstance(error, SeveralStationsError):
            raise
    if len(names) > 1:
        raise ConfigError(
            f"{path} holds {len(names)} {what}s: {', '.join(sorted(names))}",
            remedy=f"choose one with the option {what}",
        )
    return names.pop() if names else ""


@dataclass(frozen=True, slots=True)
class RecordSummary:
    """What a record holds.

    Attributes:
        metadata: Facts written at its start.
        counts: Messages by key.
        durations_s: From the first to the last message by key, by the monotonic clock that stamped
            them [s]; a key without such stamps is missing.
        rates_hz: Messages a second by key, by the same clock [Hz]; missing = not known.
        lost: How many messages are missing between those that are there, by their sequence numbers,
            by key of a contiguous topic.
        wall_step_s: By how much the wall clock was set meanwhile, the largest time [s]; 0 = it was
            not.
        start_wall_ns: First log time [ns].
        end_wall_ns: Last log time [ns].
        complete: Whether it was closed whole.
    """

    metadata: Mapping[str, str] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    durations_s: Mapping[str, float] = field(default_factory=dict)
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    wall_step_s: float = 0.0
    start_wall_ns: int = 0
    end_wall_ns: int = 0
    complete: bool = True


def summarise(path: Path) -> RecordSummary:
    """Contents of a record.

    Raises:
        RecordingError: Not a record.
    """
    complete = path.suffix != ".part"
    counts: Counter[str] = Counter()
    stamps = _Stamps()
    start = end = 0
    for item in read_record(path, allow_partial=not complete, any_station=True):
        counts[item.key] += 1
        stamps.take(item)
        start = start or item.log_time_ns
        end = item.log_time_ns
    return RecordSummary(
        metadata_of(path),
        counts,
        {key: 1e-9 * span for key, span in stamps.spans_ns.items()},
        {key: 1e9 * stamps.intervals[key] / span for key, span in stamps.spans_ns.items() if span},
        stamps.holes.lost,
        1e-9 * stamps.wall_step_ns,
        start,
        end,
        complete,
    )


class _Stamps:
    """How long and how whole streams are, by the stamps of their messages.

    Log times are of a wall clock, which may be set, and of arrival, which a busy host delays.

    Attributes:
        spans_ns: Time between messages that follow one another, summed by key [ns].
        intervals: How many such pairs there are, by key.
        wall_step_ns: The largest step of the wall clock against the stamps [ns].
        holes: What is missing of contiguous topics.
    """

    def __init__(self) -> None:
        self.spans_ns: Counter[str] = Counter()
        self.intervals: Counter[str] = Counter()
        self.wall_step_ns = 0
        self.holes = Holes()
        self._last: dict[tuple[str, int], tuple[int, int]] = {}

    def take(self, item: RecordItem) -> None:
        """Take up a message; one that does not decode, or has no stamp, says nothing."""
        try:
            message: Any = SCHEMAS[item.schema].message_type.FromString(item.payload)
        except DecodeError:
            return
        stamp = getattr(message, "stamp", None) or getattr(message, "source", message)
        # A status and a robot's pose have no stamp, but times of one clock.
        clock_id = getattr(stamp, "clock_id", getattr(stamp, "run_id", 0))
        now_ns = getattr(stamp, "monotonic_ns", getattr(stamp, "time_ns", 0))
        topic = TOPICS.get(item.address.topic)
        if topic is not None and topic.contiguous and topic.codec.schema == item.schema:
            with contextlib.suppress(WireError):
                self.holes.take(item.key, stamp_from_wire(stamp), arrived_ns=item.log_time_ns)
        if not now_ns:
            return
        stream = item.key, clock_id
        last_ns, last_wall_ns = self._last.get(stream, (0, 0))
        self._last[stream] = now_ns, stamp.wall_ns
        if not last_ns or now_ns < last_ns:  # of a file that is played again
            return
        self.spans_ns[item.key] += now_ns - last_ns
        self.intervals[item.key] += 1
        # In a replay the wall clock is that of the file, and a pose may come without.
        if getattr(stamp, "origin", Origin.REPLAYED) != Origin.REPLAYED:
            step_ns = (stamp.wall_ns - last_wall_ns) - (now_ns - last_ns)
            if abs(step_ns) > max(abs(self.wall_step_ns), _WALL_STEP_NS):
                self.wall_step_ns = step_ns


def metadata_of(path: Path) -> dict[str, str]:
    """Facts written at the start; empty where the file is too damaged to read them.

    Raises:
        RecordingError: It cannot be read at present.
    """
    try:
        with open_regular(path) as stream:
            for part in parts_of(stream):
                if isinstance(part, Metadata) and part.name == METADATA:
                    return dict(part.metadata)
                if isinstance(part, McapMessage):
                    break
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="check its disk and its rights, and how many files may be open: ulimit -n",
        ) from error
    except DAMAGED:
        return {}
    return {}


def check_readable(path: Path) -> None:
    """Check that the index of a finished record, by which others seek in it, is sound.

    Raises:
        RecordingError: It is not.
    """
    try:
        with open_regular(path) as stream:
            check_summary(stream)
    except (*DAMAGED, OSError) as error:
        raise RecordingError(f"{path}: {error}", remedy="recover it") from error


def is_being_written(part: Path) -> bool:
    """Whether the writer of a part is alive: it holds a lock, which ends with its process.

    Raises:
        RecordingError: The part cannot be opened, or is no regular file.
    """
    try:
        with open_regular(part) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    except ValueError as error:
        raise RecordingError(f"{part}: {error}", remedy="check the path") from error
    except OSError as error:
        raise RecordingError(
            f"{part} cannot be opened: {error.strerror or error}", remedy="check the path"
        ) from error
    return False


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was saved of a record.

    Attributes:
        path: The new record.
        original: Where the damaged one is; None = only its end was missing, and it is removed.
        places: How many places could not be read.
        left_out: Their bytes, as they are in the file.
        first: The first of them.
    """

    path: Path
    original: Path | None = None
    places: int = 0
    left_out: int = 0
    first: Damage | None = None

    def __str__(self) -> str:
        """What was left out, and where the original is; for people."""
        if self.first is None:
            return f"{self.path}: all whole messages" + (
                "" if self.original is None else f"; the original stays: {self.original}"
            )
        return (
            f"{self.path}: {self.left_out:,} bytes could not be read (places: {self.places}), the "
            f"first at byte {self.first.at:,} ({printable(self.first.problem)}); the original is "
            f"kept: {self.original}"
        )


def recover(part: Path) -> Recovery:
    """Write the whole messages of a cut-off or damaged record to ``NAME.recovered.mcap``.

    A ``NAME.mcap.part`` of which only the end is missing is removed; one that is damaged otherwise
    becomes ``NAME.mcap.damaged``. A file of another name stays as it is. After an error nothing of
    the new record is left.

    Raises:
        RecordingError: It is still being written, it is whole, nothing in it can be read, the disk
            refuses the new record, or there is another file of its name.
    """
    if is_being_written(part):
        raise RecordingError(
            f"{part} is being written", remedy="stop its recorder first; it closes the record"
        )
    unfinished = part.name.endswith(".part")
    if not unfinished and _is_whole(part):
        raise RecordingError(
            f"{part} is whole", remedy="there is nothing to recover; use it as it is"
        )
    name = part.name.removesuffix(".part").removesuffix(".mcap")
    target = part.with_name(f"{name}.recovered.mcap")
    # A recovery that was killed after its last step but one has left both.
    if target.exists() and metadata_of(target).get("recovered_from") != part.name:
        raise RecordingError(
            f"{target} exists and would be replaced", remedy="move it away and recover again"
        )
    first_damage: Damage | None = None
    places = left_out = 0

    def on_damage(damage: Damage) -> None:
        nonlocal first_damage, places, left_out
        places, left_out = places + 1, left_out + damage.size
        first_damage = first_damage or damage

    facts = {**metadata_of(part), "recovered_from": part.name}
    items = read_record(part, allow_partial=True, on_damage=on_damage, any_station=True)
    try:
        first = next(items, None)
    except RecordingError as error:
        raise RecordingError(error.problem, remedy="nothing in it can be recovered") from error
    if first is None:
        raise RecordingError(
            f"{part} holds no whole message", remedy="there is nothing to recover; delete it"
        )
    _remove_half(target)  # of an earlier recovery that was killed
    writer = RecordWriter(target, facts)
    try:
        for item in itertools.chain((first,), items):
            writer.write(
                item.key,
                item.schema,
                item.payload,
                log_time_ns=item.log_time_ns,
                publish_time_ns=item.publish_time_ns,
                sequence=item.sequence,
            )
        writer.close()
    except BaseException:
        writer.abandon()
        with contextlib.suppress(OSError):
            _remove_half(target)  # it would keep a full disk full
        raise
    original: Path | None = part
    if unfinished and not places:
        part.unlink()
        original = None
    elif unfinished:
        aside = part.with_name(part.name.removesuffix(".part") + DAMAGED_ENDING)
        if not aside.exists():
            original = part.rename(aside)
    return Recovery(target, original, places, left_out, first_damage)


def _remove_half(target: Path) -> None:
    """Remove a recovery that did not come to its end: its source is all there."""
    half = target.with_name(f"{target.name}.part")
    if half.exists() and not is_being_written(half):
        half.unlink()


def _is_whole(path: Path) -> bool:
    """Whether a finished record can be read to its end, and its index is sound."""
    try:
        summarise(path)
        check_readable(path)
    except RecordingError:
        return False
    return True
