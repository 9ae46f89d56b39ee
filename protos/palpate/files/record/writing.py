"""Writing a record: small chunks, flushed by time, named ``.part`` until it is whole."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from google.protobuf import descriptor_pb2
from google.protobuf.message import Message as PbMessage
from mcap.writer import CompressionType, Writer

from palpate.bus.topics import CONTRACT_VERSION, SCHEMAS
from palpate.errors import RecordingError, WireError

FLUSH_S = 0.1
"""Messages reach the operating system after this time [s]; kill -9 costs no more than this."""

METADATA = "palpate"
"""Name of the MCAP metadata record that holds the facts of a run."""

_CHUNK_BYTES = 1 << 20


def descriptor_set(message_type: type[PbMessage]) -> bytes:
    """Serialised ``FileDescriptorSet`` of a message's file and its imports: MCAP's schema."""
    files = descriptor_pb2.FileDescriptorSet()
    seen: set[str] = set()

    def add(current: Any) -> None:
        if current.name in seen:
            return
        seen.add(current.name)
        for dependency in current.dependencies:
            add(dependency)
        current.CopyToProto(files.file.add())

    add(message_type.DESCRIPTOR.file)
    return files.SerializeToString()


class RecordWriter:
    """Writes a record. ``write`` and ``flush`` belong to one thread.

    Args:
        path: ``NAME.mcap``; written as ``NAME.mcap.part`` until it is closed whole.
        metadata: Facts about the run, e.g. station and command.

    Raises:
        RecordingError: The file cannot be created or written (full disk, no permission); the
            ``.part`` keeps what was written before.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str] | None = None) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.counts: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._last_flush = time.monotonic()
        self._closed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = open(self.part, "xb")
            # Alive for as long as this process: the kernel drops the lock with it, and recovery
            # leaves a locked part alone. Whoever is looking at it lets go at once.
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
            self._writer.start(profile="", library=f"palpate contract v{CONTRACT_VERSION}")
            facts = {"contract_version": str(CONTRACT_VERSION), **(metadata or {})}
            self._writer.add_metadata(METADATA, facts)
            self._writer.flush()
        except OSError as error:
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
            WireError: A schema that the contract does not know.
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

    @property
    def bytes_written(self) -> int:
        """Size of the file so far [bytes]."""
        return 0 if self._closed else self._file.tell()

    def close(self) -> None:
        """Finish the file and give it its final name.

        Raises:
            RecordingError: The disk is full or gone; the ``.part`` stays.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.part, self.path)
        except OSError as error:
            raise self._failed(error) from error

    def abandon(self) -> None:
        """Close without finishing; the ``.part`` keeps what was flushed and can be recovered."""
        self._closed = True
        try:
            self._file.close()
        except OSError:  # the disk that failed the writer fails the closing too
            return

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"cannot write {self.part}: {error.strerror or error}",
            remedy="free space on that disk or choose another folder; what was flushed is kept",
        )

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
