"""Places of slots that carry no number."""

from __future__ import annotations

import math

import numpy as np
from tests.fuzz.streams import pieces

from palpate_gateway.protocols.channels import SEQUENCES
from palpate_gateway.protocols.slot_clock import SlotClock

RATE_HZ = 4400.0
_PERIOD_S = 1.0 / RATE_HZ
_SLOTS_MAX = 350
_NAMES = tuple(SEQUENCES)

Slots = tuple[list[int], list[float]]


def check(data: bytes) -> None:
    """Three bytes choose cuts, sequence, kind of stamps; the others say what befalls a stream."""
    how, which, mode = (*data[:3], 0, 0, 0)[:3]
    sequence = SEQUENCES[_NAMES[which % len(_NAMES)]]
    exact, learns = bool(mode & 1), bool(mode & 2)
    channels, stamps = _stream(data[3:], sequence, exact=exact)

    def clock() -> SlotClock:
        given = None if learns else sequence
        return SlotClock(slot_rate_hz=RATE_HZ, sequence=given, exact=exact)

    one, many = clock(), clock()
    placed, singly = [], []
    at = 0
    for piece in pieces(bytes(len(channels)), how):
        part = slice(at, at + len(piece))
        at += len(piece)
        places = many.place_all(np.array(channels[part], np.int64), np.array(stamps[part]))
        rows = zip(places.run, places.frame, places.position, places.time_s, strict=True)
        placed += [(int(run), int(frame), int(at), float(t)) for run, frame, at, t in rows]
        for channel, stamp_s in zip(channels[part], stamps[part], strict=True):
            place = one.place(channel, stamp_s)
            singly.append(place)
            assert place is None or one.sequence[place.position] == channel
    kept = [(p.run, p.frame, p.position, p.time_s) for p in singly if p is not None]
    assert [row[:3] for row in placed] == [row[:3] for row in kept]
    np.testing.assert_allclose([r[3] for r in placed], [r[3] for r in kept], rtol=0, atol=1e-9)
    assert many.counters == one.counters
    _check_counters(one.counters, len(channels), len(kept))
    _check_places(kept)


def _stream(data: bytes, sequence: tuple[int, ...], *, exact: bool) -> Slots:
    """A steady stream to which things happen: two bytes are a number of slots, and a fate."""
    channels: list[int] = []
    stamps: list[float] = []
    index, late_s, begun_s = 0, 0.0, 10.0
    for count, fate in zip(data[::2], data[1::2], strict=False):
        for _ in range(min(count, _SLOTS_MAX - len(channels))):
            channels.append(sequence[index % len(sequence)])
            stamps.append(begun_s + index * _PERIOD_S + late_s)
            index += 1
            late_s = 0.0 if exact else max(late_s - 0.5 * _PERIOD_S, 0.0)
        if fate < 64:  # slots are lost
            index += fate
        elif fate < 96:  # frames are lost
            index += (fate - 63) * len(sequence)
        elif fate < 128:  # the host stands still, and makes up for it
            late_s += 0.0 if exact else (fate - 95) * 1e-3
        elif fate < 160 and channels:  # slots come twice
            channels += channels[-(fate - 127) :]
            stamps += [stamps[-1]] * (len(channels) - len(stamps))
        elif fate < 192:  # the sender pauses, or its clock begins later
            begun_s += (fate - 159) * 3e-3
        else:  # a channel of another sequence
            channels.append(fate - 192)
            stamps.append(stamps[-1] if stamps else begun_s)
    return channels, stamps


def _check_counters(counters: dict[str, int], slots: int, placed: int) -> None:
    assert min(counters.values()) >= 0
    assert counters["placed"] == placed
    told = ("placed", "unplaced", "foreign", "late")
    assert sum(counters[name] for name in told) == slots


def _check_places(kept: list[tuple[int, int, int, float]]) -> None:
    before: tuple[int, int, int] = (-1, -1, -1)
    for run, frame, position, time_s in kept:
        assert run >= 0
        assert frame >= 0
        assert position >= 0
        assert math.isfinite(time_s)
        assert run >= before[0]
        assert frame >= before[1]  # numbers go on over runs
        before = (run, frame, position)


def seeds() -> list[bytes]:
    """Streams of every kind with every fate."""
    fates = [0, 1, 7, 43, 44, 64, 70, 96, 110, 127, 128, 130, 160, 170, 191, 192, 195, 209, 255]
    stream = b"".join(bytes([130, fate]) for fate in fates)
    kinds = [(which, mode) for which in range(len(_NAMES)) for mode in range(4)]
    return [bytes([7 * which + mode, which, mode]) + stream for which, mode in kinds] + [
        bytes([0, 0, 0]) + bytes([200, 0]) * 4 + bytes([3, 1, 3, 1]),
        bytes([63, 1, 2]) + bytes([200, 0]) * 3 + bytes([40, 200, 4, 97, 255, 0]),
        # Another sequence is learnt while PAC has run ahead over the edge of a frame.
        bytes.fromhex(
            "0017ffffffff2b985b989898989882e89898989198989898985b9898989898989882820004000000"
            "823798983798989891989898989898989898989898989898826040ab"
        ),
        # Another sequence is learnt, and none of it comes.
        bytes.fromhex(
            "9e9e9e9e9e9e9e9e9e9e9e9e9e9e829e9e9e9e9e9e9e9e9e9e1f04827f828082a082aa82bf8282ff"
        ),
        # PAC came twice and ran ahead over the edge: slots of a frame that is over do not go back.
        bytes.fromhex(
            "00000082820082018207822b822c824082468260826e7e807d76838282a082aa82bf82c082c382d382"
        ),
    ]
