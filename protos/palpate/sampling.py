"""When each channel of a frame was sampled: a round takes 10 ms, and PAC has 22 instants in it.

A frame's stamp is the instant of its first slot; slot k follows k slot periods later. E1..E19, PDC,
TAC, TDC stand in this order with PAC beside each of them, before or behind it. A frame does
not say which: frames that palpate reads live begin with E1 unless configured otherwise, those of
logs as the log has them. The wrong choice shifts all instants by one slot (227 us).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.messages import ElectrodeFrame, FrameLayout, Origin

Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SampleTimes:
    """Instants of one frame's channels since its stamp [ns].

    Attributes:
        electrodes: Of E1, E2, ... [ns], int64, shape ``(E,)``.
        pac: In order of sampling [ns], int64, shape ``(P,)``.
    """

    electrodes: Times
    pdc: int
    tac: int
    tdc: int
    pac: Times

    @property
    def middle_ns(self) -> int:
        """Mean instant of the electrodes [ns]: where one wrench for all of them belongs."""
        return round(float(np.mean(self.electrodes - self.electrodes[0]))) + int(self.electrodes[0])


def slots_of(layout: FrameLayout, *, pac_first: bool = False) -> Times:
    """Slot of each channel in order of the validity bits, int64, shape ``(slots,)``.

    With ``pac_first`` the round begins with PAC instead of E1.
    """
    others = 2 * np.arange(layout.first_pac_bit) + pac_first
    pac = 2 * np.arange(layout.pac_samples) + (not pac_first)
    return np.concatenate([others, pac]).astype(np.int64)


def is_polled(frame: ElectrodeFrame) -> bool:
    """Whether a board polled every channel once, e.g. a PIC32: one PAC sample, no grid of slots."""
    pac = frame.validity >> frame.sensor_type.layout.first_pac_bit
    return pac == 1


def sample_offsets(frame: ElectrodeFrame, *, pac_first: bool = False) -> SampleTimes:
    """When each channel was sampled, since the frame's stamp [ns].

    A polled frame has offsets of 0: when in its 10 ms each channel was polled is not known. So have
    the electrodes, PDC, TAC and TDC of a simulated one, which are computed for its stamp.
    """
    layout = frame.sensor_type.layout
    offsets = slots_of(layout, pac_first=pac_first) * frame.slot_period_ns
    if is_polled(frame):
        offsets[:] = 0
    elif frame.stamp.origin is Origin.SIMULATED:
        offsets[: layout.first_pac_bit] = 0
    return SampleTimes(
        offsets[: layout.electrodes],
        int(offsets[layout.pdc_bit]),
        int(offsets[layout.tac_bit]),
        int(offsets[layout.tdc_bit]),
        offsets[layout.first_pac_bit :],
    )
