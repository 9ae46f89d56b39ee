"""When each channel was sampled, by type of sensor and order of the round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.messages import ElectrodeFrame, Origin, SensorType, Stamp
from palpate.sampling import is_polled, sample_offsets, slots_of

SLOT_NS = 227_273
START_NS = 5_000_000_000


def frame(kind: SensorType = SensorType.BIOTAC, origin: Origin = Origin.LIVE) -> ElectrodeFrame:
    layout = kind.layout
    return ElectrodeFrame(
        stamp=Stamp(1, 1, START_NS, 10**18, 7, origin),
        sensor_serial="s1",
        sensor_type=kind,
        electrodes=np.full(layout.electrodes, 2000, np.uint16),
        pdc=2000,
        pac=np.full(layout.pac_samples, 2040, np.uint16),
        tac=2045,
        tdc=1914,
        validity=layout.all_valid,
        slot_period_ns=SLOT_NS,
    )


@pytest.mark.parametrize("kind", list(SensorType))
@pytest.mark.parametrize("pac_first", [False, True])
def test_every_slot_of_a_round_is_somebodys(kind: SensorType, pac_first: bool) -> None:
    slots = slots_of(kind.layout, pac_first=pac_first)
    assert sorted(slots) == list(range(kind.layout.slots))
    first = "PAC[0]" if pac_first else "E1"
    assert kind.layout.bit_name(int(np.argmin(slots))) == first


def test_offsets_of_a_biotac_are_those_of_the_makers_order() -> None:
    offsets = sample_offsets(frame())
    # E1 PAC E2 PAC ... E19 PAC PDC PAC TAC PAC TDC PAC
    assert offsets.electrodes.tolist() == [2 * k * SLOT_NS for k in range(19)]
    assert (offsets.pdc, offsets.tac, offsets.tdc) == (38 * SLOT_NS, 40 * SLOT_NS, 42 * SLOT_NS)
    assert offsets.pac.tolist() == [(2 * k + 1) * SLOT_NS for k in range(22)]
    assert offsets.middle_ns == 18 * SLOT_NS


def test_pac_first_is_a_slot_later_for_all_others() -> None:
    usual, other = sample_offsets(frame()), sample_offsets(frame(), pac_first=True)
    assert (other.electrodes - usual.electrodes == SLOT_NS).all()
    assert (other.pac - usual.pac == -SLOT_NS).all()


def test_a_biotac_sp_has_54_slots() -> None:
    offsets = sample_offsets(frame(SensorType.BIOTAC_SP))
    assert len(offsets.electrodes) == 24
    assert offsets.pac[-1] == 53 * SLOT_NS
    assert offsets.pdc == 48 * SLOT_NS


def test_of_a_polled_frame_and_of_a_simulated_one_nothing_is_pretended() -> None:
    layout = SensorType.BIOTAC.layout
    polled = replace(frame(), validity=(1 << (layout.first_pac_bit + 1)) - 1)
    assert is_polled(polled)
    assert not is_polled(frame())
    assert not is_polled(replace(frame(), validity=layout.electrodes_valid))
    assert not sample_offsets(polled).electrodes.any()
    simulated = sample_offsets(frame(origin=Origin.SIMULATED))
    assert not simulated.electrodes.any()
    assert simulated.pdc == 0
    assert simulated.pac[1] == 3 * SLOT_NS
