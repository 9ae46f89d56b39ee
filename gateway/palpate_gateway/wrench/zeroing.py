"""Taking the zero of a force/torque sensor when somebody asks, in the thread that reads it."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future

import numpy as np
import numpy.typing as npt

from palpate.errors import DeviceError, DeviceLost
from palpate.messages import WrenchZero
from palpate_gateway.readings import Reading, WrenchReading
from palpate_gateway.wrench.device import WrenchDevice

_MEAN_S = 0.5
_COUNT_MIN, _COUNT_MAX = 5, 20_000

_Wrenches = npt.NDArray[np.float64]


class _Asked:
    """One request: readings before, the zero, readings after."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.future: Future[WrenchZero] = Future()
        self.before: _Wrenches | None = None
        self.taken_ns = (0, 0)
        self.readings: list[WrenchReading] = []


class Zeroing:
    """Serves requests, one after the other.

    Args:
        name: The sensor's name.
        device: The sensor.
    """

    def __init__(self, name: str, device: WrenchDevice) -> None:
        self._name, self._device = name, device
        self._lock = threading.Lock()
        self._asked: list[_Asked] = []

    def count(self, readings: int) -> int:
        """Readings in each mean, if so many are asked for; 0 = half a second's."""
        wanted = readings or round(_MEAN_S * self._device.info.rate_hz)
        return min(max(wanted, _COUNT_MIN), _COUNT_MAX)

    def ask(self, count: int) -> Future[WrenchZero]:
        """Take the load as zero; from any thread."""
        asked = _Asked(count)
        with self._lock:
            self._asked.append(asked)
        return asked.future

    def follow(self, readings: Sequence[Reading]) -> None:
        """Take what was read; this thread takes the zero when it is time.

        Raises:
            DeviceLost: The device is gone.
        """
        if not self._asked:
            return
        asked = self._asked[0]
        if asked.future.cancelled():
            self._done(asked)
            return
        asked.readings += (one for one in readings if isinstance(one, WrenchReading))
        if len(asked.readings) < asked.count:
            return
        try:
            self._go_on(asked)
        except DeviceError as error:
            self._done(asked)
            if asked.future.set_running_or_notify_cancel():
                asked.future.set_exception(error)
            if isinstance(error, DeviceLost):
                raise

    def give_up(self, why: str) -> None:
        """The device is gone."""
        with self._lock:
            asked, self._asked = self._asked, []
        for one in asked:
            if one.future.set_running_or_notify_cancel():
                one.future.set_exception(
                    DeviceError(
                        f"sensor {self._name!r} took no zero: {why}",
                        remedy="look at palpate status; tare when it is back",
                    )
                )

    def _go_on(self, asked: _Asked) -> None:
        asked.readings = asked.readings[-asked.count :]
        wrenches = np.array([(*one.force, *one.torque) for one in asked.readings], np.float64)
        if asked.before is None:
            self._check_still(wrenches, asked.readings)
            asked.before = wrenches.mean(axis=0)
            asked.readings = []
            self._device.take_zero()
            asked.taken_ns = time.monotonic_ns(), time.time_ns()
            return
        self._done(asked)
        if asked.future.set_running_or_notify_cancel():
            before, after = (
                mean.astype(np.float32) for mean in (asked.before, wrenches.mean(axis=0))
            )
            asked.future.set_result(
                WrenchZero(
                    asked.readings[-1].serial,
                    self._device.info.model,
                    *asked.taken_ns,
                    before[:3],
                    before[3:],
                    after[:3],
                    after[3:],
                    len(wrenches),
                )
            )

    def _check_still(self, wrenches: _Wrenches, readings: Sequence[WrenchReading]) -> None:
        if any(one.overload for one in readings):
            raise DeviceError(
                f"cannot zero {self._name!r}: it is overloaded", remedy="take the load off"
            )
        options = self._device.zero_limits
        deviation = wrenches.std(axis=0)
        for part, most, unit in (
            (slice(0, 3), options.zero_max_sd_n, "N"),
            (slice(3, 6), options.zero_max_sd_nm, "N m"),
        ):
            worst = float(deviation[part].max())
            if worst > most:
                axis = "FT"[part.start // 3] + "xyz"[int(deviation[part].argmax())]
                raise DeviceError(
                    f"cannot zero {self._name!r}: {axis} varies by {worst:.3g} {unit} (sd) over "
                    f"{len(wrenches)} readings, at most {most:g} are allowed",
                    remedy="let go of the sensor and of the BioTac, and ask again",
                )

    def _done(self, asked: _Asked) -> None:
        with self._lock:
            if asked in self._asked:
                self._asked.remove(asked)
