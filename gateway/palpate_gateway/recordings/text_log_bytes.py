"""Bytes of a vendor log in blocks of whole lines, from a plain or gzip file, never all at once."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

from palpate.errors import RecordingError

_GZIP_MAGIC = b"\x1f\x8b"
_READ_BYTES = 1 << 16
_GZIP_WINDOW = 16 + zlib.MAX_WBITS  # "16 +" makes zlib read the gzip wrapper
_LINE_LIMIT = 1 << 16
"""A longer line is not a line of any log [bytes]."""


class LineBlocks:
    """Whole lines of a log, block by block.

    gzip is recognised by its magic number, not by the name of the file. zlib is driven by hand
    because ``gzip.open`` may withhold bytes it has decompressed when it meets a damaged end.

    Args:
        path: The log.
        block_bytes: Least size of a block, except the last [bytes].
    """

    def __init__(self, path: Path, *, block_bytes: int = 1 << 18) -> None:
        self._path = path
        self._block_bytes = block_bytes
        self.unfinished = b""
        """What follows the last line end; set when the file has been read."""
        self.damage: RecordingError | None = None
        """Why the bytes ended early, if they did; set when the file has been read."""

    def __iter__(self) -> Iterator[bytes]:
        """Yield blocks that end in a newline; then ``unfinished`` and ``damage`` are set."""
        parts: list[bytes] = []
        size = 0
        for chunk in self._chunks():
            parts.append(chunk)
            size += len(chunk)
            if size < self._block_bytes:
                continue
            data = b"".join(parts)
            end = data.rfind(b"\n") + 1
            if not end and len(data) > _LINE_LIMIT:
                break
            if end:
                yield data[:end]
            parts = [data[end:]]
            size = len(data) - end
        data = b"".join(parts)
        end = data.rfind(b"\n") + 1
        if end:
            yield data[:end]
        self.unfinished = data[end:]

    def _chunks(self) -> Iterator[bytes]:
        try:
            with self._path.open("rb") as file:
                data = file.read(_READ_BYTES)
                if not data.startswith(_GZIP_MAGIC):
                    while data:
                        yield data
                        data = file.read(_READ_BYTES)
                    return
                inflate = zlib.decompressobj(_GZIP_WINDOW)
                while data:
                    try:
                        plain = inflate.decompress(data)
                    except zlib.error as error:
                        self.damage = RecordingError(
                            f"{self._path}: the gzip data is damaged ({error})",
                            remedy="copy the file again from its source; the frames before the "
                            "damage were delivered",
                        )
                        return
                    if plain:
                        yield plain
                    data = inflate.unused_data or file.read(_READ_BYTES)
                    if inflate.eof and data:
                        inflate = zlib.decompressobj(_GZIP_WINDOW)
                if not inflate.eof:
                    self.damage = RecordingError(
                        f"{self._path}: the gzip file is truncated",
                        remedy="copy the file again from its source; the frames before the cut "
                        "were delivered",
                    )
        except OSError as error:
            raise RecordingError(
                f"{self._path}: cannot be read ({error.strerror or error})",
                remedy="check the path and that this user may read the file",
            ) from error
