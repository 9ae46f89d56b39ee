"""Others on the bus that do no good.

python -m tests.chaos.strangers WHAT ROUTER CERTIFICATES SENSOR

``flood`` asks for 400 simulations at once, ``malformed`` sends 5000 frames that are none,
``listen`` takes every estimate until it is stopped. Each says what came of it, as JSON.
"""

from __future__ import annotations

import json
import random
import sys
import threading
import time
import uuid
from collections import Counter
from pathlib import Path

import zenoh

from palpate import Client
from palpate.bus import Delivery, endpoints
from palpate.bus.topics import ELECTRODES, ENCODING_PREFIX, FEATURES, sensor_key
from palpate.bus.zenoh_session import open_zenoh
from palpate.client.simulations import straight_path
from palpate.codec import SIMULATION_REQUEST
from palpate.config import joining_link
from palpate.errors import StreamTimeout
from palpate.messages import SimulationRequest
from palpate_deploy.bench.strangers import reply_code

MANY = 400
FRAMES, FRAMES_HZ = 5000, 1000.0
_SEED = 5


def flood(session: zenoh.Session, sensor: str) -> dict[str, int]:
    """Ask for many simulations at once; replies by their code."""
    codes: Counter[str] = Counter()
    lock, ended = threading.Lock(), threading.Semaphore(0)
    key = sensor_key("lab", "twin", endpoints.SIMULATE.name)
    encoding = zenoh.Encoding(ENCODING_PREFIX + SIMULATION_REQUEST.schema)
    path = straight_path((-0.004, 0.0, -0.011), (-0.004, 0.0, -0.0096), 2)

    def note(reply: zenoh.Reply) -> None:
        with lock:
            codes[reply_code(reply)] += 1

    for _ in range(MANY):
        request = SimulationRequest(uuid.uuid4().hex, "sphere_7mm", path, deadline_s=5.0)
        session.get(
            key,
            zenoh.handlers.Callback(note, ended.release),
            payload=SIMULATION_REQUEST.encode(request),
            encoding=encoding,
            timeout=20.0,
        )
    for _ in range(MANY):
        ended.acquire(timeout=30.0)
    return dict(codes)


def malformed(session: zenoh.Session, sensor: str) -> dict[str, int]:
    """Send what is no frame under the key of the sensor's frames; how many."""
    rng = random.Random(_SEED)
    key = sensor_key("lab", sensor, ELECTRODES.name)
    right = zenoh.Encoding(ELECTRODES.encoding)
    wrong = zenoh.Encoding(ENCODING_PREFIX + "palpate.v9.Frame")
    due_s = time.monotonic()
    for number in range(FRAMES):
        session.put(key, rng.randbytes(rng.randrange(400)), encoding=right if number % 4 else wrong)
        due_s += 1.0 / FRAMES_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
    return {"sent": FRAMES}


def listen(endpoint: str, certificates: Path, sensor: str) -> None:
    """Take every estimate, for ever."""
    with Client(endpoint, tls=certificates, timeout_s=30.0) as client:
        stream = client.session.subscriber(FEATURES, sensor=sensor, delivery=Delivery.QUEUE)
        stream.next(30.0)
        sys.stdout.write("listens\n")
        sys.stdout.flush()
        while True:
            try:
                stream.next(1.0)
            except StreamTimeout:
                continue


def main(what: str, endpoint: str, certificates: Path, sensor: str) -> None:
    """Do it."""
    if what == "listen":
        listen(endpoint, certificates, sensor)
        return
    session = open_zenoh(joining_link(endpoint, wait_s=30.0, tls=certificates), "client")
    try:
        time.sleep(1.0)
        found = {"flood": flood, "malformed": malformed}[what](session, sensor)
    finally:
        session.close()
    sys.stdout.write(json.dumps({"what": what, **found}) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), sys.argv[4])
