"""BioTac or BioTac SP: what answers decides, and what the user says is checked against it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.gateway.reading_devices import read_frames
from tests.gateway.single_slots import Slot, slot_block

from palpate.errors import ConfigError, DeviceError
from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout, SensorType
from palpate_gateway.biotac.finger import LEARNT_FROM, agreed_type, answering_type
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.device import Device
from palpate_gateway.drivers import make_device
from palpate_gateway.protocols import channels as ch


def slots_of(layout: FrameLayout, *, deaf: bool = False) -> SlotBlock:
    """Slots from the middle of a frame on; ``deaf`` = by a finger that knows 19 electrodes only."""
    order = ch.interleaved(layout, pac_first=True) * 4
    slots = [
        Slot(channel, 2000, not (deaf and channel >= 36), 0.0, 0, k // layout.slots, 0)
        for k, channel in enumerate(order)
    ]
    return slot_block(slots[30 : 30 + LEARNT_FROM])


def test_what_answers_decides() -> None:
    assert answering_type(slots_of(BIOTAC_LAYOUT)) is SensorType.BIOTAC
    assert answering_type(slots_of(BIOTAC_SP_LAYOUT)) is SensorType.BIOTAC_SP
    # Beside an SP on one line: it is asked for E20 to E24, and answers by error words.
    assert answering_type(slots_of(BIOTAC_SP_LAYOUT, deaf=True)) is SensorType.BIOTAC
    assert agreed_type("biotac", slots_of(BIOTAC_LAYOUT), "it") is SensorType.BIOTAC
    assert agreed_type("auto", slots_of(BIOTAC_SP_LAYOUT), "it") is SensorType.BIOTAC_SP


def test_what_the_user_says_is_checked() -> None:
    with pytest.raises(DeviceError, match="sensor_type is biotac, but 24 electrodes answer"):
        agreed_type("biotac", slots_of(BIOTAC_SP_LAYOUT), "it")
    with pytest.raises(DeviceError, match="but 19 electrodes answer -> set sensor_type = 'biotac'"):
        agreed_type("biotac_sp", slots_of(BIOTAC_LAYOUT), "it")


def test_a_pic32_board_polls_no_sp() -> None:
    device = make_device("biotac_pic32", {"port": "/dev/ttyUSB7", "sensor_type": "biotac"})
    assert device.info.sensor_type is SensorType.BIOTAC
    with pytest.raises(ConfigError, match=r"ttyUSB7: its record holds 19 electrodes.* biotac_can"):
        make_device("biotac_pic32", {"port": "/dev/ttyUSB7", "sensor_type": "biotac_sp"})


@pytest.mark.parametrize("pac_first", [False, True])
def test_an_sp_on_can(emulate: Any, finger: Callable[..., Device], pac_first: bool) -> None:
    emulate(electrodes=24, pac_first=pac_first)
    layout = SensorType.BIOTAC_SP.layout
    for options in ({"port": 1}, {"port": 2, "sensor_type": "biotac_sp"}):
        device = finger(**options)
        device.open()
        assert device.identity.sensor_type is device.info.sensor_type is SensorType.BIOTAC_SP
        assert device.info.rate_hz == pytest.approx(4400 / 54)
        whole = [
            one
            for one in read_frames(device, lambda got: len(got) >= 5)
            if one.validity == layout.all_valid
        ]
        assert whole
        for one in whole:
            assert (one.electrodes.shape, one.pac.shape) == ((24,), (27,))
            np.testing.assert_array_equal(one.electrodes, whole[0].electrodes)


def test_a_wrong_type_is_refused_by_name(emulate: Any, finger: Callable[..., Device]) -> None:
    emulate(electrodes=24)
    with pytest.raises(DeviceError, match="port 1: sensor_type is biotac, but 24 electrodes"):
        finger(port=1, sensor_type="biotac").open()
    # Another finger of the line is free to be read as it is.
    device = finger(port=2)
    device.open()
    assert device.info.sensor_type is SensorType.BIOTAC_SP


def test_biotac_on_can_stays_one(emulate: Any, finger: Callable[..., Device]) -> None:
    emulate()
    device = finger(port=1)
    assert device.info.sensor_type is SensorType.BIOTAC
    device.open()
    assert device.info.sensor_type is SensorType.BIOTAC
    assert device.info.rate_hz == 100.0
    with pytest.raises(DeviceError, match="sensor_type is biotac_sp, but 19 electrodes answer"):
        finger(port=2, sensor_type="biotac_sp").open()
