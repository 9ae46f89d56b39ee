"""Reading a record: whole, or what is left of one that was cut off."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from palpate.bus.topics import CONTRACT_VERSION, SCHEMAS, Address, parse_key
from palpate.errors import RecordingError, WireError
from palpate.files.record.writing import METADATA

_RECORD_BYTES_MAX = 64 << 20
# What the MCAP reader raises on bytes that are not MCAP.
_DAMAGED = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    EOFError,
    ValueError,
    LookupError,
    OverflowError,
    MemoryError,
    OSError,
)


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
    address: Address
    schema: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


def read_record(path: Path, *, allow_partial: bool = False) -> Iterator[RecordItem]:
    """Messages of a record in order of writing.

    Args:
        path: ``NAME.mcap``, or with ``allow_partial`` a ``NAME.mcap.part``.
        allow_partial: Accept a file whose end is missing; its whole messages come.

    Raises:
        RecordingError: Not a record of palpate, or damaged (after the messages before the damage).
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, tuple[str, Address, str]] = {}
    count = 0
    complete = False
    try:
        with open(path, "rb") as stream:
            for record in _reader(stream).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    if record.id not in channels:
                        channels[record.id] = _channel(path, record, schemas)
                elif isinstance(record, Message):
                    key, address, schema = channels[record.channel_id]
                    count += 1
                    yield RecordItem(
                        key,
                        address,
                        schema,
                        record.data,
                        record.log_time,
                        record.publish_time,
                        record.sequence,
                    )
        complete = True
    except FileNotFoundError as error:
        raise RecordingError(f"{path} does not exist", remedy="check the path") from error
    except WireError as error:
        raise RecordingError(f"{path}: {error.problem}", remedy=error.remedy) from error
    except _DAMAGED as error:
        if isinstance(error, RecordingError):
            raise
        if not (allow_partial and channels):
            raise RecordingError(
                f"{path} is damaged or cut off after {count} messages: {error or 'end is missing'}",
                remedy="recover the whole messages with `palpate recover`",
            ) from error
    if complete and not channels and not allow_partial:
        raise RecordingError(
            f"{path} holds no palpate messages", remedy="give a record written by palpate"
        )


def _channel(path: Path, channel: Channel, schemas: dict[int, Schema]) -> tuple[str, Address, str]:
    schema = schemas.get(channel.schema_id)
    if schema is None or schema.encoding != "protobuf":
        raise RecordingError(
            f"{path}: channel {channel.topic!r} has no protobuf schema",
            remedy="give a record written by palpate",
        )
    if schema.name not in SCHEMAS:
        raise RecordingError(
            f"{path}: schema {schema.name!r} is not of contract v{CONTRACT_VERSION}",
            remedy="read it with the palpate that wrote it, or upgrade palpate",
        )
    return channel.topic, parse_key(channel.topic), schema.name


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
    counts: dict[str, int] = {}
    start = end = 0
    for item in read_record(path, allow_partial=not complete):
        counts[item.key] = counts.get(item.key, 0) + 1
        start = start or item.log_time_ns
        end = item.log_time_ns
    return RecordSummary(metadata_of(path), counts, start, end, complete)


def _reader(stream: IO[bytes]) -> StreamReader:
    return StreamReader(stream, validate_crcs=True, record_size_limit=_RECORD_BYTES_MAX)


def metadata_of(path: Path) -> dict[str, str]:
    """Facts written at the start; none where the file is too damaged to tell."""
    try:
        with open(path, "rb") as stream:
            for record in _reader(stream).records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    return dict(record.metadata)
                if isinstance(record, Message):
                    break
    except _DAMAGED:
        return {}
    return {}


def check_readable(path: Path) -> None:
    """Check with MCAP's own seeking reader that the index of a finished record is sound.

    Raises:
        RecordingError: It is not.
    """
    try:
        with open(path, "rb") as stream:
            summary = make_reader(stream).get_summary()
    except _DAMAGED as error:
        raise RecordingError(f"{path}: {error}", remedy="recover it") from error
    if summary is None or summary.statistics is None:
        raise RecordingError(f"{path} has no summary", remedy="recover it")
