"""What an estimating service tells of its work: what it refuses and why, where the time goes."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import nan

import numpy as np

from palpate.errors import ErrorCode, RemoteError
from palpate.health import Health
from palpate.log import about
from palpate.messages import NO_TARE, StageTimings, Stamp
from palpate_services.inference.estimates import EstimateRefusal

_STAGES = ("arrival_age", "waiting", "decode", "tare", "infer", "encode")
_MOST = 10_000


class StageGauges:
    """Percentiles of each stage of the estimates since the last look; use from one thread."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def note(self, timings: StageTimings) -> None:
        """An estimate was published."""
        if len(self._rows) < _MOST:
            age_s = timings.age_at_arrival_s
            self._rows.append(
                (
                    nan if age_s is None else age_s,
                    timings.waiting_s,
                    timings.decode_s,
                    timings.tare_s,
                    timings.infer_s,
                    timings.encode_s,
                )
            )

    def take(self) -> dict[str, float]:
        """``<stage>_p50_s`` and ``<stage>_p99_s``, then anew; what is not known is left out."""
        rows, self._rows = np.array(self._rows), []
        gauges: dict[str, float] = {}
        for stage, seconds in zip(_STAGES, rows.T, strict=False):
            known = seconds[np.isfinite(seconds)]
            if known.size:
                p50, p99 = np.percentile(known, (50, 99))
                gauges[f"{stage}_p50_s"], gauges[f"{stage}_p99_s"] = float(p50), float(p99)
        return gauges


_log = logging.getLogger(__name__)

REFUSED_S = 1.0
"""A sensor whose messages are all refused for longer than this is a trouble [s]: a finger needs the
first half second after its start for its tare."""

_REFUSED_LEAST = 3
_SILENT_S = 1.0  # nothing came for this long: there is nothing to answer
_SENSORS_MOST = 256
_LATELY = 100
"""The reason is that of most of so many refusals: a few others come with each of them."""


@dataclass(slots=True)
class _Refusals:
    """Refusals of one sensor since its last estimate; ``frames`` are the first of each reason."""

    since_s: float
    last_s: float = 0.0
    count: int = 0
    lately: deque[str] = field(default_factory=lambda: deque(maxlen=_LATELY))
    frames: dict[str, dict[str, object]] = field(default_factory=dict)
    told: set[str] = field(default_factory=set)

    @property
    def reason(self) -> str:
        """That of most of the last ones."""
        return Counter(self.lately).most_common(1)[0][0]


class InputReport:
    """Makes a service DEGRADED while a sensor gets only refusals, and READY again afterwards.

    READY means: what came was answered, or nothing came. Use from one thread.

    Args:
        health: Of the service.
        errors: Code, problem and remedy of each refusal.
        recovered: Called when nothing is refused any more: says that the service is ready.
    """

    def __init__(
        self,
        health: Health,
        errors: Mapping[EstimateRefusal, tuple[ErrorCode, str, str]],
        recovered: Callable[[], None],
    ) -> None:
        self._health, self._errors, self._recovered = health, errors, recovered
        self._refused: dict[str, _Refusals] = {}
        self._in_trouble = False

    def answered(self, sensor: str) -> None:
        """A message of this sensor got an estimate, or would have got one of a standby."""
        found = self._refused.pop(sensor, None)
        if found is not None and found.told:
            _log.info("sensor %s is answered again", sensor, extra=about(sensor))

    def refused(
        self,
        sensor: str,
        reason: str,
        stamp: Stamp | None = None,
        *,
        tare_id: int = NO_TARE,
        model: str = "",
    ) -> None:
        """A message got no estimate; ``reason`` is the name of its counter.

        ``stamp`` and ``tare_id`` are of the message, ``model`` is the bundle: for the log, which
        tells the first message that was refused for a reason.
        """
        if reason == EstimateRefusal.SKIPPED_RATE:
            return
        now_s = time.monotonic()
        found = self._refused.get(sensor)
        if found is None:
            if len(self._refused) >= _SENSORS_MOST:
                return
            found = self._refused[sensor] = _Refusals(now_s)
        found.count, found.last_s = found.count + 1, now_s
        found.lately.append(reason)
        if reason not in found.frames:
            frame = about(sensor, stamp, tare_id=tare_id, model=model)
            found.frames[reason] = {**frame, "reason": reason}

    def report(self) -> dict[str, str]:
        """Tell health; call it a few times a second.

        Returns:
            The sensors that get nothing but refusals, with the reason of most of them.
        """
        now_s = time.monotonic()
        for sensor, found in list(self._refused.items()):
            if now_s > found.last_s + _SILENT_S:
                del self._refused[sensor]
        wrong = {
            sensor: found
            for sensor, found in self._refused.items()
            if found.count >= _REFUSED_LEAST and now_s > found.since_s + REFUSED_S
        }
        for sensor, found in wrong.items():
            reason = found.reason
            if reason not in found.told:
                found.told.add(reason)
                _log.warning(
                    "everything of sensor %s is refused: %s",
                    sensor,
                    reason,
                    extra=found.frames[reason],
                )
        if wrong:
            self._in_trouble = True
            self._health.fail(self._error(wrong))
        elif self._in_trouble:
            self._in_trouble = False
            self._recovered()
        return {sensor: found.reason for sensor, found in wrong.items()}

    def _error(self, wrong: Mapping[str, _Refusals]) -> RemoteError:
        sensors = sorted(wrong)
        found = wrong[sensors[0]]
        reason = found.reason
        mostly = "mostly " if len(set(found.lately)) > 1 else ""
        try:
            code, problem, remedy = self._errors[EstimateRefusal(reason)]
        except (KeyError, ValueError):
            code, problem = ErrorCode.INTERNAL, "the estimates break the message contract"
            remedy = "serve another bundle, and report this one to its maker"
        more = f" and {len(sensors) - 1} more" if len(sensors) > 1 else ""
        return RemoteError(
            f"everything of sensor {sensors[0]!r}{more} is refused ({mostly}{reason}): {problem}",
            remedy=remedy,
            code=code,
        )
