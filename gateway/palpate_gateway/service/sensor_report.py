"""Reports of one sensor to the status and the log: its state, its faults, refused tares."""

from __future__ import annotations

import logging
import time

from palpate.errors import ClaimedElsewhere, DeviceError, DeviceTimeout, PalpateError
from palpate.health import Health
from palpate.log import about
from palpate.messages import ChannelFault, FaultKind, SensorState
from palpate_gateway.condition.channel_health import REMEDIES, describe
from palpate_gateway.condition.condition import Condition

_log = logging.getLogger(__name__)

_LOOK_S = 0.2
"""Shortest time between two updates of a sensor that delivers [s]."""

_LOG_AGAIN_S = 60.0
"""A sensor that stays away is logged again after this time only [s]: attempts follow closely."""

_ZERO_LOST = "the zero that it had may be gone: it was opened again, or refused a new one"
_ZERO_REMEDY = "when nothing touches the BioTac, take its zero again: palpate tare {name}"


class SensorReport:
    """Reports the state of a sensor to ``Health``, each event once; belongs to one thread."""

    def __init__(self, name: str, health: Health) -> None:
        self._name, self._health = name, health
        self._state = SensorState.UNKNOWN
        self._looked_s = 0.0
        self._faults: frozenset[tuple[FaultKind, str]] = frozenset()
        self._zero_lost = False
        self._refused: DeviceError | None = None
        self._lost_by, self._log_again_s = "", 0.0
        self._taken_by = ""
        self.is_wrong = False
        """Whether it delivers wrong values: dead or stuck channels, forces without their zero."""

    def starts(self) -> None:
        """It is about to be opened."""
        self._set_state(SensorState.STARTING)

    def delivers(self, condition: Condition | None, *, zero_lost: bool) -> None:
        """Readings were published."""
        now_s = time.monotonic()
        back = self._state in (SensorState.STARTING, SensorState.LOST)
        if not back and now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        self._lost_by = self._taken_by = ""
        faults = () if condition is None else condition.faults
        message = "" if condition is None else condition.message
        self.is_wrong = zero_lost or (condition is not None and condition.has_wrong_channel)
        if zero_lost:
            state = SensorState.ZERO_LOST
            message = _ZERO_LOST
        elif condition is not None and condition.warm_up.warming:
            state = SensorState.WARMING
        else:
            state = SensorState.LIVE
        self._set_state(state, faults, message)
        self._report_faults(faults)
        self._report_zero(zero_lost=zero_lost)

    def is_silent(self, silent_s: float) -> None:
        """Nothing has come for a while."""
        # In whole steps, so that silences that follow one another are the same news.
        silent = f"silent for {int(1e2 * silent_s)}0 ms"
        error = DeviceTimeout(
            f"sensor {self._name!r} is lost: {silent}",
            remedy="check its power and cable; reading goes on by itself",
        )
        self._set_state(SensorState.LOST, message=silent)
        self._health.fail(error)

    def is_lost(self, error: DeviceError, backoff_s: float) -> None:
        """It is gone, or cannot be opened."""
        self._set_state(SensorState.LOST, message=error.problem)
        self._health.fail(error)
        now_s = time.monotonic()
        if error.problem != self._lost_by or now_s >= self._log_again_s:
            self._lost_by, self._log_again_s = error.problem, now_s + _LOG_AGAIN_S
            _log.warning(
                "sensor %s lost, open again in %.1f s: %s",
                self._name,
                backoff_s,
                error,
                extra=about(self._name),
            )

    def is_taken(self, error: ClaimedElsewhere) -> None:
        """Another gateway publishes under its key; told once for each such gateway."""
        if error.problem == self._taken_by:
            return
        self._taken_by = error.problem
        self._set_state(SensorState.STARTING, message=error.problem)
        self._health.fail(error)
        _log.error("%s", error, extra=about(self._name))

    def ended(self, error: PalpateError | None) -> None:
        """It will deliver no more."""
        self._set_state(SensorState.ENDED, message="" if error is None else error.problem)
        if error is not None:
            self._health.fail(error)
            _log.error("sensor %s: %s", self._name, error, extra=about(self._name))

    def tare_refused(self, error: DeviceError | None) -> None:
        """Why the last attempt to tare failed; None = there was none, or it succeeded."""
        if error is None:
            if self._refused is not None:
                self._health.over(self._refused)
            self._refused = None
        elif self._refused is None or error.problem != self._refused.problem:
            self._health.fail(error, degraded=False)
            if self._refused is None:  # attempts follow closely
                _log.warning("sensor %s: %s", self._name, error, extra=about(self._name))
            self._refused = error

    def _set_state(
        self, state: SensorState, faults: tuple[ChannelFault, ...] = (), message: str = ""
    ) -> None:
        self._state = state
        self._health.set_sensor_state(self._name, state, faults=faults, message=message)

    def _report_faults(self, faults: tuple[ChannelFault, ...]) -> None:
        """Report new faults, but no saturation: it comes with the load, and has a counter."""
        present = frozenset((fault.kind, name) for fault in faults for name in fault.channels)
        new = {kind for kind, _ in present - self._faults} - {FaultKind.SATURATED}
        self._faults = present
        for fault in faults:
            if fault.kind in new:
                error = DeviceError(
                    f"sensor {self._name!r}: {describe([fault])}", remedy=REMEDIES[fault.kind]
                )
                self._health.fail(error, degraded=fault.kind is not FaultKind.ODD)
                _log.warning("%s", error, extra=about(self._name))

    def _report_zero(self, *, zero_lost: bool) -> None:
        if zero_lost and not self._zero_lost:
            error = DeviceError(
                f"sensor {self._name!r}: {_ZERO_LOST}",
                remedy=_ZERO_REMEDY.format(name=self._name),
            )
            self._health.fail(error)
            _log.warning("%s", error, extra=about(self._name))
        self._zero_lost = zero_lost
