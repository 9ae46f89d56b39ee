"""From a frame to its estimate: find the tare that it names, then ask the pure function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from palpate.bus import Session
from palpate.bus.tares import TareBook
from palpate.errors import ErrorCode, RemoteError
from palpate.health import Health
from palpate.messages import NO_TARE, ElectrodeFrame, Tare
from palpate_services.answering import Freshness
from palpate_services.baselines import Baselines
from palpate_services.config import ElectrodesConfig
from palpate_services.estimator import Refusal
from palpate_services.runtime import Runtime

E = TypeVar("E")

TARE_UNKNOWN = "tare_unknown"


class TaredFrames(Generic[E]):
    """Answers frames, each with its own tare. Use from one thread.

    Args:
        session: Where tares are heard of and asked for.
        config: How long to wait for one.
        runtime: The loaded bundle.
        estimate: The pure function of frame, tare and bundle.
        health: Told once of each sensor that the bundle is not for.
        any_age: Answer a frame that has grown old while its tare was looked for: somebody asked
            for this very frame.
    """

    def __init__(
        self,
        session: Session,
        config: ElectrodesConfig,
        runtime: Runtime,
        estimate: Callable[[ElectrodeFrame, Tare | None, Runtime], E | Refusal],
        health: Health,
        *,
        any_age: bool = False,
    ) -> None:
        book = TareBook(session, query_timeout_s=config.tare_timeout_s)
        self._baselines = Baselines(book, patient=config.delivery == "every")
        self._freshness = None if any_age else Freshness(config)
        self._runtime = runtime
        self._estimate = estimate
        self._health = health
        self._others: set[str] = set()

    def answer(self, sensor: str, frame: ElectrodeFrame) -> E | str:
        """The estimate of a frame, or the reason why there is none.

        Args:
            sensor: Name of the sensor.
            frame: Raw counts of one sampling round.
        """
        if frame.sensor_type is not self._runtime.sensor_type:
            self._tell(sensor, frame)
            return Refusal.WRONG_SENSOR
        tare = None
        if frame.tare_id != NO_TARE:
            tare, waited = self._baselines.find(sensor, frame.tare_id)
            if tare is None:
                return TARE_UNKNOWN
            if waited and self._freshness is not None:
                reason = self._freshness.refusal(frame.stamp)
                if reason is not None:
                    return reason
        return self._estimate(frame, tare, self._runtime)

    def _tell(self, sensor: str, frame: ElectrodeFrame) -> None:
        """Say once that there will be no estimates of a sensor; all its frames are counted."""
        if sensor in self._others:
            return
        self._others.add(sensor)
        manifest, kind = self._runtime.manifest, frame.sensor_type
        error = RemoteError(
            f"sensor {sensor!r} is a {kind.name} with {kind.layout.electrodes} electrodes, the "
            f"bundle {manifest.name}:{manifest.version} is made for a {manifest.sensor_type}",
            remedy=f"name the other sensors in the option sensors, or serve a bundle for a "
            f"{kind.name}",
            code=ErrorCode.INVALID_REQUEST,
        )
        # The sensors it is for are served as before.
        self._health.fail(error, degraded=False)
