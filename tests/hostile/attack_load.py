"""Attacks on a station by bundles, recordings, names, sizes and floods."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import zenoh
from tests.hostile import bundles, records
from tests.hostile.attack_bus import (
    QUIET_S,
    Outcome,
    command,
    error_of,
    refused_command,
)
from tests.hostile.lab import LIVE_S, STATION, Heard, Lab, copy_of_bundle, raw, resident_bytes

from palpate.admin import signed
from palpate.bus import endpoints
from palpate.bus.query import LOOK_S, is_served
from palpate.bus.topics import sensor_key, service_key
from palpate.codec import ERROR
from palpate.config import Role
from palpate.errors import PalpateError
from palpate.files.bundle import read_bundle
from palpate.files.record import check_readable, summarise
from palpate.files.signature import sign_bundle
from palpate_deploy.station.certificates import issue
from palpate_services.config import ModelsConfig
from palpate_services.inference.repository import Repository

FLOOD_S = 5.0

# --- bundles and records -------------------------------------------------------------------------


def unsigned_bundle(lab: Lab) -> Outcome:
    """A bundle without a signature is put into the repository's folder, and loaded."""
    where = lab.folder / "models" / "unsigned" / "1"
    if not where.exists():
        copy_of_bundle(where, "unsigned")
    return _logged_refusal(lab, "unsigned", "is not signed")


def altered_bundle(lab: Lab) -> Outcome:
    """A byte of a signed bundle's manifest is changed in the repository, and it is loaded."""
    where = lab.folder / "models" / "altered" / "1"
    if not where.exists():
        copy_of_bundle(where, "altered")
        sign_bundle(read_bundle(where), lab.key)
        manifest = where / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"opset"', ' "opset"'))
    return _logged_refusal(lab, "altered", "altered after it was signed")


def _logged_refusal(lab: Lab, bundle: str, words: str) -> Outcome:
    since = len(lab.log("features"))
    outcome = refused_command(
        lab, signed(command(lab, bundle=bundle), lab.token), "commands_refused"
    )
    line = lab.logged("features", words, since)
    return Outcome(outcome.refused, outcome.says, line)


def hostile_model_folders(lab: Lab) -> Outcome:
    """Every bad bundle of ``tests/hostile`` that shows before it runs is imported."""
    from tests.hostile.test_bundles import RUN

    repository = Repository(lab.fresh("imported"))
    refused, names = 0, [name for name in bundles.CASES if name not in RUN]
    for number, name in enumerate(names):
        folder = lab.fresh(f"bad-{number}")
        bundles.CASES[name](folder)
        with suppress(PalpateError):
            repository.add(folder, read_bundle)
            continue
        refused += 1
    empty = not repository.folder or not list(repository.folder.rglob("*.onnx"))
    says = (
        f"{refused} of {len(names)} refused by a typed error; the repository stays empty: {empty}"
    )
    numbers = {"cases": len(names), "refused": refused}
    return Outcome(refused == len(names) and empty, says, "the error of the command", numbers)


def crafted_recordings(lab: Lab) -> Outcome:
    """Every bad record of ``tests/hostile`` is opened."""
    refused = 0
    for number, (_, make) in enumerate(records.CASES.items()):
        path = lab.fresh(f"record-{number}")
        path.mkdir()
        make(path / "bad.mcap")
        with suppress(PalpateError):
            summarise(path / "bad.mcap")
            check_readable(path / "bad.mcap")
            continue
        refused += 1
    says = f"{refused} of {len(records.CASES)} refused by a typed error"
    numbers = {"cases": len(records.CASES), "refused": refused}
    return Outcome(refused == len(records.CASES), says, "the error of the command", numbers)


_ESCAPES = ("../evil", "/etc/evil", "a/../../evil", "..", "%2e%2e", "a\x00b", "*", "@service", "$*")


def path_traversal(lab: Lab) -> Outcome:
    """Names with ``..``, slashes and wildcards, wherever a name becomes a path or a key."""
    before = _evil(lab)
    tries: list[Callable[[str], object]] = [
        lambda name: issue(lab.certificates, Role.ROBOT, name),
        lambda name: lab.operator.query(
            endpoints.TARE, endpoints.TARE.request.decode(b""), sensor=name, timeout_s=1.0
        ),
        lambda name: Repository.of_config(ModelsConfig(folder=lab.folder / "models")).resolve(
            f"mine:{name}"
        ),
        lambda name: sensor_key(name, "finger", "electrodes"),
        lambda name: service_key("lab", name, "a", "status"),
    ]
    refused = total = 0
    for one in tries:
        for name in _ESCAPES:
            if name == "*" and one in tries[3:]:
                continue  # stands for any name there
            total += 1
            refused += bool(error_of(partial(one, name)))
    after = _evil(lab)
    says = f"{refused} of {total} refused by a typed error"
    numbers = {"cases": total, "refused": refused}
    return Outcome(refused == total and before == after, says, "the caller's error", numbers)


def _evil(lab: Lab) -> list[str]:
    """What an escape would have made, in the lab's folder or beside it."""
    found = [*lab.folder.rglob("*evil*"), *lab.folder.parent.glob("*evil*")]
    return sorted(map(str, found))


# --- sizes and floods ----------------------------------------------------------------------------


def oversize(lab: Lab) -> Outcome:
    """A robot sends poses of 100 kB and of 5 MiB, 20 of each."""
    key = sensor_key(STATION, "arm", "robot_pose")
    pid = lab.processes()["gateway"]
    before, bytes_before = lab.counter("features", "estimates_published"), resident_bytes(pid)
    since = lab.lengths()
    with lab.robot() as robot, Heard(lab.operator, key) as heard:
        for _ in range(20):
            for size in (100_000, 5 << 20):
                raw(robot).put(key, b"\x00" * size)
        time.sleep(2 * QUIET_S)
        largest = max(map(len, heard.payloads), default=0)
        logged = lab.told_refused("robot", since)
    grown = (resident_bytes(pid) - bytes_before) / 1e6
    says = f"nothing; the largest that arrived has {largest} bytes"
    fine = not largest and grown < 100 and lab.goes_on(before)
    return Outcome(fine, says, logged, {"gateway_grew_mb": round(grown, 1)})


def flood_of_refusals(lab: Lab) -> Outcome:
    """A robot publishes electrodes, which it may not, as fast as it can."""
    pids = lab.processes()
    before, since = lab.counter("features", "estimates_published"), lab.lengths()
    bytes_before = resident_bytes(pids["features"])
    frames = sensor_key(STATION, "finger", "electrodes")
    sent, end_s = 0, time.monotonic() + FLOOD_S
    with lab.robot() as robot:
        while time.monotonic() < end_s:
            raw(robot).put(frames, b"\xff" * 200)
            sent += 1
        during = lab.counter("features", "estimates_published") - before
        logged = lab.told_refused("robot", since)
    grown = (resident_bytes(pids["features"]) - bytes_before) / 1e6
    lines = sum(lab.log(one)[since[one] :].count("refused") for one in since)
    numbers = {
        "sent_per_s": round(sent / FLOOD_S),
        "estimates_per_s": round(during / FLOOD_S, 1),
        "features_grew_mb": round(grown, 1),
        "lines_of_log": lines,
    }
    fine = grown < 300 and lines < 100 and lab.goes_on(before + during)
    return Outcome(fine, "nothing", logged, numbers)


def flood_of_messages(lab: Lab) -> Outcome:
    """A robot publishes poses that are none, as fast as it can."""
    key, pid = sensor_key(STATION, "arm", "robot_pose"), lab.processes()["gateway"]
    before, bytes_before = lab.counter("features", "estimates_published"), resident_bytes(pid)
    sent, end_s = 0, time.monotonic() + FLOOD_S
    with lab.robot() as robot:
        publisher = raw(robot).declare_publisher(key)
        while time.monotonic() < end_s:
            publisher.put(b"\xff" * 200)
            sent += 1
        during = lab.counter("features", "estimates_published") - before
    grown = (resident_bytes(pid) - bytes_before) / 1e6
    numbers = {
        "sent_per_s": round(sent / FLOOD_S),
        "estimates_per_s": round(during / FLOOD_S, 1),
        "gateway_grew_mb": round(grown, 1),
    }
    ended_s = time.monotonic()
    fine = grown < 300 and lab.goes_on(before + during)
    numbers["next_20_estimates_after_s"] = round(time.monotonic() - ended_s, 1)
    return Outcome(fine, "nothing", _pose_counter(lab), numbers)


def _pose_counter(lab: Lab) -> str:
    status = lab.status("gateway")
    counters = {} if status is None else dict(status.counters)
    named = [f"{name} {n:,}" for name, n in sorted(counters.items()) if "reject" in name and n]
    return f"counter gateway.{', '.join(named)}" if named else ""


def flood_of_questions(lab: Lab) -> Outcome:
    """A robot asks the features service for 3,000 estimates of nonsense at once."""
    key = service_key(STATION, "features", "features", "estimate")
    before = lab.counter("features", "estimates_published")
    asked = 3000
    answers: list[zenoh.Reply] = []
    with lab.robot() as robot:
        # What a session asks before it has heard of the service ends without an answer.
        lab.wait(lambda: is_served(raw(robot), key, LOOK_S), "the robot hears of the service")
        began_s = time.monotonic()
        for _ in range(asked):
            raw(robot).get(
                key,
                answers.append,
                payload=b"\xff" * 100,
                encoding="application/protobuf;palpate.v1.FeatureRequest",
                timeout=LIVE_S,
            )
        with suppress(TimeoutError):
            lab.wait(lambda: len(answers) >= asked, "each is answered")
    seconds = time.monotonic() - began_s
    codes = Counter(
        ERROR.decode(reply.err.payload.to_bytes()).code.name
        for reply in answers
        if reply.err is not None
    )
    numbers = {
        "asked": float(asked),
        "seconds": round(seconds, 1),
        "estimates_per_s": round(
            (lab.counter("features", "estimates_published") - before) / seconds, 1
        ),
    }
    fine = codes.total() == asked and lab.goes_on(before)
    says = ", ".join(f"{count} {code}" for code, count in codes.most_common())
    return Outcome(fine, says, "counters of features", numbers)
