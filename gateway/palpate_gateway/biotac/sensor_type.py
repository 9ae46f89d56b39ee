"""BioTac or BioTac SP: by the electrodes that answer, or as the user says.

The serial number does not tell: the public capture of an SP (BTSP...) is sampled as a BioTac, with
19 electrodes in 44 slots (hardware reference 1.7).
"""

from __future__ import annotations

from typing import Literal

from palpate.errors import DeviceError
from palpate.messages import BIOTAC_SP_LAYOUT, SensorType
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.protocols import channels as ch

TypeOption = Literal["auto", "biotac", "biotac_sp"]
"""What a user may say; ``auto`` = by the electrodes that answer."""

LEARNT_FROM = 2 * BIOTAC_SP_LAYOUT.slots
"""Slots that hold a whole frame of either kind, wherever they begin."""


def answering_type(slots: SlotBlock) -> SensorType:
    """The type whose electrodes answer; one that is only asked for them answers by error words."""
    more = (slots.channel >= ch.FIRST_ELECTRODE + ch.ELECTRODES) & slots.good
    return SensorType.BIOTAC_SP if more.any() else SensorType.BIOTAC


def agreed_type(wanted: TypeOption, slots: SlotBlock, what: str) -> SensorType:
    """The type to read a finger as.

    Args:
        wanted: What the user says.
        slots: At least ``LEARNT_FROM`` slots of the finger, unless it ceased to answer.
        what: The finger, for errors.

    Raises:
        DeviceError: The finger answers as another type.
    """
    found = answering_type(slots)
    if wanted in ("auto", found.name.lower()):
        return found
    raise DeviceError(
        f"{what}: sensor_type is {wanted}, but {found.layout.electrodes} electrodes answer",
        remedy=f"set sensor_type = {found.name.lower()!r} or 'auto', or correct what the sender "
        "samples",
    )
