"""What the targets share: streams cut at will, frames with good checks, a plain search for frames.

A target reads the fuzzer's bytes as choices (how to cut, what to seal) and as the stream itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from palpate.errors import PalpateError

Bytes = Callable[[bytes], bytes]


class StreamDecoder(Protocol):
    """What every decoder of a byte stream offers."""

    counters: dict[str, int]

    @property
    def pending(self) -> int: ...

    def feed(self, data: bytes) -> Sequence[Any]: ...


def pieces(stream: bytes, how: int) -> Iterator[bytes]:
    """The stream in pieces of 1 to 64 bytes; ``how`` chooses the sizes, 0 is byte by byte."""
    at = 0
    state = how
    while at < len(stream):
        size = 1 + state % 64
        yield stream[at : at + size]
        at += size
        state = state * 77 % 251


def parts(data: bytes) -> list[bytes]:
    """Messages: each is a byte that tells its length and then as many bytes."""
    found = []
    at = 0
    while at < len(data):
        size = data[at]
        found.append(data[at + 1 : at + 1 + size])
        at += 1 + size
    return found


def sealed(data: bytes, seal: Callable[[int, bytes], bytes]) -> bytes:
    """A stream of the parts: so the fuzzer gets past checksums, which it cannot guess.

    An odd first byte makes a part a frame with good checks, an even one sends it as it is.
    """
    out = bytearray()
    for part in parts(data):
        out += seal(part[0], part[1:]) if part and part[0] & 1 else part[1:]
    return bytes(out)


def has_remedy(error: PalpateError) -> None:
    """An error says what to do, and does not print the file."""
    assert error.remedy
    assert len(str(error)) < 1000


def same_in_pieces(
    make: Callable[[], StreamDecoder],
    stream: bytes,
    how: int,
    *,
    key: Callable[[Any], Any] = lambda records: records,
) -> tuple[StreamDecoder, list[Any]]:
    """A decoder that was fed the stream, and its records: the same however the stream is cut."""
    whole = make()
    records = list(whole.feed(stream))
    cut = make()
    again = [record for piece in pieces(stream, how) for record in cut.feed(piece)]
    assert key(again) == key(records)
    assert cut.counters == whole.counters
    assert cut.pending == whole.pending
    assert min(whole.counters.values()) >= 0
    return whole, records


def plain_search(
    stream: bytes, lengths: Mapping[bytes, int], is_good: Callable[[bytes], bool]
) -> list[bytes]:
    """Frames of a whole stream, byte by byte: what ``framing.FrameFinder`` must find in pieces."""
    frames = []
    at = 0
    while at < len(stream):
        length = next((n for head, n in lengths.items() if stream.startswith(head, at)), 0)
        if length > len(stream) - at:
            break
        frame = stream[at : at + length]
        if length and is_good(frame):
            frames.append(frame)
            at += length
        else:
            at += 1
    return frames


def all_counted(decoder: StreamDecoder, taken: int, stream: bytes) -> None:
    """Every byte is in a record, junk or pending; a reset makes junk of what is pending."""
    assert taken + decoder.counters["junk_bytes"] + decoder.pending == len(stream)
    if hasattr(decoder, "reset"):
        decoder.reset()
        assert decoder.pending == 0
        assert taken + decoder.counters["junk_bytes"] == len(stream)
