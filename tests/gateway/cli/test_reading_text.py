from __future__ import annotations

import numpy as np
import pytest

from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout
from palpate_gateway.cli.streams import text_of, values_of
from palpate_gateway.readings import ElectrodeReading


def reading(layout: FrameLayout, *, lost: tuple[int, ...] = ()) -> ElectrodeReading:
    validity = layout.all_valid
    pac = np.arange(layout.pac_samples, dtype=np.uint16) + 2000
    for bit in lost:
        validity &= ~(1 << bit)
        if bit >= layout.first_pac_bit:
            pac[bit - layout.first_pac_bit] = 0
    electrodes = np.arange(layout.electrodes, dtype=np.uint16) + 3001
    return ElectrodeReading(7, 0.1, 0, electrodes, 1300, pac, 2050, 1912, validity)


@pytest.mark.parametrize(
    ("layout", "names", "last"),
    [
        (BIOTAC_LAYOUT, ["E1..E10", "E11..E19"], 2021),
        (BIOTAC_SP_LAYOUT, ["E1..E10", "E11..E20", "E21..E24"], 2026),
    ],
)
def test_every_electrode_is_shown(layout: FrameLayout, names: list[str], last: int) -> None:
    *lines, others = text_of(reading(layout))
    assert [line.split()[0] for line in lines] == names
    shown = [int(word) for line in lines for word in line.split()[1:]]
    assert shown == [3001 + k for k in range(layout.electrodes)]
    assert others == f"PDC 1300  TAC 2050  TDC 1912  PAC 2000..{last} [counts]"


def test_what_is_not_valid_is_named_and_not_taken_for_a_value() -> None:
    lost = (3, BIOTAC_SP_LAYOUT.first_pac_bit)
    lines = text_of(reading(BIOTAC_SP_LAYOUT, lost=lost))
    assert lines[-2].endswith("PAC 2001..2026 [counts]")
    assert lines[-1] == "not valid: E4, PAC[0]"
    polled = text_of(reading(BIOTAC_LAYOUT, lost=tuple(range(22, 44))))
    assert polled[-2].endswith("PAC none [counts]")
    assert polled[-1].endswith("PAC[4], PAC[5] and 16 more")


def test_values_of_an_sp() -> None:
    values = values_of(reading(BIOTAC_SP_LAYOUT))
    assert (len(values["electrodes"]), len(values["pac"])) == (24, 27)
    assert values["validity"] == 2**54 - 1
