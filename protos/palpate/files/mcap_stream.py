"""Reads the parts of an MCAP file one after another, each within bounds.

A file of a stranger may say that a record has a petabyte, or expand to a thousand times its size.
So every size is checked before anything is read or expanded, and what all chunks together expand to
is bounded by the size of the file. At no time more than one chunk is in memory.

Errors are ``ValueError`` with what is wrong and where, and ``EOFError`` where the file ends early;
bytes that are no MCAP may raise any of `DAMAGED`. Whoever wants to save what is left of a damaged
file is told of each place that cannot be read, and reading goes on behind it.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import IO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Metadata, Schema, Statistics

CHUNK_BYTES_MAX = 32 << 20
"""Size of a chunk, packed and expanded [bytes]; palpate's have 1 MiB and one message."""

CHANNELS_MAX = 4096
"""Channels, and schemas, of a file: twenty for each of two hundred sensors."""

_FREE_BYTES = 64 << 20
_RATIO_MAX = 4000  # true fields of an untouched finger, which are zeros: 1000; measured data: 3
_MESSAGE_COST = 2560  # bytes; an empty message takes time, too. The index alone has 16 for each

_BYTES_MAX = {
    Opcode.HEADER: 64 << 10,
    Opcode.FOOTER: 64,
    Opcode.SCHEMA: 1 << 20,
    Opcode.CHANNEL: 64 << 10,
    Opcode.MESSAGE: CHUNK_BYTES_MAX,
    Opcode.CHUNK: CHUNK_BYTES_MAX,
    Opcode.METADATA: 1 << 20,
    Opcode.STATISTICS: 1 << 20,
    Opcode.CHUNK_INDEX: 1 << 20,
}
"""Largest record of each kind that is read [bytes]; others are passed over without being read."""

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_LENGTH = struct.Struct("<Q")
_MESSAGE = struct.Struct("<HIQQ")
_TIME_MAX_NS = 2**63  # the year 2262; later ones do not fit the arrays of times
_END_BYTES = _HEAD.size + 20 + len(_MAGIC)  # footer and magic
_PASSED_OVER_MAX = CHUNK_BYTES_MAX  # of one record, where a file is known to be damaged [bytes]
_PACKED_CHUNK = re.compile(rb"\x06.{36}(?:\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4)", re.DOTALL)
_CHUNK_FIELDS_BYTES = 28 + 4 + 8  # beside its compression's name and its data
_CHUNK_HEAD_BYTES = _HEAD.size + 28 + 8  # as far as the expression looks
_LOOK_FIRST, _LOOK_BYTES = 1 << 12, 1 << 20
_LOOK_MAX = 1 << 30  # how far the next chunk behind a damage is looked for [bytes]

DAMAGED = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    EOFError,
    ValueError,
    LookupError,
    OverflowError,
    MemoryError,
    RuntimeError,  # of LZ4
)
"""What the reader raises on bytes that are not MCAP."""


class _BoundError(ValueError):
    """A whole file exceeds a bound, so that to read on would be what the bound forbids."""


class NoMcapError(ValueError):
    """The file does not begin as MCAP does: there is nothing to recover."""


class Damage(NamedTuple):
    """A place of a file that cannot be read: where it begins, its bytes, and what is wrong."""

    at: int
    size: int
    problem: str


OnDamage = Callable[[Damage], None]


class McapMessage(NamedTuple):
    """A message: channel, sequence, log and publish time [ns], payload."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


Part = Schema | Channel | McapMessage | Metadata


def parts_of(file: IO[bytes], on_damage: OnDamage | None = None) -> Iterator[Part]:
    """Schemas, channels, messages and metadata in order of writing; schemas without their data.

    With ``on_damage`` what cannot be read is told to it, and the chunks behind it are read, too.

    Raises:
        NoMcapError: It is no MCAP file.
        ValueError: It exceeds a bound or, without ``on_damage``, is damaged or holds another number
            of messages or chunks than its statistics say.
        EOFError: The end is missing.
    """
    budget = _Budget(os.fstat(file.fileno()).st_size)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise NoMcapError("it is no MCAP file")
    for opcode, data, at in _records(file, on_damage):
        if opcode == Opcode.FOOTER:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise EOFError("the end is missing")
            return
        if opcode == Opcode.STATISTICS and on_damage is None:
            budget.compare(Statistics.read(ReadDataStream(BytesIO(data))))
        try:
            if on_damage is not None and opcode == Opcode.MESSAGE and budget.chunks:
                # Else a flipped bit makes a message of an index.
                raise ValueError(f"a message at byte {at:,} stands outside of the chunks")
            yield from _parts(opcode, data, at, budget)
        except DAMAGED as error:
            if on_damage is None or isinstance(error, _BoundError):
                raise
            on_damage(Damage(at, _HEAD.size + len(data), str(error) or type(error).__name__))


def _parts(opcode: int, data: bytes, at: int, budget: _Budget) -> Iterator[Part]:
    if opcode == Opcode.CHUNK:
        budget.chunks += 1
        yield from _of_chunk(_chunk(data, at), at, budget)
    elif opcode == Opcode.METADATA:
        yield Metadata.read(ReadDataStream(BytesIO(data)))
    elif (part := _part(opcode, data, at, budget)) is not None:
        yield part


def _part(opcode: int, data: bytes, at: int, budget: _Budget) -> Part | None:
    """A record of a kind that stands in chunks, too; None = of another kind."""
    if opcode == Opcode.MESSAGE:
        budget.messages += 1
        budget.spend(_MESSAGE_COST, at)
        return _message(data, at)
    if opcode == Opcode.SCHEMA:
        return budget.schema(data, at)
    if opcode == Opcode.CHANNEL:
        return budget.channel(data, at)
    return None


def check_summary(file: IO[bytes]) -> None:
    """Check that the index at the end of a finished file is there, whole, and points into it.

    Raises:
        ValueError: It does not.
        EOFError: It is missing.
    """
    size = file.seek(0, os.SEEK_END)
    if size < 2 * len(_MAGIC) + _END_BYTES:
        raise EOFError("the end is missing")
    file.seek(size - _END_BYTES)
    opcode, data, _ = next(_records(file))
    if opcode != Opcode.FOOTER or file.read(len(_MAGIC)) != _MAGIC:
        raise EOFError("the end is missing")
    footer = Footer.read(ReadDataStream(BytesIO(data)))
    start = footer.summary_start
    if not len(_MAGIC) < start < size - _END_BYTES:
        raise ValueError("it has no summary")
    file.seek(start)
    # Of a record of hours it has tens of megabytes; its sum is what follows.
    left, crc = size - len(_MAGIC) - 4 - start, 0
    while left > 0 and (block := file.read(min(left, _LOOK_BYTES))):
        left, crc = left - len(block), zlib.crc32(block, crc)
    if footer.summary_crc not in (0, crc):
        raise ValueError(f"the checksum of its index, from byte {start:,}, is wrong")
    file.seek(start)
    statistics: Statistics | None = None
    chunks = 0
    for opcode, data, at in _records(file):
        if opcode == Opcode.FOOTER:
            break
        if opcode == Opcode.STATISTICS:
            statistics = Statistics.read(ReadDataStream(BytesIO(data)))
        elif opcode == Opcode.CHUNK_INDEX:
            index = ChunkIndex.read(ReadDataStream(BytesIO(data)))
            chunks += 1
            if index.chunk_start_offset + index.chunk_length > start:
                raise ValueError(f"an index at byte {at:,} points behind the data")
    if statistics is None:
        raise ValueError("it has no statistics")
    if statistics.chunk_count != chunks:
        raise ValueError(f"it has {statistics.chunk_count} chunks and {chunks} indices of chunks")


class _Budget:
    """What may still be expanded, and the channels, schemas, chunks and messages so far."""

    def __init__(self, file_bytes: int) -> None:
        self._allowed = _FREE_BYTES + _RATIO_MAX * file_bytes
        self._left = self._allowed
        self._schemas: set[int] = set()
        self._channels: set[int] = set()
        self.chunks = self.messages = 0

    def spend(self, size: int, at: int) -> None:
        self._left -= size
        if self._left < 0:
            raise _BoundError(
                f"its chunks expand to more than {self._allowed:,} bytes, found at byte {at:,}"
            )

    def compare(self, statistics: Statistics) -> None:
        """Compare the file's statistics with what was read: a chunk may have been passed over."""
        for what, said, read in (
            ("messages", statistics.message_count, self.messages),
            ("chunks", statistics.chunk_count, self.chunks),
        ):
            if said != read:
                raise ValueError(f"its statistics say {said:,} {what}, and {read:,} can be read")

    def schema(self, data: bytes, at: int) -> Schema:
        found = Schema.read(ReadDataStream(BytesIO(data)))
        _note(self._schemas, found.id, "schemas", at)
        return Schema(id=found.id, data=b"", encoding=found.encoding, name=found.name)

    def channel(self, data: bytes, at: int) -> Channel:
        found: Channel = Channel.read(ReadDataStream(BytesIO(data)))
        _note(self._channels, found.id, "channels", at)
        return found


def _note(known: set[int], number: int, what: str, at: int) -> None:
    known.add(number)
    if len(known) > CHANNELS_MAX:
        raise _BoundError(f"it has more than {CHANNELS_MAX} {what}, found at byte {at:,}")


def _records(
    file: IO[bytes], on_damage: OnDamage | None = None
) -> Iterator[tuple[int, bytes, int]]:
    """Opcode, content and place of each record; content only of the kinds in ``_BYTES_MAX``."""
    file_bytes = os.fstat(file.fileno()).st_size
    while True:
        at = file.tell()
        try:
            found = _record(file, file_bytes, on_damage)
        except (ValueError, EOFError) as error:
            if on_damage is None:
                raise
            behind = _next_chunk(file, at + 1)
            if behind is not None or not isinstance(error, EOFError):
                size = (file_bytes if behind is None else behind) - at
                on_damage(Damage(at, size, str(error)))
            if behind is None:
                raise EOFError("the end is missing") from error
            file.seek(behind)
            continue
        if found is not None:
            yield *found, at


def _record(
    file: IO[bytes], file_bytes: int, on_damage: OnDamage | None
) -> tuple[int, bytes] | None:
    """Opcode and content of the next record; None = passed over."""
    at = file.tell()
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise EOFError("the end is missing")
    opcode, size = _HEAD.unpack(head)
    inner = None if on_damage is None else _inner_size(file, head)
    agree = inner == size
    if on_damage is not None and inner is not None:
        if opcode != Opcode.CHUNK:
            on_damage(Damage(at, 1, f"the chunk at byte {at:,} says that it is of kind {opcode}"))
            opcode = Opcode.CHUNK
        if not agree:
            on_damage(Damage(at, 1, f"the chunk at byte {at:,} says two lengths"))
            size = inner
    if opcode == 0:
        raise ValueError(f"there is no record at byte {at:,}")
    most = _BYTES_MAX.get(opcode)
    allowed = most or (file_bytes if on_damage is None else _PASSED_OVER_MAX)
    if size > allowed:
        raise ValueError(
            f"the record at byte {at:,} says that it has {size:,} bytes, {allowed:,} are allowed"
        )
    if on_damage is not None and not agree:
        # Each head of a chunk is looked at, or one wrong length would hide good chunks.
        if _next_chunk(file, at + 1, at + _HEAD.size + size) is not None:
            raise ValueError(f"the record at byte {at:,} reaches over a chunk by its length")
        file.seek(at + _HEAD.size)
    if most is None:
        # Attachments and indices; to read them would take as long as they say they are.
        file.seek(size, os.SEEK_CUR)
        return None
    # Else thousands of heads that say so would each have the rest of the file read.
    data = file.read(size) if size <= file_bytes - at else b""
    if len(data) < size:
        raise EOFError("the end is missing")
    return opcode, data


def _inner_size(file: IO[bytes], head: bytes) -> int | None:
    """Bytes of a record that begins as a packed chunk, whatever its head says; None = of another.

    They follow from the length of the packed data.
    """
    at = file.tell()
    begin = b"\x06" + head[1:] + file.read(_CHUNK_HEAD_BYTES + _LENGTH.size - len(head))
    file.seek(at)
    found = _PACKED_CHUNK.match(begin)
    if found is None or len(begin) < found.end() + _LENGTH.size:
        return None
    (packed,) = _LENGTH.unpack_from(begin, found.end())
    return found.end() + _LENGTH.size - _HEAD.size + int(packed)


def _next_chunk(file: IO[bytes], start: int, end: int | None = None) -> int | None:
    """Where the next packed chunk begins by its looks; whether it is one, its checksum tells."""
    kept, at, step = b"", start, _LOOK_FIRST
    end = start + _LOOK_MAX if end is None else end
    file.seek(start)
    while at < end and (block := file.read(min(step, end + _CHUNK_HEAD_BYTES - at))):
        data, step = kept + block, min(2 * step, _LOOK_BYTES)
        for found in _PACKED_CHUNK.finditer(data):
            _, size = _HEAD.unpack_from(data, found.start())
            if size <= CHUNK_BYTES_MAX and at + found.start() < end:
                return at + found.start()
        kept = data[-64:]  # the head of a chunk may lie across two blocks
        at += len(data) - len(kept)
    return None


def _chunk(data: bytes, at: int) -> Chunk:
    chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(data)))
    if chunk.uncompressed_size > CHUNK_BYTES_MAX:
        raise ValueError(
            f"the chunk at byte {at:,} says that it expands to {chunk.uncompressed_size:,} bytes, "
            f"{CHUNK_BYTES_MAX:,} are allowed"
        )
    if _CHUNK_FIELDS_BYTES + len(chunk.compression) + len(chunk.data) != len(data):
        raise ValueError(f"the chunk at byte {at:,} says two lengths")
    return chunk


def _of_chunk(chunk: Chunk, at: int, budget: _Budget) -> Iterator[Part]:
    budget.spend(chunk.uncompressed_size, at)
    data = _expanded(chunk, at)
    place, end = 0, len(data)
    while place < end:
        if end - place < _HEAD.size:
            raise ValueError(f"the chunk at byte {at:,} ends within a record")
        opcode, size = _HEAD.unpack_from(data, place)
        place += _HEAD.size
        if size > end - place:
            raise ValueError(f"a record in the chunk at byte {at:,} is longer than the chunk")
        content = data[place : place + size]
        place += size
        part = _part(opcode, content, at, budget)
        if part is None:
            raise ValueError(f"the chunk at byte {at:,} holds a record of kind {opcode}")
        yield part


def _message(content: bytes, at: int) -> McapMessage:
    if len(content) < _MESSAGE.size:
        raise ValueError(f"a message at byte {at:,} is too short")
    channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(content)
    if max(log_time_ns, publish_time_ns) >= _TIME_MAX_NS:
        raise ValueError(f"a message at byte {at:,} is of the time {log_time_ns} ns")
    return McapMessage(channel, sequence, log_time_ns, publish_time_ns, content[_MESSAGE.size :])


def _expanded(chunk: Chunk, at: int) -> bytes:
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        # As a stream, which allocates no more than is asked for, whatever the packed data say.
        unpacker = zstandard.ZstdDecompressor(max_window_size=CHUNK_BYTES_MAX)
        with unpacker.stream_reader(chunk.data) as reader:
            data = reader.read(size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"the chunk at byte {at:,} is packed by {chunk.compression[:20]!r}")
    if len(data) != size:
        raise ValueError(
            f"the chunk at byte {at:,} says that it expands to {size:,} bytes, and does not"
        )
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError(f"the checksum of the chunk at byte {at:,} is wrong")
    return data
