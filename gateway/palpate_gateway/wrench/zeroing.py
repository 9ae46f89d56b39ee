"""The zero of a force/torque sensor on request, taken in the thread that reads the sensor."""

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

ZERO_LEAST = 5
"""Readings in each mean, at least."""

_SMALL = 0.1
"""Share of the limits of the standard deviation that a load without noise may be off zero."""

_Wrenches = npt.NDArray[np.float64]


class _ZeroRequest:
    """One request: mean of readings before, the zero, mean of readings after."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.future: Future[WrenchZero] = Future()
        self.before: _Wrenches | None = None
        self.noise: _Wrenches = np.zeros(6)
        self.zero_lost = False
        self.taken_ns = (0, 0)
        self.readings: list[WrenchReading] = []


class Zeroing:
    """Serves requests for a zero, one after the other."""

    def __init__(self, name: str, device: WrenchDevice) -> None:
        self._name, self._device = name, device
        self._lock = threading.Lock()
        self._requests: list[_ZeroRequest] = []

    @property
    def usual(self) -> int:
        """Readings in each mean unless a request says otherwise: those of half a second."""
        return max(round(_MEAN_S * self._device.info.rate_hz), ZERO_LEAST)

    def ask(self, count: int) -> Future[WrenchZero]:
        """Request a zero; from any thread."""
        request = _ZeroRequest(count)
        with self._lock:
            self._requests.append(request)
        return request.future

    def follow(self, readings: Sequence[Reading]) -> None:
        """Add readings; when there are enough, take the zero in this thread.

        Raises:
            DeviceLost: The device is gone.
        """
        if not self._requests:
            return
        request = self._requests[0]
        # The caller may have given up waiting in the meantime.
        if request.future.cancelled():
            self._done(request)
            return
        request.readings += (one for one in readings if isinstance(one, WrenchReading))
        if len(request.readings) < request.count:
            return
        try:
            self._go_on(request)
        except DeviceError as error:
            self._done(request)
            if request.future.set_running_or_notify_cancel():
                request.future.set_exception(error)
            if isinstance(error, DeviceLost):
                raise

    def give_up(self, why: str) -> None:
        """Fail all requests, because the device is lost."""
        with self._lock:
            requests, self._requests = self._requests, []
        for one in requests:
            if one.future.set_running_or_notify_cancel():
                one.future.set_exception(
                    DeviceError(
                        f"sensor {self._name!r} took no zero: {why}",
                        remedy="see palpate status, and tare again when it is back",
                    )
                )

    def _go_on(self, request: _ZeroRequest) -> None:
        # First pass: mean before the zero, then the zero. Second pass: mean after it.
        request.readings = request.readings[-request.count :]
        wrenches = np.array([(*one.force, *one.torque) for one in request.readings], np.float64)
        if request.before is None:
            self._check_still(wrenches, request.readings)
            request.before, request.noise = wrenches.mean(axis=0), wrenches.std(axis=0)
            request.readings = []
            request.zero_lost = self._device.zero_lost
            self._device.take_zero()
            request.taken_ns = time.monotonic_ns(), time.time_ns()
            return
        self._check_changed(request, wrenches)
        self._done(request)
        if request.future.set_running_or_notify_cancel():
            before, after = (
                mean.astype(np.float32) for mean in (request.before, wrenches.mean(axis=0))
            )
            request.future.set_result(
                WrenchZero(
                    request.readings[-1].serial,
                    self._device.info.model,
                    *request.taken_ns,
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
                    remedy="leave the sensor and the BioTac untouched, and try again",
                )

    def _check_changed(self, request: _ZeroRequest, wrenches: _Wrenches) -> None:
        """A device may say that it took a zero, and go on as before."""
        assert request.before is not None
        limits = self._device.zero_limits
        rest = np.repeat((limits.zero_max_sd_n, limits.zero_max_sd_nm), 3) * _SMALL
        noise = request.noise + wrenches.std(axis=0) + rest
        unchanged = np.abs(wrenches.mean(axis=0) - request.before) <= noise
        if unchanged.all() and (np.abs(request.before) > 2.0 * noise).any():
            self._device.zero_lost = request.zero_lost
            raise DeviceError(
                f"{self._name!r} took no zero: it reads {np.round(request.before, 3)} as before",
                remedy="see that it accepts requests for a zero, and try again",
            )

    def _done(self, request: _ZeroRequest) -> None:
        with self._lock:
            if request in self._requests:
                self._requests.remove(request)
