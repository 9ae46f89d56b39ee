"""Write docs/results/attacks.md and .json: attacks on a station with certificates, and their end.

``python -m docs.make_attacks`` starts a station, attacks it as ``tests/hostile/attacks.py`` says,
and measures what certificates and roles cost a message. It takes two minutes on an idle machine.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tests.hostile.attack_bus import Outcome
from tests.hostile.attacks import ATTACKS
from tests.hostile.lab import LIVE_S, Lab

from palpate.bus import Session, run_router
from palpate.config import LinkConfig, Role
from palpate.errors import printable
from palpate_deploy.bench.results import machine
from palpate_deploy.station.host import free_endpoint

PAGE = Path(__file__).parent / "results" / "attacks.md"

HEAD = """# Attacks on a station with certificates

Which attacks on a station with certificates are refused, and what the logs show.
Made by `python -m docs.make_attacks`; the attacks are `tests/hostile/attacks.py`, whose tests
assert what this page shows. The station runs `palpate up` with router, gateway and features, one
virtual finger and one robot's poses, on one host; the attackers are Zenoh sessions, TLS clients and
files. [security.md](../security.md) says what each stands for.

*Refused*: the attack had no effect, and the station went on with the same processes. *Logged*: the
first words of the line in the log of a process, or the counter. `refused: a message of` names an
id; the router's log tells its address and role.

| attack | refused | the attacker is told | logged |
|---|---|---|---|
"""

COST = """
## What certificates and roles cost

One way from `put` to a callback, two sessions of one process with a direct link on loopback, {size}
bytes at {rate} Hz, {rounds} rounds of {count} in turns: median of the rounds' medians, and of their
99th percentiles.

| link | median | 99 % |
|---|---|---|
"""

_SIZE, _RATE_HZ, _COUNT, _ROUNDS = 300, 200, 600, 3
_KEY = "palpate/@v1/lab/finger/electrodes"


FLOOD = "flood of messages"
_FLOODS = 5


def _attack() -> tuple[dict[str, Outcome], list[Outcome]]:
    """What came of each attack, and of the one that is not stopped several times."""
    with tempfile.TemporaryDirectory(prefix="attacks-") as folder, Lab(Path(folder)) as lab:
        outcomes = {name: attack(lab) for name, attack in ATTACKS.items()}
        return outcomes, [ATTACKS[FLOOD](lab) for _ in range(_FLOODS)]


def _round(gateway: Session, service: Session) -> tuple[float, float]:
    """Median and 99th percentile of one way [s]."""
    took: list[float] = []
    subscriber = service._raw.declare_subscriber(
        _KEY, lambda sample: took.append(time.monotonic() - float(sample.payload.to_bytes()[:24]))
    )
    publisher = gateway._raw.declare_publisher(_KEY)
    time.sleep(1.0)
    for _ in range(_COUNT):
        stamp = f"{time.monotonic():<24.9f}".encode()
        publisher.put(stamp + b"x" * (_SIZE - len(stamp)))
        time.sleep(1 / _RATE_HZ)
    time.sleep(0.5)
    subscriber.undeclare()
    publisher.undeclare()
    return float(np.median(took)), float(np.quantile(took, 0.99))


def _cost() -> dict[str, dict[str, float]]:
    """Latency without certificates, with them, and with roles [us]."""
    found: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory(prefix="attacks-") as text:
        folder = _certificates(Path(text) / "certs")
        for _ in range(_ROUNDS):
            for name in ("plain TCP", "certificates", "certificates and roles"):
                found.setdefault(name, []).append(_measure(name, folder))
    return {
        name: {
            "median_us": round(float(np.median([one for one, _ in rounds])) * 1e6),
            "p99_us": round(float(np.median([one for _, one in rounds])) * 1e6),
        }
        for name, rounds in found.items()
    }


def _certificates(folder: Path) -> Path:
    from palpate_deploy.station.certificates import issue, make_authority

    make_authority(folder)
    for role in (Role.ROUTER, Role.GATEWAY, Role.SERVICE):
        issue(folder, role)
    return folder


def _measure(name: str, folder: Path) -> tuple[float, float]:
    endpoint = free_endpoint()
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=LIVE_S)
    if name != "plain TCP":
        endpoint = endpoint.replace("tcp/", "tls/")
        link = LinkConfig(connect=(endpoint,), certificates=folder, wait_for_router_s=LIVE_S)

    def of(role: Role) -> LinkConfig:
        own = link.as_role(role)
        if name == "certificates" and own.tls is not None:
            own = own.model_copy(update={"tls": own.tls.model_copy(update={"roles": False})})
        return own

    stop = threading.Event()
    router = threading.Thread(
        target=run_router, args=((endpoint,), stop), kwargs={"link": of(Role.ROUTER)}
    )
    router.start()
    try:
        with Session.open(of(Role.GATEWAY)) as gateway, Session.open(of(Role.SERVICE)) as service:
            deadline = time.monotonic() + LIVE_S
            while not gateway._raw.info.peers_zid() and time.monotonic() < deadline:
                time.sleep(0.05)
            return _round(gateway, service)
    finally:
        stop.set()
        router.join(LIVE_S)


def _short(text: str, most: int = 110) -> str:
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)  # Zenoh colours its log
    text = re.sub(r"^\S*\d\d:\d\d:\d\d\S*\s+", "", text)
    text = re.sub(r"\S*attacks-\w+/", "", re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:PORT", text))
    text = re.sub(r"(acc|rx)-\d+ ThreadId\(\d+\) ", "", printable(text)).replace("|", "/")
    return text if len(text) <= most else text[: most - 3] + "..."


def _row(name: str, outcome: Outcome) -> str:
    told = _short(outcome.says)
    numbers = ", ".join(
        f"{key.replace('_', ' ')} {value:g}" for key, value in outcome.numbers.items()
    )
    told += f" ({numbers})" if numbers else ""
    verdict = "yes" if outcome.refused else "**no**"
    return f"| {name} | {verdict} | {told} | {_short(outcome.logged) or '**nowhere**'} |"


def main() -> None:
    """Attack, measure, write; the exit status is 1 if an attack had an effect."""
    (outcomes, floods), cost = _attack(), _cost()
    meant = {name: (attack.__doc__ or "").splitlines()[0] for name, attack in ATTACKS.items()}
    lines = [HEAD + "\n".join(_row(name, one) for name, one in outcomes.items()), ""]
    lines += ["What each is:", ""]
    lines += [f"* **{name}**: {text}" for name, text in meant.items()]
    rates = sorted(one.numbers["estimates_per_s"] for one in floods)
    waits = sorted(one.numbers["next_20_estimates_after_s"] for one in floods)
    lines += [
        "",
        f"{_FLOODS} more floods of messages by a robot on the station's own host left "
        f"{rates[0]:g} to {rates[-1]:g} of 100 estimates a second; the next 20 came "
        f"{waits[0]:g} to {waits[-1]:g} s after the end.",
    ]
    lines.append(COST.format(size=_SIZE, rate=_RATE_HZ, count=_COUNT, rounds=_ROUNDS).rstrip())
    lines += [
        f"| {name} | {one['median_us']} µs | {one['p99_us']} µs |" for name, one in cost.items()
    ]
    PAGE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    values = {
        "attacks": {
            name: {
                "attack": meant[name],
                **asdict(one),
                "says": _short(one.says, 1000),
                "logged": _short(one.logged, 1000),
            }
            for name, one in outcomes.items()
        },
        "floods": [one.numbers for one in floods],
        "cost": cost,
        "all_refused": all(one.refused for one in outcomes.values()),
        "machine": machine(),
    }
    text = json.dumps(values, indent=2, ensure_ascii=True)
    PAGE.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    sys.exit(0 if values["all_refused"] else 1)


if __name__ == "__main__":
    main()
