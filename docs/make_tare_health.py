"""Write docs/results/tare-health.md: taring and health judged on real recordings.

``python docs/make_tare_health.py FOLDER`` takes the folder of public data. What is called touched
is what its makers say, or what PDC's level says; no limit of the gateway looks at either.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DeviceError
from palpate.messages import ElectrodeFrame, Origin, SensorType, Stamp
from palpate_gateway.clock.stamps import DueMessage, FileClock
from palpate_gateway.condition.condition import Condition, WarmUp, is_drift
from palpate_gateway.condition.stillness import StillLimits, evidence_of
from palpate_gateway.drivers import make_device
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.tare import TARE_FRAMES, TareCollector

Floats = NDArray[np.float64]

OUT = Path(__file__).parent / "results" / "tare-health.md"
STILL = StillLimits()
NO_PAC = StillLimits(pac_sd=inf)
ELECTRODES = StillLimits(pac_sd=inf, pdc_sd=inf)
RATE_HZ = 100.0
PDC_TOUCH = 10.0
"""PDC further than this from where it rested is a touch [counts]."""

PDC_PLATE = 60.0
"""The same under the plate: after hard presses PDC comes back to within 35 counts only."""

HEAD = """# Taring and health on real recordings

Made by `python docs/make_tare_health.py ../shared/data`; what the numbers mean for use is in
[tare-and-health.md](../tare-and-health.md). A window is {frames} frames, half a second, which a
tare is made of.

"""


@dataclass(frozen=True)
class Share:
    """Some of many."""

    some: int
    of: int

    def __str__(self) -> str:
        """E.g. ``3 of 120``."""
        return f"{self.some:,} of {self.of:,}"


def windows(length: int, step: int) -> Iterable[slice]:
    """Windows of a tare's size."""
    for start in range(0, length - TARE_FRAMES + 1, step):
        yield slice(start, start + TARE_FRAMES)


def accepted(
    electrodes: Floats,
    pac: Floats | None,
    pdc: Floats | None,
    chosen: NDArray[np.bool_],
    limits: StillLimits,
) -> Share:
    """Windows, wholly within what is chosen, that would be tared."""
    some = of = 0
    for part in windows(len(electrodes), TARE_FRAMES // 5):
        if not chosen[part].all():
            continue
        of += 1
        some += not evidence_of(
            electrodes[part],
            np.empty(0) if pac is None else pac[part],
            np.zeros(TARE_FRAMES) if pdc is None else pdc[part],
        ).motion(limits)
    return Share(some, of)


def capture(folder: Path) -> list[ElectrodeFrame]:
    """The raw capture, by the gateway's own driver and pipeline."""
    with make_device("text_log", {"path": folder / "syntouch_btd_raw" / "data.btd.gz"}) as device:
        pipeline = Pipeline(device.info, tare="query")
        pipeline.begin(device.identity, FileClock(device.identity.serial, None))
        out: list[DueMessage] = []
        while readings := device.read(1.0):
            pipeline.push(readings, 0, out.append)
    return [one.message for one in out if isinstance(one.message, ElectrodeFrame)]


def touched(pdc: Floats) -> NDArray[np.bool_]:
    """Frames whose PDC is away from where it began, and half a second around them."""
    away = np.abs(pdc - np.median(pdc[:TARE_FRAMES])) > PDC_TOUCH
    return np.convolve(away, np.ones(TARE_FRAMES), "same") > 0


def judge_capture(frames: list[ElectrodeFrame]) -> list[str]:
    """Touches of the capture, by all channels and by electrodes alone."""
    electrodes = np.array([frame.electrodes for frame in frames], np.float64)
    pac = np.array([frame.pac for frame in frames], np.float64)
    pdc = np.array([frame.pdc for frame in frames], np.float64)
    busy = touched(pdc)
    held = np.abs(pdc - np.median(pdc[:TARE_FRAMES])) > PDC_TOUCH
    lines = ["## One BioTac, held by a hand (`syntouch_btd_raw`, with PAC)\n\n"]
    lines.append("| window | tared as `first` | tared as `still` |\n|---|---:|---:|\n")
    for name, chosen in (("untouched", ~busy), ("held by the hand", held)):
        cells = [str(accepted(electrodes, pac, pdc, chosen, one)) for one in (ELECTRODES, STILL)]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |\n")
    rest, grip = [], []
    for part in windows(len(frames), TARE_FRAMES // 5):
        one = evidence_of(electrodes[part], pac[part], pdc[part])
        if not busy[part].any():
            rest.append(one)
        elif held[part].all():
            grip.append(one)
    lines.append("\n| in a window | untouched, most | held, least |\n|---|---:|---:|\n")
    for name, unit in (("pac_sd", "PAC (sd)"), ("pdc_sd", "PDC (sd)"), ("electrode_sd", "E (sd)")):
        most = max(getattr(one, name) for one in rest)
        least = min(getattr(one, name) for one in grip)
        lines.append(f"| {unit} [counts] | {most:.1f} | {least:.1f} |\n")
    free = np.flatnonzero(held)[-1] + 1
    lines.append(
        f"\nFrom the start, untouched: tared after {_frames_to_tare(frames)} frames. From the "
        f"moment at which PDC is back: after {_frames_to_tare(frames[free:])} frames.\n"
    )
    return lines


def _frames_to_tare(frames: list[ElectrodeFrame]) -> int | str:
    collector = TareCollector(TARE_FRAMES, STILL)
    for count, frame in enumerate(frames, start=1):
        try:
            if collector.add(frame) is not None:
                return count
        except DeviceError:
            continue
    return "no number of"


def judge_presses(folder: Path) -> list[str]:
    """Two BioTacs on a force sensor: one pressed, the other idle; electrodes only."""
    data = np.load(folder / "lasa_force_calibration" / "force_calibration.npz")
    lines = [
        "\n## Two BioTacs, one of them pressed (`lasa_force_calibration`, electrodes only)\n\n"
    ]
    lines.append("| | windows that are still | still, and where drift could have led |\n")
    lines.append("|---|---:|---:|\n")
    for pressed, idle in (("finger1", "finger2"), ("finger2", "finger1")):
        for name, key, rest in (
            (f"{pressed}, pressed", f"{pressed}_electrodes_raw", f"{pressed}_baseline_mean"),
            (f"{idle}, idle beside it", f"{pressed}_idle_{idle}_electrodes_raw", ""),
        ):
            electrodes = data[key].astype(np.float64)
            level = data[rest].astype(np.float64) if rest else electrodes[:TARE_FRAMES].mean(axis=0)
            lines.append(f"| {name} | {' | '.join(map(str, _still_drift(electrodes, level)))} |\n")
    idle_counts = data["finger1_idle_finger2_electrodes_raw"].astype(np.float64)
    drift = idle_counts[-TARE_FRAMES:].mean(axis=0) - idle_counts[:TARE_FRAMES].mean(axis=0)
    lines.append(
        f"\nThe idle finger2 drifted by {drift.min():.0f} to {drift.max():.0f} counts in "
        f"{len(idle_counts) / RATE_HZ / 60.0:.0f} minutes.\n"
    )
    return lines


def _still_drift(electrodes: Floats, level: Floats) -> tuple[Share, Share]:
    """Windows that are still (shift included), and those of them that pass for drift."""
    limits = StillLimits(pac_sd=inf)
    still = drift = of = 0
    usable = np.ones(electrodes.shape[1], np.bool_)
    for part in windows(len(electrodes), TARE_FRAMES // 5):
        of += 1
        evidence = evidence_of(electrodes[part], np.empty(0), np.zeros(TARE_FRAMES))
        if not evidence.motion(limits):
            still += 1
            drift += is_drift(electrodes[part].mean(axis=0) - level, 0.0, usable)
    return Share(still, of), Share(drift, of)


def judge_plates(folder: Path) -> tuple[list[str], list[tuple[str, Floats]]]:
    """One BioTac under a flat plate; electrodes and PDC."""
    data = np.load(folder / "lasa_contact_normal" / "contact_normal_logs.npz")
    logs = sorted({key.split("_")[0] for key in data.files})
    counts = {
        log: (
            data[f"{log}_electrodes_raw"].astype(np.float64),
            data[f"{log}_pdc_raw"].astype(np.float64),
        )
        for log in logs
    }
    frozen = [log for log, (one, _) in counts.items() if not np.ptp(one, axis=0).any()]
    parts: dict[str, list[Share]] = {"untouched": [], "under the plate": []}
    for log in set(logs) - set(frozen):
        electrodes, pdc = counts[log]
        rest = np.percentile(pdc, 2)
        held = pdc > rest + PDC_PLATE
        free = ~(np.convolve(held, np.ones(TARE_FRAMES), "same") > 0)
        parts["untouched"].append(accepted(electrodes, None, pdc, free, NO_PAC))
        parts["under the plate"].append(accepted(electrodes, None, pdc, held, NO_PAC))
    lines = ["\n## One BioTac under a plate (`lasa_contact_normal`, no PAC)\n\n"]
    lines.append("| window | still |\n|---|---:|\n")
    for name, shares in parts.items():
        total = Share(sum(one.some for one in shares), sum(one.of for one in shares))
        lines.append(f"| {name} | {total} |\n")
    lines.append(
        f"\n{len(frozen)} of the {len(logs)} logs repeat one frame from beginning to end: "
        f"{', '.join(frozen)}.\n"
    )
    return lines, [(log, one) for log, (one, _) in counts.items()]


def alarms(name: str, frames: Iterable[ElectrodeFrame]) -> str:
    """What the watch over channels says of a recording of intact ones."""
    condition = Condition(SensorType.BIOTAC.layout, RATE_HZ, STILL)
    collector: TareCollector | None = TareCollector(TARE_FRAMES, ELECTRODES)
    count = 0
    for frame in frames:
        count += 1
        condition.add(frame)
        try:
            tare = collector.add(frame) if collector is not None else None
        except DeviceError:
            continue
        if tare is not None:
            condition.tared(tare)
            collector = None
    found = {k.removeprefix("channels_"): v for k, v in condition.channels.counters.items() if v}
    told = ", ".join(f"{number} {kind}" for kind, number in found.items()) or "none"
    return f"| {name} | {count:,} | {told} |\n"


def as_frames(electrodes: Floats, *, repeats: bool = False) -> Iterable[ElectrodeFrame]:
    """Recordings of electrodes as frames; PAC, which they lack, has noise unless all repeats."""
    random = np.random.default_rng(1)
    layout = SensorType.BIOTAC.layout
    for k, row in enumerate(electrodes.astype(np.uint16)):
        time_ns = round(k / RATE_HZ * 1e9)
        pac = random.normal(2040.0, 0.0 if repeats else 4.0, layout.pac_samples).astype(np.uint16)
        stamp = Stamp(k + 1, k, time_ns, time_ns, 1, Origin.REPLAYED, 0)
        yield ElectrodeFrame(
            stamp, "R", SensorType.BIOTAC, row, 2400, pac, 2050, 1900, layout.all_valid, 227_273, 0
        )  # fmt: skip


def slopes(frames: list[ElectrodeFrame]) -> str:
    """Slopes of TDC that the watch over warm-up finds in the capture."""
    watch, found = WarmUp(), []
    for k in range(0, len(frames), 20):
        block = frames[k : k + 20]
        watch.add(block[-1].stamp.monotonic_ns * 1e-9, float(np.mean([one.tdc for one in block])))
        if watch.slope_counts_per_min is not None:
            found.append(watch.slope_counts_per_min)
    rest = found[0]
    return (
        f"\nTDC of the capture: first slope, untouched, {rest:+.0f} counts/min; with the touch "
        f"{min(found):+.0f} to {max(found):+.0f}.\n"
    )


def main(folder: Path) -> None:
    """Judge, write."""
    frames = capture(folder)
    lines = [HEAD.format(frames=TARE_FRAMES), *judge_capture(frames), *judge_presses(folder)]
    plates, logs = judge_plates(folder)
    lines += plates
    lines.append(
        "\n## Alarms of intact channels\n\n| recording | frames | alarms |\n|---|---:|---|\n"
    )
    lines.append(alarms("syntouch_btd_raw", frames))
    data = np.load(folder / "lasa_force_calibration" / "force_calibration.npz")
    lines += [alarms(k, as_frames(data[k])) for k in data.files if data[k].ndim == 2 and "raw" in k]
    moving = [one for _, one in logs if np.ptp(one, axis=0).any()]
    lines.append(alarms("lasa_contact_normal", as_frames(np.concatenate(moving))))
    lines.append("\nAnd of the logs that repeat one frame:\n\n")
    lines.append("| recording | frames | alarms |\n|---|---:|---|\n")
    for log, one in logs:
        if not np.ptp(one, axis=0).any():
            lines.append(alarms(log, as_frames(one, repeats=True)))
    lines.append(slopes(frames))
    OUT.write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
