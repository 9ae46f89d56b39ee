"""The two readers of ``palpate bench hand``, processes of their own: client and bare floor.

``python -m palpate_deploy.bench.hand_parts client ENDPOINT STATION OUT`` takes every frame of every
sensor and notes its arrival. ``... floor OUT JSON`` reads the same devices with python-can,
pyserial and sockets only, and notes the delay of every last slot.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from palpate_deploy.bench.harness import dropped_by, received, stop_on_sigterm, write_rows

_LAST_SLOT = 0x86
"""Command byte of TDC, the last slot but one of a round."""


def client(endpoint: str, station: str, out: Path) -> None:
    """Take electrode and wrench frames until ``SIGTERM``; then write one row for each.

    Columns: sensor, sequence, frames missed before, time of its last sample and of its arrival by
    the monotonic clock [ns], whether a channel of it is invalid.
    """
    from palpate.bus import Delivery, Session
    from palpate.bus.topics import ELECTRODES, WRENCH
    from palpate.config import LinkConfig
    from palpate.messages import ElectrodeFrame

    stop = stop_on_sigterm()
    names: dict[str, int] = {}
    rows = array("q")
    lock = threading.Lock()
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=20)
    with Session.open(link, station=station) as session:
        streams = [session.subscriber(one, delivery=Delivery.QUEUE) for one in (ELECTRODES, WRENCH)]

        def take(stream: Any) -> None:
            for got in received(stream, stop):
                now_ns = time.monotonic_ns()
                frame, stamp = got.message, got.message.stamp
                last_ns, bad = stamp.monotonic_ns, 0
                if isinstance(frame, ElectrodeFrame):
                    layout = frame.sensor_type.layout
                    last_ns += (layout.slots - 1) * frame.slot_period_ns
                    bad = int(frame.validity != (1 << layout.slots) - 1)
                with lock:
                    number = names.setdefault(got.sensor, len(names))
                    rows.extend((number, stamp.sequence, stamp.missed_before, last_ns, now_ns, bad))

        threads = [threading.Thread(target=take, args=(stream,)) for stream in streams]
        with session.presence("client", instance="client") as presence:
            for thread in threads:
                thread.start()
            presence.ready()
            stop.wait()
        for thread in threads:
            thread.join()
        dropped = dropped_by(*streams)
    write_rows(out, list(names), rows, dropped=dropped, columns=6)


def floor(out: Path, plan_json: str) -> None:
    """Read the devices of a plan for a while, a thread for each, and write delays and CPU time.

    Also of each device whether anything was received.

    The plan holds ``seconds``, and the addresses of ``buses``, ``sockets`` and ``lines``.
    """
    import can
    import serial

    stop_on_sigterm()
    plan = json.loads(plan_json)
    until_s = time.monotonic() + plan["seconds"]
    offset_s = time.time() - time.monotonic()
    lates = [array("d") for _ in plan["buses"]]
    heard: set[Any] = set()

    def read_bus(options: dict[str, Any], late: array[float]) -> None:
        with can.Bus(**options) as bus:
            while time.monotonic() < until_s:
                message = bus.recv(0.1)
                if message is not None and message.data[0] == _LAST_SLOT:
                    late.append(time.monotonic() + offset_s - message.timestamp)

    def read_socket(host: str, port: int) -> None:
        with socket.create_connection((host, port), timeout=2.0) as link:
            link.sendall(b"L1()\n")
            while time.monotonic() < until_s:
                if link.recv(65536):
                    heard.add(port)

    def read_line(line: str, baud: int) -> None:
        with serial.Serial(line, baud, timeout=0.1) as port:
            port.write(b"R")
            while time.monotonic() < until_s:
                if port.read(max(1, port.in_waiting)):
                    heard.add(line)

    threads = [
        *(
            threading.Thread(target=read_bus, args=pair)
            for pair in zip(plan["buses"], lates, strict=True)
        ),
        *(threading.Thread(target=read_socket, args=pair) for pair in plan["sockets"]),
        *(threading.Thread(target=read_line, args=pair) for pair in plan["lines"]),
    ]
    used_s, began_s = time.process_time(), time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    elapsed_s = time.monotonic() - began_s
    np.savez(
        out,
        late_s=np.concatenate([np.array(late) for late in lates]),
        core=np.float64((time.process_time() - used_s) / elapsed_s),
        heard=np.array(
            [
                *(len(late) > 0 for late in lates),
                *(key in heard for _, key in plan["sockets"]),
                *(key in heard for key, _ in plan["lines"]),
            ]
        ),
    )


if __name__ == "__main__":
    if sys.argv[1] == "client":
        client(sys.argv[2], sys.argv[3], Path(sys.argv[4]))
    else:
        floor(Path(sys.argv[2]), sys.argv[3])
