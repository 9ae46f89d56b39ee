"""The record: an MCAP file of raw payloads with their schemas embedded (docs/adr/0006-record.md).

A record that is being written, or whose writer was killed, is named ``NAME.mcap.part``; it becomes
``NAME.mcap`` when it is closed whole. Keys, payload bytes and stamps are kept as they came, so a
replay can be bit-identical.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from google.protobuf import descriptor_pb2
from google.protobuf.message import Message as PbMessage
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, ChunkIndex, Metadata, Schema
from mcap.writer import CompressionType, Writer

from palpate.bus.topics import CONTRACT_VERSION, SCHEMAS, StreamAddress, parse_key
from palpate.errors import ConfigError, RecordingError, WireError, printable
from palpate.files.bounded import open_regular
from palpate.files.mcap_stream import (
    CHANNELS_MAX,
    DAMAGED,
    Damage,
    McapMessage,
    OnDamage,
    Part,
    check_summary,
    parts_of,
)

FLUSH_S = 0.1
"""Messages reach the operating system after this time [s]; kill -9 costs no more than this."""

METADATA = "palpate"
"""Name of the MCAP metadata record that holds the facts of a run."""

DAMAGED_ENDING = ".damaged"
"""Of a record from which all that could be read was recovered: ``NAME.mcap.damaged``."""

_CHUNK_BYTES = 1 << 20

_INDICES = "_Writer__chunk_indices"


def descriptor_set(message_type: type[PbMessage]) -> bytes:
    """Serialised ``FileDescriptorSet`` of a message's file and its imports: MCAP's schema."""
    files = descriptor_pb2.FileDescriptorSet()
    _add_file(files, message_type.DESCRIPTOR.file, set())
    return files.SerializeToString()


# A function of its own: one within `descriptor_set` that calls itself is a cycle of references.
# Each kept 20 kB until the collector came, which took hours; a recorder grew by 4 MB/h.
def _add_file(files: descriptor_pb2.FileDescriptorSet, current: Any, seen: set[str]) -> None:
    if current.name in seen:
        return
    seen.add(current.name)
    for dependency in current.dependencies:
        _add_file(files, dependency, seen)
    current.CopyToProto(files.file.add())


class _ChunkIndices:
    """The index of chunks while a record is written: in a nameless file, instead of in memory."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())

    def __iter__(self) -> Iterator[_Encoded]:
        """All indices so far, in pieces that the writer copies to the end of its file."""
        self._file.seek(0)
        while data := self._file.read(_CHUNK_BYTES):
            yield _Encoded(data)

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True, slots=True)
class _Encoded:
    """Records that are already encoded."""

    data: bytes

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self.data)


class RecordGone(RecordingError):
    """The file of a record was removed, replaced or moved away while it was written.

    Attributes:
        lost: Messages that are lost with it; 0 = it was moved, and holds them where it is now.
    """

    def __init__(self, problem: str, *, remedy: str, lost: int) -> None:
        super().__init__(problem, remedy=remedy)
        self.lost = lost


class RecordWriter:
    """Writes a record. ``write`` and ``flush`` belong to one thread.

    Args:
        path: ``NAME.mcap``; written as ``NAME.mcap.part`` until it is closed whole.
        metadata: Facts about the run, e.g. station and command.

    Raises:
        RecordingError: The file cannot be created or written (full disk, no permission); nothing is
            left of it.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str] | None = None) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.counts: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._last_flush = time.monotonic()
        self._closed = False
        self._broken: RecordingError | None = None  # why a write failed, perhaps half-way
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = open(self.part, "xb")
            # The kernel drops the lock when this process ends, and recovery refuses a locked part.
            # Waiting for the lock is short: others hold it only to test it.
            fcntl.flock(self._file, fcntl.LOCK_EX)
        except FileExistsError as error:
            raise RecordingError(
                f"{self.part} exists: a record of this name is being written or was cut off",
                remedy="choose another name, or recover it with `palpate recover`",
            ) from error
        except OSError as error:
            raise self._failed(error) from error
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        try:
            self._indices = _ChunkIndices(path.parent)
            # It keeps an object of 1 kB for each chunk until the end: 50 MB an hour. No option
            # changes that; a test of the memory fails if a later version names it otherwise.
            setattr(self._writer, _INDICES, self._indices)
            self._writer.start(profile="", library=f"palpate contract v{CONTRACT_VERSION}")
            facts = {"contract_version": str(CONTRACT_VERSION), **(metadata or {})}
            self._writer.add_metadata(METADATA, facts)
            self._writer.flush()
        except OSError as error:
            with contextlib.suppress(OSError):  # its buffer may fail once more
                self._file.close()
            with contextlib.suppress(OSError):
                self.part.unlink()  # nothing of the run is in it; a service tries every second
            raise self._failed(error) from error

    def write(
        self,
        key: str,
        schema: str,
        payload: bytes,
        *,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Add a message; flushes when ``FLUSH_S`` has passed since the last time.

        Raises:
            WireError: A schema that the contract does not know, or one stream too many.
            RecordingError: The disk is full or gone.
        """
        channel = self._channels.get((key, schema))
        try:
            if channel is None:
                channel = self._register(key, schema)
            self._writer.add_message(
                channel,
                log_time=log_time_ns,
                data=payload,
                publish_time=log_time_ns if publish_time_ns is None else publish_time_ns,
                sequence=sequence & 0xFFFFFFFF,
            )
        except OSError as error:
            raise self._failed(error) from error
        self.counts[key] = self.counts.get(key, 0) + 1
        # MCAP gathers messages in a chunk and writes it when it is full, which at a low rate takes
        # minutes. Flushing by time bounds what a killed recorder loses.
        if time.monotonic() - self._last_flush >= FLUSH_S:
            self.flush()

    def _register(self, key: str, schema: str) -> int:
        codec = SCHEMAS.get(schema)
        if codec is None:
            raise WireError(
                f"schema {schema!r} is not of contract v{CONTRACT_VERSION}",
                remedy="record with the palpate that knows it",
                reason="schema",
            )
        if len(self._channels) >= CHANNELS_MAX:
            raise WireError(
                f"{self.part} has {CHANNELS_MAX} streams, no more are recorded",
                remedy="see who invents names of sensors: palpate topic list",
                reason="channels",
            )
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(
                schema, "protobuf", descriptor_set(codec.message_type)
            )
        channel = self._writer.register_channel(key, "protobuf", self._schemas[schema])
        self._channels[key, schema] = channel
        return channel

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            RecordingError: The disk is full or gone.
        """
        try:
            self._writer.flush()
        except OSError as error:
            raise self._failed(error) from error
        self._last_flush = time.monotonic()

    def check_place(self) -> None:
        """Check that the ``.part`` is still the file that is written.

        Raises:
            RecordGone: It is not; the writer can only be abandoned.
            RecordingError: The disk is full or gone.
        """
        own = os.fstat(self._file.fileno())
        try:
            if os.path.samestat(own, self.part.stat()):
                return
        except (FileNotFoundError, NotADirectoryError):
            pass
        except OSError as error:
            raise self._failed(error) from error
        count = sum(self.counts.values())
        if own.st_nlink:
            self.flush()
            self._broken = RecordGone(
                f"{self.part} was moved away while it was written, with {count:,} messages",
                remedy="recover it where it is now: palpate recover",
                lost=0,
            )
        else:
            self._broken = RecordGone(
                f"{self.part} was removed while it was written: {count:,} messages are lost",
                remedy="leave a folder alone while something records to it",
                lost=count,
            )
        raise self._broken

    @property
    def bytes_written(self) -> int:
        """Size of the file so far [bytes]."""
        return 0 if self._closed else self._file.tell()

    def close(self) -> None:
        """Finish the file and give it its final name.

        Raises:
            RecordingError: The disk is full or gone, or an earlier write has failed: half of that
                write may stand in the file, which must not look whole. The ``.part`` stays.
            RecordGone: The ``.part`` is another file now, or none.
        """
        if self._closed:
            return
        if self._broken is not None:
            raise self._broken
        self.check_place()
        self._closed = True
        try:
            self._writer.finish()
            self._indices.close()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.part, self.path)
        except OSError as error:
            raise self._failed(error) from error

    def abandon(self) -> None:
        """Close without finishing; the ``.part`` keeps what was flushed and can be recovered."""
        self._closed = True
        for file in (self._indices, self._file):
            with contextlib.suppress(OSError):  # the disk that failed the writer fails here too
                file.close()

    def _failed(self, error: OSError) -> RecordingError:
        self._broken = RecordingError(
            f"cannot write {self.part}: {error.strerror or error}",
            remedy="free space on that disk or choose another folder; what was flushed is kept",
        )
        return self._broken

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()


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


def read_record(
    path: Path, *, allow_partial: bool = False, on_damage: OnDamage | None = None
) -> Iterator[RecordItem]:
    """Messages of a record in order of writing.

    With ``allow_partial`` the end may be missing, as of ``NAME.mcap.part``, and what is damaged is
    left out; ``on_damage`` is told of it.

    Raises:
        RecordingError: Not a record of palpate, or damaged (after the messages before the damage).
    """
    streams = _Streams(path, allow_partial=allow_partial)
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
    except FileNotFoundError as error:
        raise RecordingError(f"{path} does not exist", remedy="check the path") from error
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="check the path and the disk",
        ) from error
    except WireError as error:
        raise RecordingError(f"{path}: {error.problem}", remedy=error.remedy) from error
    except DAMAGED as error:
        if isinstance(error, RecordingError):
            raise
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

    def __init__(self, path: Path, *, allow_partial: bool) -> None:
        self._path, self._allow_partial = path, allow_partial
        self._schemas: dict[int, Schema] = {}
        self.known: dict[int, tuple[str, StreamAddress, str]] = {}

    def learn(self, part: Part) -> None:
        """Take up a schema or a channel; metadata and messages say nothing.

        Raises:
            RecordingError: The channel is not of palpate, or of a contract that is not known.
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
                raise RecordingError(
                    f"{self._path}: schema {schema.name!r} is not of contract v{CONTRACT_VERSION}",
                    remedy="read it with the palpate that wrote it, or upgrade palpate",
                )
            self.known[part.id] = part.topic, parse_key(part.topic), schema.name

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
        RecordingError: The file is not a record, or is damaged before the first message.
        ConfigError: There are several names.
    """
    names: set[str] = set()
    try:
        for item in read_record(path):
            if item.address.topic == topic:
                names.add(item.address.sensor)
    except RecordingError:
        # The messages before the damage are delivered, and the error comes after them.
        if not names:
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
        start_wall_ns: First log time [ns].
        end_wall_ns: Last log time [ns].
        complete: Whether it was closed whole.
    """

    metadata: Mapping[str, str] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
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
    start = end = 0
    for item in read_record(path, allow_partial=not complete):
        counts[item.key] += 1
        start = start or item.log_time_ns
        end = item.log_time_ns
    return RecordSummary(metadata_of(path), counts, start, end, complete)


def metadata_of(path: Path) -> dict[str, str]:
    """Facts written at the start; empty where the file is too damaged to read them."""
    try:
        with open_regular(path) as stream:
            for part in parts_of(stream):
                if isinstance(part, Metadata) and part.name == METADATA:
                    return dict(part.metadata)
                if isinstance(part, McapMessage):
                    break
    except (*DAMAGED, OSError):
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
        RecordingError: The part cannot be opened.
    """
    try:
        with open(part, "rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
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
    becomes ``NAME.mcap.damaged``. A file of another name stays as it is.

    Raises:
        RecordingError: It is still being written, it is whole, nothing in it can be read, or there
            is another file of the new record's name.
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
    items = read_record(part, allow_partial=True, on_damage=on_damage)
    try:
        first = next(items, None)
    except RecordingError as error:
        raise RecordingError(error.problem, remedy="nothing in it can be recovered") from error
    if first is None:
        raise RecordingError(
            f"{part} holds no whole message", remedy="there is nothing to recover; delete it"
        )
    with RecordWriter(target, facts) as writer:
        for item in itertools.chain((first,), items):
            writer.write(
                item.key,
                item.schema,
                item.payload,
                log_time_ns=item.log_time_ns,
                publish_time_ns=item.publish_time_ns,
                sequence=item.sequence,
            )
    original: Path | None = part
    if unfinished and not places:
        part.unlink()
        original = None
    elif unfinished:
        aside = part.with_name(part.name.removesuffix(".part") + DAMAGED_ENDING)
        if not aside.exists():
            original = part.rename(aside)
    return Recovery(target, original, places, left_out, first_damage)


def _is_whole(path: Path) -> bool:
    """Whether a finished record can be read to its end, and its index is sound."""
    try:
        summarise(path)
        check_readable(path)
    except RecordingError:
        return False
    return True
