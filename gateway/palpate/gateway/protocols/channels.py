"""Channels of a BioTac: ids on the wire, names, and their place in a 44-slot frame.

A slot is decoded by its channel id, never by its position: makers' tools start a frame with E1 or
with PAC (hardware reference 1.7).
"""

from __future__ import annotations

from palpate.protos.messages import PAC_SAMPLES

PAC = 0
PDC = 1
TAC = 2
TDC = 3
HALL = 15
"""Hall sensor of special models; known, never used."""

FIRST_ELECTRODE = 17
"""Channel id of E1; electrode k has id 16 + k."""

ELECTRODES = 19
"""Electrodes of the original BioTac."""

ELECTRODES_SP = 24
"""Electrodes of the BioTac SP."""

SLOTS_PER_FRAME = 44
"""E1, PAC, E2, PAC, ..., E19, PAC, PDC, PAC, TAC, PAC, TDC, PAC (hardware reference 1.7)."""

SLOT_RATE_HZ = 4400.0
"""The maker's default slot rate (hardware reference 1.7)."""

# Places of the channels in ElectrodeFrame.validity: electrodes from bit 0, PDC, TAC, TDC, PAC.
PDC_BIT = ELECTRODES
TAC_BIT = ELECTRODES + 1
TDC_BIT = ELECTRODES + 2
FIRST_PAC_BIT = ELECTRODES + 3
ALL_VALID = (1 << (FIRST_PAC_BIT + PAC_SAMPLES)) - 1

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


def bit_name(bit: int) -> str:
    """Name of the channel at a validity bit, e.g. ``"E1"`` or ``"PAC[3]"``."""
    if bit < ELECTRODES:
        return f"E{bit + 1}"
    if bit < FIRST_PAC_BIT:
        return ("PDC", "TAC", "TDC")[bit - PDC_BIT]
    return f"PAC[{bit - FIRST_PAC_BIT}]"
