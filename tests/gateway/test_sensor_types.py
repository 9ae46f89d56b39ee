"""A BioTac SP through the pipeline, and a finger that is exchanged for one of another type."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from tests.gateway.pipelines import pushed

from palpate.codec import ELECTRODE_FRAME, TARE
from palpate.config import StrictConfig
from palpate.messages import NO_TARE, ElectrodeFrame, Origin, SensorType, Tare
from palpate_gateway.clock.stamps import DueMessage, FileClock
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ElectrodeReading, Reading
from palpate_gateway.service.pipeline import Pipeline

FRAMES = 30
INFO = DeviceInfo("test", SensorType.BIOTAC, "test", 100.0, True, False, Origin.LIVE)


def readings(kind: SensorType, start: int = 0, count: int = FRAMES) -> list[Reading]:
    layout = kind.layout
    ticks = range(start, start + count)
    return [
        ElectrodeReading(
            tick=tick,
            time_s=tick * 0.01,
            missed_before=0,
            electrodes=np.arange(layout.electrodes, dtype=np.uint16) + 2000 + tick % 2,
            pdc=1300,
            pac=np.full(layout.pac_samples, 2040, np.uint16),
            tac=2050,
            tdc=1900,
            validity=layout.all_valid,
        )
        for tick in ticks
    ]


def identity(kind: SensorType) -> DeviceIdentity:
    return DeviceIdentity(f"BT-{kind.name}", 1 / 4400, sensor_type=kind)


def sent(items: list[DueMessage]) -> tuple[list[ElectrodeFrame], list[Tare]]:
    messages = [item.message for item in items]
    for message in messages:
        if isinstance(message, ElectrodeFrame):
            ELECTRODE_FRAME.encode(message)
        elif isinstance(message, Tare):
            TARE.encode(message)
    frames = [message for message in messages if isinstance(message, ElectrodeFrame)]
    return frames, [message for message in messages if isinstance(message, Tare)]


def test_an_sp_is_published_and_tared() -> None:
    pipeline = Pipeline(INFO, tare_frames=FRAMES)
    pipeline.begin(identity(SensorType.BIOTAC_SP), FileClock("s", 10**18))
    frames, tares = sent(pushed(pipeline, readings(SensorType.BIOTAC_SP), 10**9))
    assert {frame.sensor_type for frame in frames} == {SensorType.BIOTAC_SP}
    (tare,) = tares
    np.testing.assert_allclose(tare.electrodes, np.arange(24) + 2000.5)
    assert tare.electrodes_sd.shape == (24,)


def test_the_tare_of_a_finger_is_not_that_of_the_next() -> None:
    pipeline = Pipeline(INFO, tare_frames=FRAMES)
    pipeline.begin(identity(SensorType.BIOTAC), FileClock("s", 10**18))
    _, tares = sent(pushed(pipeline, readings(SensorType.BIOTAC), 10**9))
    assert pipeline.ledger.current_id == tares[0].tare_id
    asked = pipeline.ask_tare(10)
    pushed(pipeline, readings(SensorType.BIOTAC, FRAMES, 5), 2 * 10**9)

    pipeline.begin(identity(SensorType.BIOTAC_SP), FileClock("s", 2 * 10**18))
    assert pipeline.ledger.current_id == NO_TARE
    assert pipeline.ledger.find(tares[0].tare_id) is tares[0]
    frames, tares = sent(pushed(pipeline, readings(SensorType.BIOTAC_SP, 35), 3 * 10**9))
    assert frames[0].tare_id == NO_TARE
    assert asked.result(0.0).electrodes.shape == (24,)
    assert [tare.electrodes.shape for tare in tares] == [(24,)] * len(tares)


def test_a_finger_that_is_exchanged_for_its_like_is_tared_anew() -> None:
    """With the old tare the gateway would say that it is tared, and no service would use it."""
    pipeline = Pipeline(INFO, tare_frames=FRAMES)
    for number, serial in enumerate(("BT-1", "BT-1", "BT-2")):
        kept = pipeline.ledger.current_id if number == 1 else NO_TARE
        pipeline.begin(DeviceIdentity(serial, 1 / 4400), FileClock("s", 10**18))
        assert pipeline.ledger.current_id == kept
        made = pushed(pipeline, readings(SensorType.BIOTAC, number * FRAMES), 10**9 * (number + 1))
        assert [tare.sensor_serial for tare in sent(made)[1]] == ([] if kept else [serial])


class Exchanged(Device):
    """A device that is another kind each time it is opened."""

    options_class = StrictConfig

    def __init__(self, kinds: Iterator[SensorType]) -> None:
        super().__init__(INFO)
        self._kinds = kinds

    @property
    def counters(self) -> dict[str, int]:
        return {}

    def _open(self) -> DeviceIdentity:
        return identity(next(self._kinds))

    def _close(self) -> None:
        pass

    def _read(self, timeout_s: float) -> list[Reading]:
        return []


def test_what_the_open_device_tells_is_what_it_is() -> None:
    kinds = [SensorType.BIOTAC, SensorType.BIOTAC_SP, SensorType.BIOTAC]
    device = Exchanged(iter(kinds))
    assert device.info.sensor_type is SensorType.BIOTAC
    for kind in kinds:
        with device:
            assert device.info.sensor_type is kind
            assert abs(device.info.rate_hz - 4400 / kind.layout.slots) < 1e-9
