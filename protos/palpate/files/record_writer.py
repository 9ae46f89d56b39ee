"""The record: an MCAP file of raw payloads with their schemas embedded (docs/adr/0006-record.md).

A record that is being written, or whose writer was killed, is named ``NAME.mcap.part``; it becomes
``NAME.mcap`` when it is closed whole. Keys, payload bytes and stamps are kept as they came, so a
replay can be bit-identical.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from google.protobuf import descriptor_pb2
from google.protobuf.message import Message as PbMessage
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from palpate.bus.topics import CONTRACT_VERSION, SCHEMAS
from palpate.errors import RecordingError, WireError
from palpate.files.mcap_stream import CHANNELS_MAX

FLUSH_S = 0.1
"""Messages reach the operating system after this time [s]; kill -9 costs no more than this."""

METADATA = "palpate"
"""Name of the MCAP metadata record that holds the facts of a run."""

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
