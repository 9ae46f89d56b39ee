"""``palpate bench codec``: an electrode frame to bytes and back, with all checks."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from palpate.codec import ELECTRODE_FRAME
from palpate.messages import ElectrodeFrame, Origin, SensorType, Stamp
from palpate_deploy.bench.harness import KINDS, SERIAL, bench_counts
from palpate_deploy.bench.results import finish

GOAL_S = 25e-6
"""Encode and decode with checks, median (issue of the contract)."""


def run_codec(rounds: int, *, as_json: bool, save: bool) -> None:
    """``palpate bench codec``, whose help explains the options: measure, print, keep."""
    frames = [bench_frame(index) for index in range(KINDS)]
    payloads = [ELECTRODE_FRAME.encode(frame) for frame in frames]
    both = _median_s(lambda i: ELECTRODE_FRAME.decode(ELECTRODE_FRAME.encode(frames[i])), rounds)
    encode = _median_s(lambda i: ELECTRODE_FRAME.encode(frames[i]), rounds)
    decode = _median_s(lambda i: ELECTRODE_FRAME.decode(payloads[i]), rounds)
    values = {
        "codec.frame.encode_s": encode,
        "codec.frame.decode_s": decode,
        "codec.frame.encode_decode_s": both,
        "codec.frame.bytes": len(payloads[0]),
        "codec.frame.goal_s": GOAL_S,
        "codec.frame.goal_met": both <= GOAL_S,
    }
    text = (
        f"electrode frame, {len(payloads[0])} bytes: encode {encode * 1e6:.1f} us, "
        f"decode {decode * 1e6:.1f} us, both {both * 1e6:.1f} us (goal {GOAL_S * 1e6:.0f} us)"
    )
    finish("codec", values, lambda: print(text), as_json=as_json, save=save)


def _median_s(call: Callable[[int], Any], rounds: int) -> float:
    """Median time of one call [s]; the clock's own cost is taken off."""
    times: list[int] = []
    empty: list[int] = []
    for _ in range(rounds):
        for index in range(KINDS):
            began = time.perf_counter_ns()
            call(index)
            times.append(time.perf_counter_ns() - began)
            began = time.perf_counter_ns()
            empty.append(time.perf_counter_ns() - began)
    return max(0.0, statistics.median(times) - statistics.median(empty)) * 1e-9


def bench_frame(index: int) -> ElectrodeFrame:
    """A frame of the benchmark's finger, just read; ``index`` is below `KINDS`."""
    counts = bench_counts()[index]
    now_ns = time.monotonic_ns()
    return ElectrodeFrame(
        stamp=Stamp(index + 1, index + 1, now_ns, time.time_ns(), 1, Origin.SIMULATED),
        sensor_serial=SERIAL,
        sensor_type=SensorType.BIOTAC,
        electrodes=counts[:19],
        pdc=int(counts[19]),
        pac=counts[20:42],
        tac=int(counts[42]),
        tdc=int(counts[43]),
        validity=(1 << 44) - 1,
        slot_period_ns=227_273,
        tare_id=1,
    )
