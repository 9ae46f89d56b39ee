"""Slots to frames, whatever is lost, doubled or of bad parity."""

from __future__ import annotations

import numpy as np
from tests.fuzz.streams import pieces

from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading

_PERIOD_S = 1.0 / 4400.0
_SLOTS_MAX = 400


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
    for run in (readings, again):
        learnt = False
        for one in run:
            _check_reading(one, layout, pac_is_sure=learnt)
            learnt |= one.validity == layout.all_valid
        ticks = [one.tick for one in run]
        assert ticks == sorted(set(ticks))


def _check_reading(one: ElectrodeReading, layout: FrameLayout, *, pac_is_sure: bool) -> None:
    assert (len(one.electrodes), len(one.pac)) == (layout.electrodes, layout.pac_samples)
    assert 0 <= one.validity <= layout.all_valid
    good = [bool(one.validity >> bit & 1) for bit in range(layout.slots)]
    # A value tells its channel, so a wrong place shows; PAC tells its place in the round.
    for k, value in enumerate(one.electrodes.tolist()):
        assert not good[k] or value == 100 * (ch.FIRST_ELECTRODE + k)
    slow = ((layout.pdc_bit, ch.PDC, one.pdc), (layout.tac_bit, ch.TAC, one.tac))
    for bit, name, value in (*slow, (layout.tdc_bit, ch.TDC, one.tdc)):
        assert not good[bit] or value == 100 * name
    # Before the first whole frame it is a guess whether the round begins with PAC.
    for k, value in enumerate(one.pac.tolist()):
        assert not (pac_is_sure and good[layout.first_pac_bit + k]) or value == 1 + k


def _slots(data: bytes, sequence: tuple[int, ...], *, placed: bool) -> SlotBlock:
    rows: list[tuple[int, int, bool, float, int, int, int]] = []
    index = 0
    for count, fate in zip(data[::2], data[1::2], strict=False):
        for _ in range(min(count, _SLOTS_MAX - len(rows))):
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
