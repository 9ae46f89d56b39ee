"""Slots to frames, whatever is lost, doubled or of bad parity."""

from __future__ import annotations

import numpy as np
from tests.fuzz.streams import pieces

from palpate.gateway.biotac.frames import FrameAssembler
from palpate.gateway.biotac.slots import SlotBlock
from palpate.gateway.protocols import channels as ch
from palpate.gateway.readings import ElectrodeReading
from palpate.protos.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT

_PERIOD_S = 1.0 / 4400.0


def check(data: bytes) -> None:
    """Two bytes choose cuts and kind; each pair of bytes is a number of slots, and a fate."""
    how, mode = (*data[:2], 0, 0)[:2]
    layout = BIOTAC_SP_LAYOUT if mode & 1 else BIOTAC_LAYOUT
    sequence = ch.interleaved(layout, pac_first=bool(mode & 2))
    block = _slots(data[2:], sequence, placed=bool(mode & 4))
    whole, cut = FrameAssembler(_PERIOD_S, layout), FrameAssembler(_PERIOD_S, layout)
    readings = whole.push(block) + whole.finish()
    again: list[ElectrodeReading] = []
    at = 0
    for piece in pieces(bytes(len(block)), how):
        again += cut.push(block.part(at, at + len(piece)))
        at += len(piece)
    again += cut.finish()
    assert cut.counters["samples"] == whole.counters["samples"] == len(block)
    assert whole.pending_slots == cut.pending_slots == 0
    assert min(whole.counters.values()) >= 0
    assert whole.counters["frames"] == len(readings)
    assert sum(one.missed_before for one in readings) == whole.counters["missing_frames"]
    for one in (*readings, *again):
        _check_reading(one, layout.electrodes, layout.pac_samples, layout.slots)
    for run in (readings, again):
        ticks = [one.tick for one in run]
        assert ticks == sorted(set(ticks))


def _check_reading(one: ElectrodeReading, electrodes: int, pac: int, bits: int) -> None:
    assert (len(one.electrodes), len(one.pac)) == (electrodes, pac)
    assert 0 <= one.validity < 1 << bits
    # A value tells its channel, so a wrong place shows; PAC tells its place in the round.
    for k in range(electrodes):
        if one.validity >> k & 1:
            assert one.electrodes[k] == 100 * (ch.FIRST_ELECTRODE + k)
    for k, (name, value) in enumerate(((ch.PDC, one.pdc), (ch.TAC, one.tac), (ch.TDC, one.tdc))):
        if one.validity >> electrodes + k & 1:
            assert value == 100 * name
    for k in range(pac):
        if one.validity >> electrodes + 3 + k & 1:
            assert one.pac[k] == 1 + k


def _slots(data: bytes, sequence: tuple[int, ...], *, placed: bool) -> SlotBlock:
    rows: list[tuple[int, int, bool, float, int, int, int]] = []
    index = 0
    for count, fate in zip(data[::2], data[1::2], strict=False):
        for _ in range(count % 128):
            frame, position = divmod(index, len(sequence))
            channel = sequence[position]
            value = 1 + position // 2 if channel == ch.PAC else 100 * channel
            at = position if placed else -1
            rows.append((channel, value, True, index * _PERIOD_S, 0, frame, at))
            index += 1
        if fate < 128:  # slots are lost
            index += fate
        elif fate < 160 and rows:  # the last is of bad parity
            rows[-1] = (rows[-1][0], 0, False, *rows[-1][3:])
        elif fate < 192 and not placed:  # a channel that nobody knows
            rows.append((60, 5, True, index * _PERIOD_S, 0, index // len(sequence), -1))
        elif rows and placed:  # it came twice
            rows.append(rows[-1])
    columns = list(zip(*rows, strict=True)) or [()] * 7
    kinds = (np.int64, np.uint16, np.bool_, np.float64, np.int64, np.int64, np.int64)
    return SlotBlock(*(np.array(c, kind) for c, kind in zip(columns, kinds, strict=True)))


def seeds() -> list[bytes]:
    """Whole frames, and every fate, of every kind."""
    fates = [0, 1, 2, 43, 44, 45, 54, 100, 130, 160, 200, 255]
    stream = b"".join(bytes([50, fate]) for fate in fates)
    return [bytes([11 * mode, mode]) + bytes([108, 0]) + stream for mode in range(8)]
