"""Records that try to fill the memory, to take for ever, to lie or to act on the terminal."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode

from palpate.bus.topics import ELECTRODES, SCHEMAS, sensor_key
from palpate.files.record_writer import METADATA, RecordWriter, descriptor_set

Case = Callable[[Path], None]

MAGIC = b"\x89MCAP0\r\n"
SCHEMA = ELECTRODES.codec.schema
KEY = sensor_key("lab", "finger", "electrodes")
NOW_NS = 1_763_769_600_000_000_000


def _record(opcode: int, content: bytes, *, says: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if says is None else says) + content


def _text(text: str) -> bytes:
    code = text.encode()
    return struct.pack("<I", len(code)) + code


def _schema(number: int = 1, name: str = SCHEMA, data: bytes | None = None) -> bytes:
    code = descriptor_set(SCHEMAS[SCHEMA].message_type) if data is None else data
    content = struct.pack("<H", number) + _text(name) + _text("protobuf")
    return _record(Opcode.SCHEMA, content + struct.pack("<I", len(code)) + code)


def _channel(number: int = 1, key: str = KEY) -> bytes:
    content = struct.pack("<HH", number, 1) + _text(key) + _text("protobuf") + struct.pack("<I", 0)
    return _record(Opcode.CHANNEL, content)


def _message(data: bytes = b"x", *, time_ns: int = NOW_NS) -> bytes:
    return _record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 1, time_ns, time_ns) + data)


def _chunk(packed: bytes, says: int, compression: str = "zstd") -> bytes:
    content = struct.pack("<QQQI", NOW_NS, NOW_NS, says, 0) + _text(compression)
    return _record(Opcode.CHUNK, content + struct.pack("<Q", len(packed)) + packed)


def _metadata(facts: dict[str, str]) -> bytes:
    pairs = b"".join(_text(key) + _text(value) for key, value in facts.items())
    return _record(Opcode.METADATA, _text(METADATA) + struct.pack("<I", len(pairs)) + pairs)


def _end(summary: bytes = b"", before: int = 0) -> bytes:
    start = before if summary else 0
    footer = struct.pack("<QQI", start, 0, 0)
    return summary + _record(Opcode.FOOTER, footer) + MAGIC


def _file(*parts: bytes, end: bytes | None = None) -> bytes:
    head = MAGIC + _record(Opcode.HEADER, _text("") + _text("hostile"))
    data_end = _record(Opcode.DATA_END, struct.pack("<I", 0))
    return head + b"".join(parts) + data_end + (_end() if end is None else end)


def _zeros(size: int) -> bytes:
    """A frame of zstd that expands to zeros, packed piece by piece."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    piece = bytes(1 << 24)
    parts = [packer.compress(piece) for _ in range(size >> 24)]
    return b"".join([*parts, packer.flush()])


def _silent(size: int) -> bytes:
    """The same without its size at the begin."""
    packer = zstandard.ZstdCompressor(level=1, write_content_size=False).compressobj()
    piece = bytes(1 << 24)
    parts = [packer.compress(piece) for _ in range(size >> 24)]
    return b"".join([*parts, packer.flush()])


def _lz4_zeros(size: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    piece = bytes(1 << 24)
    parts = [packer.begin(), *(packer.compress(piece) for _ in range(size >> 24)), packer.flush()]
    return b"".join(parts)


def _of_records(records: bytes) -> bytes:
    return _chunk(zstandard.compress(records), len(records))


def _bytes(make: Callable[[], bytes]) -> Case:
    return lambda path: _put(path, make())


def _put(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _sparse(path: Path) -> None:
    path.write_bytes(_file(end=b""))
    with open(path, "r+b") as file:
        file.truncate(100 << 30)


def _sparse_attachment(path: Path) -> None:
    """An attachment that says it has 90 GB, in a file that has them and an end, but no messages."""
    attachment = _record(Opcode.ATTACHMENT, b"", says=90 << 30)
    with open(path, "wb") as file:
        file.write(_file(attachment, end=b""))
        file.seek((90 << 30) - 13, 1)
        file.write(_record(Opcode.DATA_END, bytes(4)) + _end())


def write_good(path: Path) -> None:
    """A record with nothing wrong: the control."""
    with RecordWriter(path, {"station": "lab"}) as writer:
        for number in range(100):
            writer.write(KEY, SCHEMA, bytes(100), log_time_ns=NOW_NS + number, sequence=number)


def _good() -> bytes:
    return _schema() + _channel() + _message()


def _cut(path: Path) -> None:
    write_good(path)
    path.write_bytes(path.read_bytes()[:-30])


def _spoilt_index(path: Path) -> None:
    """A whole record whose footer sends the reader of the summary into the data."""
    write_good(path)
    data = path.read_bytes()
    path.write_bytes(data[:-28] + struct.pack("<Q", 8) + data[-20:])


def _many(records: Iterable[bytes]) -> bytes:
    return _file(_of_records(_good()), *records)


def _indices(count: int) -> bytes:
    one = struct.pack("<QQQQIQ", NOW_NS, NOW_NS, 8, 8, 0, 0) + _text("") + struct.pack("<QQ", 8, 8)
    return _record(Opcode.CHUNK_INDEX, one) * count


CASES: dict[str, Case] = {
    "chunk of 4 GB of zeros": _bytes(lambda: _file(_chunk(_zeros(4 << 30), 4 << 30))),
    "chunk that says 1 kB, expands to 4 GB": _bytes(lambda: _file(_chunk(_zeros(4 << 30), 1000))),
    "chunk without sizes, expands to 4 GB": _bytes(
        lambda: _file(_chunk(_silent(4 << 30), 1 << 20))
    ),
    "chunk that says 8 EB": _bytes(lambda: _file(_chunk(b"", 2**63))),
    "LZ4 chunk that expands to 4 GB": _bytes(
        lambda: _file(_chunk(_lz4_zeros(4 << 30), 1 << 20, "lz4"))
    ),
    "400 chunks of 30 MB": _bytes(lambda: _many([_of_records(_message(bytes(30 << 20)))] * 400)),
    "a million empty messages in a chunk": _bytes(
        lambda: _many([_of_records(_message(b"") * 1_000_000)] * 20)
    ),
    "chunk of a million unknown records": _bytes(
        lambda: _many([_of_records(_record(0x80, b"") * 1_000_000)] * 20)
    ),
    "chunk in a chunk": _bytes(lambda: _many([_of_records(_of_records(_good()))])),
    "record that says 1 EB": _bytes(lambda: _many([_record(Opcode.MESSAGE, b"", says=2**60)])),
    "schema of 30 MB in a chunk": _bytes(
        lambda: _file(_of_records(_schema(data=bytes(30 << 20))), _of_records(_good() * 3))
    ),
    "60,000 channels": _bytes(
        lambda: _file(
            _of_records(_schema() + b"".join(_channel(k, f"{KEY}") for k in range(1, 60_000)))
        )
    ),
    "metadata of 200 MB": _bytes(lambda: _file(_metadata({"a": "x" * (200 << 20)}))),
    "attachment of 90 GB": _sparse_attachment,
    "zeros to 100 GB": _sparse,
    "cut off": _cut,
    "summary in the data": _spoilt_index,
    "600,000 indices": _bytes(
        lambda: _file(_of_records(_good()), end=_end(_indices(600_000), before=400))
    ),
    "time in the year 2554": _bytes(
        lambda: _file(_of_records(_good() + _message(time_ns=2**64 - 1)))
    ),
    "escapes in a key": _bytes(
        lambda: _file(_of_records(_schema() + _channel(key="lab/\x1b[2J/x") + _message()))
    ),
    "escapes in a schema's name": _bytes(
        lambda: _file(_of_records(_schema(name="\x1b]0;owned\x07") + _channel() + _message()))
    ),
    "channel without schema": _bytes(lambda: _file(_of_records(_channel() + _message()))),
    "message without channel": _bytes(lambda: _file(_of_records(_schema() + _message()))),
    "unknown compression": _bytes(lambda: _file(_chunk(b"x", 1, "\x1b[31m"))),
    "wrong checksum": _bytes(
        lambda: _file(
            _of_records(_good()).replace(
                struct.pack("<QQQI", NOW_NS, NOW_NS, len(_good()), 0),
                struct.pack("<QQQI", NOW_NS, NOW_NS, len(_good()), zlib.crc32(b"other")),
            )
        )
    ),
    "random bytes": _bytes(
        lambda: MAGIC + np.random.default_rng(1).integers(0, 256, 100_000, np.uint8).tobytes()
    ),
    "no MCAP at all": _bytes(lambda: b"%PDF-1.4\n" * 1000),
}
"""What is wrong, and the function that writes it."""
