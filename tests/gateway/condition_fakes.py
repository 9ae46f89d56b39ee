"""Frames of a made-up BioTac whose noise, touches and faults a test decides."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from palpate.messages import ElectrodeFrame, Origin, SensorType, Stamp, Tare

RATE_HZ = 100.0
LAYOUT = SensorType.BIOTAC.layout
LEVELS = 2800.0 + 25.0 * np.arange(19)


class Finger:
    """One sensor; attributes may be changed at any time.

    Attributes:
        offset: Added to the electrodes [counts], shape ``(19,)``.
        pdc: Mean PDC [counts].
        tdc: Mean TDC [counts].
        noise: Standard deviation of electrodes [counts].
        pac_noise: Standard deviation of PAC [counts].
        fixed: Electrode, from 0, to the value that it tells.
        invalid: Bits of validity that are clear.
    """

    def __init__(self, seed: int = 0, *, kind: SensorType = SensorType.BIOTAC) -> None:
        self.random = np.random.default_rng(seed)
        self.kind = kind
        self.levels = 2800.0 + 25.0 * np.arange(kind.layout.electrodes)
        self.offset: npt.NDArray[np.float64] = np.zeros(kind.layout.electrodes)
        self.pdc, self.tdc = 2400.0, 1900.0
        self.noise, self.pac_noise = 4.0, 4.0
        self.fixed: dict[int, int] = {}
        self.invalid = 0
        self.tick = 0

    def frame(self) -> ElectrodeFrame:
        """The next frame."""
        layout = self.kind.layout
        self.tick += 1
        counts = self.levels + self.offset + self.random.normal(0.0, self.noise, layout.electrodes)
        electrodes = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
        for at, value in self.fixed.items():
            electrodes[at] = value
        pac = 2040.0 + self.random.normal(0.0, self.pac_noise, layout.pac_samples)
        time_ns = round(self.tick / RATE_HZ * 1e9)
        return ElectrodeFrame(
            stamp=Stamp(self.tick, self.tick, time_ns, time_ns, 1, Origin.LIVE, 0),
            sensor_serial="BT1",
            sensor_type=self.kind,
            electrodes=electrodes,
            pdc=round(self.pdc),
            pac=np.clip(np.rint(pac), 0, 4095).astype(np.uint16),
            tac=2050,
            tdc=round(self.tdc),
            validity=layout.all_valid & ~self.invalid,
            slot_period_ns=227_273,
            tare_id=0,
        )

    def frames(self, seconds: float) -> Iterator[ElectrodeFrame]:
        """Frames of a time [s]."""
        for _ in range(round(seconds * RATE_HZ)):
            yield self.frame()

    def press(self, counts: float) -> None:
        """Touch it: some electrodes fall, some rise, the pressure rises."""
        self.offset = counts * np.sin(np.arange(len(self.levels)) * 0.9)
        self.pdc = 2400.0 + abs(counts)

    def tare(self) -> Tare:
        """Of its untouched levels."""
        stamp = Stamp(max(self.tick, 1), self.tick, round(self.tick * 1e7), 0, 1, Origin.LIVE, 0)
        levels = self.levels.astype(np.float32)
        return Tare(7, stamp, "BT1", levels, levels * 0.0, 2400.0, 2040.0, 2050.0, 1900.0, 50)
