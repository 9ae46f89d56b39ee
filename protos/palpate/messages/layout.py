"""Layout of an electrode frame by kind of sensor: the one table that all other numbers follow."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """What one sampling round holds; every channel and every PAC sample has one validity bit.

    Bits: electrodes from 0, then PDC, TAC, TDC, then the PAC samples in order of sampling. PAC is
    sampled beside each of the others, so there are as many of it.

    Attributes:
        electrodes: Number of sensing electrodes.
    """

    electrodes: int

    @property
    def pdc_bit(self) -> int:
        """Validity bit of PDC."""
        return self.electrodes

    @property
    def tac_bit(self) -> int:
        """Validity bit of TAC."""
        return self.electrodes + 1

    @property
    def tdc_bit(self) -> int:
        """Validity bit of TDC."""
        return self.electrodes + 2

    @property
    def first_pac_bit(self) -> int:
        """Validity bit of the first PAC sample."""
        return self.electrodes + 3

    @property
    def pac_samples(self) -> int:
        """PAC samples in one frame."""
        return self.electrodes + 3

    @property
    def slots(self) -> int:
        """Samples in one frame, and validity bits."""
        return self.first_pac_bit + self.pac_samples

    @property
    def all_valid(self) -> int:
        """Validity of a frame whose channels are all good."""
        return (1 << self.slots) - 1

    @property
    def electrodes_valid(self) -> int:
        """Validity bits of all electrodes."""
        return (1 << self.electrodes) - 1

    def bit_name(self, bit: int) -> str:
        """Name of the channel at a validity bit, e.g. ``"E1"`` or ``"PAC[3]"``."""
        if bit < self.electrodes:
            return f"E{bit + 1}"
        if bit < self.first_pac_bit:
            return ("PDC", "TAC", "TDC")[bit - self.pdc_bit]
        return f"PAC[{bit - self.first_pac_bit}]"


BIOTAC_LAYOUT = FrameLayout(electrodes=19)
"""44 slots: E1..E19, PDC, TAC, TDC, 22 PAC."""

BIOTAC_SP_LAYOUT = FrameLayout(electrodes=24)
"""54 slots: E1..E24, PDC, TAC, TDC, 27 PAC."""
