"""Channels of a BioTac: ids on the wire, names, and their place in a frame.

A slot is decoded by its channel id, never by its position: makers' tools start a frame with E1 or
with PAC (hardware reference 1.7). Which channels a frame holds is the layout of the sensor's type.
"""

from __future__ import annotations

from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout

PAC = 0
PDC = 1
TAC = 2
TDC = 3
HALL = 15
"""Hall sensor of special models; known, never used."""

FIRST_ELECTRODE = 17
"""Channel id of E1; electrode k has id 16 + k."""

ELECTRODES = BIOTAC_LAYOUT.electrodes
"""Electrodes of the original BioTac."""

ELECTRODES_SP = BIOTAC_SP_LAYOUT.electrodes
"""Electrodes of the BioTac SP."""

SLOTS_PER_FRAME = BIOTAC_LAYOUT.slots
"""E1, PAC, E2, PAC, ..., E19, PAC, PDC, PAC, TAC, PAC, TDC, PAC (hardware reference 1.7)."""

SLOT_RATE_HZ = 4400.0
"""The maker's default slot rate (hardware reference 1.7)."""

# Bits of the original BioTac's channels in ElectrodeFrame.validity.
FIRST_PAC_BIT = BIOTAC_LAYOUT.first_pac_bit
ALL_VALID = BIOTAC_LAYOUT.all_valid

CHANNEL_NAMES: dict[int, str] = {
    PAC: "PAC",
    PDC: "PDC",
    TAC: "TAC",
    TDC: "TDC",
    HALL: "Hall",
    **{FIRST_ELECTRODE + k: f"E{k + 1}" for k in range(ELECTRODES_SP)},
}
"""Name of each channel id that a BioTac or BioTac SP can answer with."""


def channel_name(channel: int) -> str:
    """Name of a channel id, e.g. ``"E7"``; unknown ids are named by their number."""
    return CHANNEL_NAMES.get(channel, f"channel {channel}")


def channels_of(layout: FrameLayout) -> tuple[int, ...]:
    """Channel ids of the electrodes, PDC, TAC and TDC, in order of their validity bits."""
    return (*range(FIRST_ELECTRODE, FIRST_ELECTRODE + layout.electrodes), PDC, TAC, TDC)


def interleaved(layout: FrameLayout, *, pac_first: bool) -> tuple[int, ...]:
    """The maker's sampling round: PAC after each of the other channels, or before."""
    pairs = ((PAC, one) if pac_first else (one, PAC) for one in channels_of(layout))
    return tuple(channel for pair in pairs for channel in pair)


def frame_rate_hz(layout: FrameLayout, slot_rate_hz: float = SLOT_RATE_HZ) -> float:
    """Frames per second at a slot rate."""
    return slot_rate_hz / layout.slots


SEQUENCES: dict[str, tuple[int, ...]] = {
    "biotac_e1_first": interleaved(BIOTAC_LAYOUT, pac_first=False),
    "biotac_pac_first": interleaved(BIOTAC_LAYOUT, pac_first=True),
    "biotac_sp_e1_first": interleaved(BIOTAC_SP_LAYOUT, pac_first=False),
    "biotac_sp_pac_first": interleaved(BIOTAC_SP_LAYOUT, pac_first=True),
    "numatac": (PAC, PDC),
}
"""Sequences of sampling by name (hardware reference 1.7). A stream cannot tell whether its frames
begin with E1 or with PAC: as a cycle both are the same."""
