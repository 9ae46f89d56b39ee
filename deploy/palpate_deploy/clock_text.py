"""What a gateway's gauges say of clocks, in words; docs/time.md says what to make of them."""

from __future__ import annotations

from collections.abc import Mapping

from palpate.messages import Status
from palpate_gateway.timing.clock_map import ClockQuality
from palpate_gateway.timing.discipline import Discipline

_QUALITY = "clock_quality"
_SMALL_PPM = 0.5


def clock_lines(status: Status) -> list[str]:
    """A line for each sensor whose clock is followed, and one for the host's wall clock."""
    gauges = status.gauges
    lines = []
    for name in sorted(gauges):
        head, dot, tail = name.rpartition(".")
        if tail != _QUALITY:
            continue
        sensor = head or " ".join(status.sensors) or status.service
        lines.append(f"clock of {sensor}: {_sensor(gauges, head + dot)}")
    if "wall_synchronised" in gauges:
        kept = Discipline(gauges["wall_synchronised"] > 0.5, gauges.get("wall_error_s", 0.0))
        lines.append(f"wall clock: {wall_words(kept)}")
    if steps := status.counters.get("wall_steps", 0):
        times = "once" if steps == 1 else f"{steps} times"
        lines.append(f"wall clock: it was set {times} since the start of {status.service}")
    return lines


def wall_words(kept: Discipline | None) -> str:
    """How the wall clock is kept, for people."""
    if kept is None:
        return "whether anything keeps it right is not known here"
    if not kept.synchronised:
        return "nothing keeps it right (chrony, NTP, PTP): compare times of this host only"
    return f"kept right, to {duration_words(kept.error_s)} by the kernel's account"


def duration_words(seconds: float) -> str:
    """A short duration for people: ``12 us``, ``3.4 ms``, ``1.2 s``."""
    if seconds < 1e-3:
        return f"{1e6 * seconds:.0f} us"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1.0 else f"{seconds:.1f} s"


def _sensor(gauges: Mapping[str, float], prefix: str) -> str:
    try:
        quality = ClockQuality(int(gauges[prefix + _QUALITY]))
    except ValueError:  # of a newer palpate
        return f"quality {gauges[prefix + _QUALITY]:g}"
    if quality is ClockQuality.ARRIVAL:
        return "it tells none; stamps are the time of arrival"
    drift_ppm = gauges.get(prefix + "clock_drift_ppm", 0.0)
    delay_s = gauges.get(prefix + "clock_delay_p50_s")
    words = ["settling" if quality is ClockQuality.SETTLING else "followed"]
    if abs(drift_ppm) >= _SMALL_PPM:
        words.append(f"{abs(drift_ppm):.0f} ppm {'fast' if drift_ppm > 0 else 'slow'}")
    if delay_s is not None:
        words.append(f"frames arrive {duration_words(delay_s)} after their stamps")
    if quality is ClockQuality.ODD:
        words.append("no quartz is that wrong: check the configured rate")
    return ", ".join(words)
