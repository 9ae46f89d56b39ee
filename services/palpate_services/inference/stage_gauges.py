"""Where the time of estimates goes, as gauges of the status."""

from __future__ import annotations

from math import nan

import numpy as np

from palpate.messages import StageTimings

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
