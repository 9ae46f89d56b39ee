from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.errors import DeviceError, ErrorCode, RemoteError
from palpate.messages import BIOTAC_LAYOUT, NO_TARE, ElectrodeFrame, Origin, SensorType, Stamp, Tare
from palpate_gateway.protocols.channels import ALL_VALID
from palpate_gateway.tare import TareCollector, TareLedger


def frame(sequence: int, offset: int = 0, validity: int = ALL_VALID) -> ElectrodeFrame:
    return ElectrodeFrame(
        stamp=Stamp(sequence, sequence, 10_000_000 * sequence, 10**18, 7, Origin.SIMULATED),
        sensor_serial="BT1",
        sensor_type=SensorType.BIOTAC,
        electrodes=(np.arange(19) + 2000 + offset).astype(np.uint16),
        pdc=2400 + offset,
        pac=np.full(22, 2040 + offset, np.uint16),
        tac=2050,
        tdc=1900,
        validity=validity,
        slot_period_ns=227_273,
    )


def collect(frames: list[ElectrodeFrame], wanted: int = 10) -> Tare | None:
    collector = TareCollector(wanted)
    for item in frames:
        tare = collector.add(item)
        if tare is not None:
            return tare
    return None


def test_averages_the_wanted_number() -> None:
    tare = collect([frame(k, offset=k % 2) for k in range(1, 11)])
    assert tare is not None
    assert np.allclose(tare.electrodes, np.arange(19) + 2000.5)
    assert np.allclose(tare.electrodes_sd, 0.5)
    assert tare.electrodes.dtype == np.float32
    assert (tare.pdc, tare.pac, tare.tac, tare.tdc) == (2400.5, 2040.5, 2050, 1900)
    assert tare.frames_averaged == 10
    assert tare.stamp.sequence == 10
    assert tare.tare_id != NO_TARE
    assert collect([frame(k) for k in range(1, 10)]) is None


def test_id_is_reproducible_and_differs_between_tares() -> None:
    one, same = (collect([frame(k) for k in range(1, 11)]) for _ in range(2))
    other = collect([frame(k) for k in range(11, 21)])
    assert one is not None
    assert same is not None
    assert other is not None
    assert one.tare_id == same.tare_id != other.tare_id


def test_bad_frames_are_left_out() -> None:
    frames = [frame(k, validity=ALL_VALID & ~1 if k % 3 == 0 else ALL_VALID) for k in range(1, 20)]
    tare = collect(frames)
    assert tare is not None
    assert tare.frames_averaged == 10


def test_invalid_channel_is_named() -> None:
    collector = TareCollector(5)
    bad = frame(1, validity=ALL_VALID & ~(1 << 6) & ~(1 << BIOTAC_LAYOUT.pdc_bit))
    for _ in range(4):
        assert collector.add(bad) is None
    with pytest.raises(DeviceError, match=r"cannot tare BT1: E7, PDC invalid \(5 frames refused\)"):
        collector.add(bad)


def test_touched_electrode_is_named_and_the_next_attempt_may_succeed() -> None:
    collector = TareCollector(10)
    frames = [frame(k) for k in range(1, 11)]
    moving = np.array(frames[-1].electrodes)
    moving[3] -= 400
    frames[-1] = replace(frames[-1], electrodes=moving)
    for item in frames[:-1]:
        assert collector.add(item) is None
    with pytest.raises(DeviceError, match=r"E4 varies by 120 counts .*take everything off"):
        collector.add(frames[-1])
    results = [collector.add(frame(k)) for k in range(11, 21)]
    assert results[:-1] == [None] * 9
    assert results[-1] is not None


def test_ledger() -> None:
    ledger = TareLedger()
    assert ledger.current_id == NO_TARE
    first, second = collect([frame(1)] * 10), collect([frame(2)] * 10)
    assert first is not None
    assert second is not None
    ledger.enter(first)
    ledger.enter(second)
    assert ledger.current_id == second.tare_id
    assert ledger.find(first.tare_id) is first
    with pytest.raises(RemoteError, match="tare 12 is not known to this gateway") as caught:
        ledger.find(12)
    assert caught.value.code is ErrorCode.NOT_FOUND
