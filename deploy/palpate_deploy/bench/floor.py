"""The bare floor, with which ``palpate bench e2e`` compares palpate.

The shortest program for the same task: Zenoh, the generated protobuf classes, ONNX Runtime; no
checks beyond the lengths, no health, no presence, no search for tares, one finger. It reads the
same Zenoh settings as palpate from a file, and sends the same frames and estimates field by field.
Its terms are equal (``harness.equal_terms``): garbage collection, change of threads, pinning.
Only this module of the room imports these packages, because it must not use palpate's own code.

``python -m palpate_deploy.bench.floor router|source|service|client ...`` (see ``main``).
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import onnxruntime as ort
import zenoh

from palpate.v1 import common_pb2, estimates_pb2, frames_pb2
from palpate_deploy.bench.harness import (
    KINDS,
    REST_COUNTS,
    SERIAL,
    SourceGate,
    bench_counts,
    equal_terms,
    stop_on_sigterm,
    write_rows,
)
from palpate_deploy.station.lifetime import end_with_parent

FRAMES = "floor/finger/electrodes"
ESTIMATES = "floor/finger/features"
TARE_ID = 3192400884400009478
CLOCK_ID = 0x12345678


def session(settings: str) -> Any:
    """Open Zenoh with the settings that palpate uses."""
    return zenoh.open(zenoh.Config.from_json5(Path(settings).read_text(encoding="utf-8")))


def publisher(opened: Any, key: str, message: str) -> Any:
    """Declare a publisher with the quality of service of a sensor stream."""
    return opened.declare_publisher(
        key,
        encoding=zenoh.Encoding(f"application/protobuf;palpate.v1.{message}"),
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=False,
        reliability=zenoh.Reliability.RELIABLE,
    )


def router(settings: str) -> None:
    """Be the router of the others."""
    stop = stop_on_sigterm()
    with session(settings):
        stop.wait()


def source(settings: str, gate_file: str, rate_hz: str, core: str) -> None:
    """Send prepared frames at absolute deadlines while the gate is open; stays on a core."""
    stop = stop_on_sigterm()
    gate = SourceGate(Path(gate_file), 1)
    period_ns = round(1e9 / float(rate_hz))
    counts = bench_counts()
    sequence, due_ns, offset_ns = 0, 0, 1 << 62
    with session(settings) as opened:
        sink = publisher(opened, FRAMES, "ElectrodeFrame")
        equal_terms(core)
        while not stop.is_set():
            if not gate.is_open:
                time.sleep(0.02)
                due_ns = 0
                continue
            due_ns = due_ns + period_ns if due_ns else time.monotonic_ns() + period_ns
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
            # The stamp is the device's clock as palpate maps it: the lower envelope of arrivals.
            offset_ns = min(offset_ns, time.monotonic_ns() - due_ns)
            row = counts[sequence % KINDS]
            sequence += 1
            frame = frames_pb2.ElectrodeFrame(
                stamp=common_pb2.Stamp(
                    sequence=sequence,
                    device_tick=sequence,
                    monotonic_ns=due_ns + offset_ns,
                    wall_ns=time.time_ns(),
                    clock_id=CLOCK_ID,
                    origin=common_pb2.ORIGIN_SIMULATED,
                ),
                sensor_serial=SERIAL,
                sensor_type=common_pb2.SENSOR_TYPE_BIOTAC,
                electrodes=row[:19].tobytes(),
                pdc=int(row[19]),
                pac=row[20:42].tobytes(),
                tac=int(row[42]),
                tdc=int(row[43]),
                validity=(1 << 44) - 1,
                slot_period_ns=period_ns // 44,
                tare_id=TARE_ID,
            )
            sink.put(frame.SerializeToString())


def service(settings: str, model: str) -> None:
    """Estimate from the newest frame."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    network = ort.InferenceSession(
        Path(model).read_bytes(), options, providers=["CPUExecutionProvider"]
    )
    names = [output.name for output in network.get_outputs()]
    baseline = np.full(19, REST_COUNTS, dtype=np.float32)
    digest = bytes(32)
    tared = np.zeros((1, 19), dtype=np.float32)
    network.run(names, {"electrodes": tared})
    with session(settings) as opened:
        sink = publisher(opened, ESTIMATES, "FeatureEstimate")
        frames = opened.declare_subscriber(FRAMES, zenoh.handlers.RingChannel(1))
        equal_terms()
        exit_on_sigterm()
        while True:
            sample = frames.recv()
            frame = frames_pb2.ElectrodeFrame.FromString(sample.payload.to_bytes())
            if len(frame.electrodes) != 38 or len(frame.pac) != 44:
                continue
            np.subtract(np.frombuffer(frame.electrodes, np.uint16), baseline, out=tared[0])
            answer = dict(zip(names, network.run(names, {"electrodes": tared}), strict=True))
            force, force_sd = answer["force"][0], answer["force_sd"][0]
            if not np.isfinite(force).all():
                continue
            estimate = estimates_pb2.FeatureEstimate(
                source=frame.stamp,
                sensor_serial=frame.sensor_serial,
                bundle_sha256=digest,
                tare_id=frame.tare_id,
                in_contact=bool(np.linalg.norm(force) > 0.05),
                force=common_pb2.Vector3(x=force[0], y=force[1], z=force[2]),
                force_sd=common_pb2.Vector3(x=force_sd[0], y=force_sd[1], z=force_sd[2]),
            )
            sink.put(estimate.SerializeToString())


def client(settings: str, out: str) -> None:
    """Note the age of every estimate."""
    rows: list[tuple[int, int, int]] = []
    with session(settings) as opened:
        estimates = opened.declare_subscriber(ESTIMATES, zenoh.handlers.RingChannel(1))
        equal_terms()
        exit_on_sigterm()
        try:
            while True:
                sample = estimates.recv()
                estimate = estimates_pb2.FeatureEstimate.FromString(sample.payload.to_bytes())
                now_ns = time.monotonic_ns()
                rows.append((estimate.source.sequence, estimate.source.monotonic_ns, now_ns))
        except SystemExit:  # of exit_on_sigterm
            pass
    write_rows(Path(out), ["finger"] * len(rows), rows, dropped=0)


def exit_on_sigterm() -> None:
    """Leave a blocked ``recv`` at ``SIGTERM``; the session is closed on the way out."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, leave)
    end_with_parent()


def main() -> None:
    """Run one part: its name and its arguments."""
    parts = {"router": router, "source": source, "service": service, "client": client}
    parts[sys.argv[1]](*sys.argv[2:])  # type: ignore[operator]


if __name__ == "__main__":
    main()
