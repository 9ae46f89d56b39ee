"""What a stranger on the bus does to a station: a program that keeps to no contract.

Three rows of ``palpate bench faults``; the others break something of the station itself.
"""

from __future__ import annotations

import contextlib
import random
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import zenoh

from palpate.bus import Delivery, endpoints
from palpate.bus.topics import ELECTRODES, ENCODING_PREFIX, MAX_MESSAGE_BYTES, sensor_key
from palpate.bus.zenoh_session import open_zenoh
from palpate.codec import ELECTRODE_FRAME, ERROR, TARE_REQUEST
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, PalpateError, StreamTimeout
from palpate.messages import TareRequest
from palpate.process import resident_bytes
from palpate_deploy.bench.fault_station import (
    FORGED_TICK,
    SENSOR,
    FaultStation,
    Figures,
    seconds_until,
)

_SEED = 5


@contextlib.contextmanager
def _stranger(station: FaultStation) -> Iterator[zenoh.Session]:
    """A session of another program, which keeps to no contract."""
    link = LinkConfig(connect=station.profile.link.connect, wait_for_router_s=5.0)
    session = open_zenoh(link, "peer")
    try:
        time.sleep(0.5)
        yield session
    finally:
        session.close()


def bad_sequences(seconds: float) -> tuple[bool, Figures]:
    """Frames with wrong numbers or times are sent under the finger's name, among good ones."""
    with FaultStation() as station, _stranger(station) as stranger:
        profile = station.profile
        key = sensor_key(profile.station, SENSOR, ELECTRODES.name)
        frames = station.observer.session.subscriber(
            ELECTRODES, sensor=SENSOR, delivery=Delivery.QUEUE
        )
        good = frames.next(5.0).message
        encoding = zenoh.Encoding(ELECTRODES.encoding)

        def send(sequence: int, later_ns: int) -> None:
            stamp = replace(
                good.stamp,
                sequence=max(good.stamp.sequence + sequence, 1),
                device_tick=FORGED_TICK,
                monotonic_ns=good.stamp.monotonic_ns + later_ns,
                wall_ns=good.stamp.wall_ns + later_ns,
            )
            frame = replace(good, stamp=stamp)
            stranger.put(key, ELECTRODE_FRAME.encode(frame), encoding=encoding)

        before = station.refusals()
        mark = station.observer.mark()
        sent: Counter[str] = Counter()
        kinds: dict[str, tuple[int, int]] = {
            "repeated": (0, 0),
            "old": (-50, -500_000_000),
            "jump": (900, 20_000_000),
            "far_jump": (1 << 40, 20_000_000),
            "future": (5, 3_600_000_000_000),
            "past": (5, -3_600_000_000_000),
        }
        until_s = time.monotonic() + 6 * seconds
        turn = 0
        while time.monotonic() < until_s:
            with contextlib.suppress(StreamTimeout):
                while True:
                    newest = frames.next(0.0).message
                    if newest.stamp.device_tick != FORGED_TICK:
                        good = newest
            kind = list(kinds)[turn % len(kinds)]
            send(*kinds[kind])
            sent[kind] += 1
            turn += 1
            time.sleep(0.113)
        account = station.observer.account(mark)
        refused = station.refusals()
    figures: Figures = {
        "bad_sent": sum(sent.values()),
        "refused": refused,
        "forged": account.forged,
        "disordered": account.disordered,
        **account.figures(),
    }
    told = refused != before
    return account.lost <= sum(sent.values()) and account.forged == 0 and told, figures


def hostile_payloads(seconds: float) -> tuple[bool, Figures]:
    """Random, mutated, oversize and mislabelled payloads are sent to the features service."""
    rng = random.Random(_SEED)
    per_s = 2000
    with FaultStation() as station, _stranger(station) as stranger:
        key = sensor_key(station.profile.station, SENSOR, ELECTRODES.name)
        frames = station.observer.session.subscriber(ELECTRODES, sensor=SENSOR)
        whole = frames.next(5.0).payload
        frames.close()
        right = zenoh.Encoding(ELECTRODES.encoding)
        mark = station.observer.mark()
        time.sleep(seconds)
        quiet = station.observer.account(mark)
        before = station.counters("features")
        resident = resident_bytes(station.pid("features"))
        mark = station.observer.mark()
        sent, due_s = 0, time.monotonic()
        for _ in range(int(3 * seconds * per_s)):
            kind = rng.random()
            encoding = right
            if kind < 0.5:
                payload = rng.randbytes(rng.randrange(400))
            elif kind < 0.9:
                # Cut off: every such prefix lacks what the contract requires.
                payload = whole[: rng.randrange(len(whole) // 2)]
            elif kind < 0.999:
                payload, encoding = whole, zenoh.Encoding(ENCODING_PREFIX + "palpate.v9.Frame")
            else:
                payload = bytes(MAX_MESSAGE_BYTES // 8)
            stranger.put(key, payload, encoding=encoding)
            sent += 1
            due_s += 1.0 / per_s
            if (left_s := due_s - time.monotonic()) > 0.0:
                time.sleep(left_s)
        time.sleep(1.5)
        account = station.observer.account(mark)
        after = station.counters("features")
        grew = resident_bytes(station.pid("features")) - resident
        station.check("gateway", "features", "recorder")
    told = sum(
        after.get(name, 0) - before.get(name, 0)
        for name in after
        if name.startswith("rejected") or name.startswith("dropped")
    )
    figures: Figures = {
        "sent": sent,
        "rejected_or_dropped": told,
        "p99_ratio": account.p99_s / quiet.p99_s,
        "features_grew_bytes": grew,
        **account.figures(),
    }
    return account.lost <= 0.01 * account.received and grew < 16 << 20 and told > 0, figures


def reply_code(reply: zenoh.Reply) -> str:
    """``answered``, the code of a typed error, ``timeout``, or ``untyped``."""
    if reply.err is None:
        return "answered"
    content = reply.err.payload.to_bytes()
    if str(reply.err.encoding) == ENCODING_PREFIX + ERROR.schema:
        return ERROR.decode(content).code.name.lower()
    return "timeout" if content == b"Timeout" else "untyped"


def query_flood(seconds: float) -> tuple[bool, Figures]:
    """A hundred times more questions than the gateway can hold: refused, typed, and soon over."""
    many = 1600
    codes: Counter[str] = Counter()
    with FaultStation() as station, _stranger(station) as stranger:
        mark = station.observer.mark()
        time.sleep(seconds)
        quiet = station.observer.account(mark)
        tare = station.observer.session.query(
            endpoints.TARE, TareRequest(), sensor=SENSOR, timeout_s=10.0
        )
        key = sensor_key(station.profile.station, SENSOR, endpoints.TARE.name)
        payload = TARE_REQUEST.encode(TareRequest())
        encoding = zenoh.Encoding(ENCODING_PREFIX + TARE_REQUEST.schema)
        ended = threading.Semaphore(0)
        lock = threading.Lock()

        def note(reply: zenoh.Reply) -> None:
            with lock:
                codes[reply_code(reply)] += 1

        mark = station.observer.mark()
        for _ in range(many):
            stranger.get(
                key,
                zenoh.handlers.Callback(note, ended.release),
                payload=payload,
                encoding=encoding,
                timeout=30.0,
            )
        for _ in range(many):
            ended.acquire(timeout=60.0)
        account = station.observer.account(mark)

        def answers() -> bool:
            try:
                station.observer.session.query(
                    endpoints.TARE, TareRequest(tare_id=tare.tare_id), sensor=SENSOR, timeout_s=0.5
                )
            except PalpateError:
                return False
            return True

        again_s = seconds_until(answers)
    figures: Figures = {
        "asked": many,
        **{f"{name}_replies": count for name, count in sorted(codes.items())},
        "answers_again_s": again_s,
        "p99_ratio": account.p99_s / quiet.p99_s,
        **account.figures(),
    }
    refused = codes[ErrorCode.RESOURCE_EXHAUSTED.name.lower()]
    silent = many - sum(codes.values()) + codes["untyped"] + codes["timeout"]
    return silent == 0 and refused > 0 and again_s <= 1.0 and account.lost == 0, figures
