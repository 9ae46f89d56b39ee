"""From what a chaos run has noted to its report: shares of time, times, counts, goals."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.chaos.debian import commit
from tests.chaos.faults import Fault, catalogue
from tests.chaos.observer import FRESH_S, HUNG_S, QUERY_S
from tests.chaos.recordings import check_recordings

from palpate_deploy.bench.results import machine

Rows = npt.NDArray[np.int64]
"""Sequence, device's counter, stamp [ns], arrival [ns], run of the gateway; shape (N, 5)."""

HOLE_S = 0.2
"""A shorter time without a fresh estimate is not an outage of a fault: this host is shared [s]."""

MEMORY_BYTES = 64 << 20
"""Memory of all processes may be so much more at the end: every one has been started anew."""

_SEQUENCE, _TICK, _STAMP, _ARRIVAL, _RUN = range(5)
_MORE_S = 1.0


@dataclass(frozen=True, slots=True)
class Notes:
    """All that was noted: by the run, by the robot, and what the station wrote."""

    run: dict[str, Any]
    robot: dict[str, Any]
    estimates: Rows
    frames: Rows
    lines: list[str]
    strangers: list[dict[str, Any]]

    @classmethod
    def read(cls, work: Path) -> Notes:
        """From the folder of a run."""
        robot = work / "robot"
        strangers = work / "strangers.jsonl"
        texts = strangers.read_text("utf-8").splitlines() if strangers.exists() else []
        return cls(
            json.loads((work / "run.json").read_text("utf-8")),
            json.loads((robot / "notes.json").read_text("utf-8")),
            np.load(robot / "features.npy"),
            np.load(robot / "electrodes.npy"),
            log_lines(work / "logs"),
            [json.loads(text) for text in texts if text],
        )


def log_lines(folder: Path) -> list[str]:
    """Every line of journal and logs, after the name of its file or unit."""
    lines = []
    for text in (folder / "journal.jsonl").read_text("utf-8").splitlines():
        entry = json.loads(text)
        said = entry.get("MESSAGE") or ""
        if isinstance(said, list):  # not UTF-8
            said = bytes(said).decode(errors="replace")
        lines.append(f"journal {entry.get('SYSLOG_IDENTIFIER', '')}: {said}")
    for file in sorted(folder.glob("*.log*")):
        name = file.name.rpartition("-")[2].partition(".")[0]
        lines += [f"{name} {line}" for line in file.read_text("utf-8", "replace").splitlines()]
    return lines


def holes(rows: Rows, began_ns: int, ended_ns: int) -> Rows:
    """Times without a fresh estimate: begin and end [ns], shape (H, 2).

    At each moment the newest estimate that has arrived counts; it is fresh for ``FRESH_S`` after
    its stamp.
    """
    order = np.argsort(rows[:, _ARRIVAL], kind="stable")
    arrived = rows[order, _ARRIVAL]
    until = np.maximum.accumulate(rows[order, _STAMP]) + round(FRESH_S * 1e9)
    # Fresh from each arrival until the estimate is too old; one that is too old when it comes
    # changes nothing.
    fresh = until > arrived
    ends = np.maximum.accumulate(np.concatenate([[began_ns], until[fresh]]))
    starts = np.concatenate([arrived[fresh], [ended_ns]])
    found = np.stack([np.maximum(ends, began_ns), np.minimum(starts, ended_ns)], axis=1)
    return found[found[:, 1] > found[:, 0]].astype(np.int64)


def share_without(gaps: Rows, began_ns: int, ended_ns: int) -> float:
    """Share of a time that lies in gaps."""
    inside = np.minimum(gaps[:, 1], ended_ns) - np.maximum(gaps[:, 0], began_ns)
    return float(np.maximum(inside, 0).sum() / max(ended_ns - began_ns, 1))


def report(work: Path, minutes: float, seed: int) -> dict[str, Any]:
    """The whole report, as it is written to chaos.json."""
    notes = Notes.read(work)
    run = notes.run
    began, ended = run["began_ns"], run["ended_ns"]
    gaps = holes(notes.estimates, began, ended)
    events, spoiled = _sound(run)
    run["events"] = events
    faults = [_fault(kind, notes, gaps) for kind in catalogue()]
    calm = _calm(events, began, ended)
    calm_ns = sum(b - a for a, b in calm)
    missing = sum(share_without(gaps, a, b) * (b - a) for a, b in calm)
    estimates = _stream(notes.estimates)
    frames = _stream(notes.frames)
    found: dict[str, Any] = {
        "minutes": round((ended - began) / 60e9, 1),
        "asked_minutes": minutes,
        "seed": seed,
        "commit": commit(),
        "machine": machine(),
        "load": _spread(run["load"]),
        "availability": {
            "all": 1.0 - share_without(gaps, began, ended),
            "between_faults": 1.0 - missing / max(calm_ns, 1),
            "between_faults_s": calm_ns * 1e-9,
            "asked": notes.robot["control"],
        },
        "events": [
            {
                "fault": one["fault"],
                "at_s": (one["begun_ns"] - began) * 1e-9,
                "lasted_s": (one["mended_ns"] - one["begun_ns"]) * 1e-9,
                "well_s": (one["well_ns"] - one["mended_ns"]) * 1e-9 if one["well_ns"] else None,
                "pair": one["pair"],
            }
            for one in events
        ],
        "holes": [
            [round((a - began) * 1e-9, 3), round((b - a) * 1e-9, 3)]
            for a, b in gaps
            if b - a > 0.1e9
        ],
        "faults": [one for one in faults if one["times"]],
        "pairs": _pairs(notes, gaps),
        "estimates": estimates,
        "frames": {**frames, "told_lost": _told_lost(notes.robot["counters"]["electrodes"])},
        "counters": notes.robot["counters"],
        "queries": _queries(notes),
        "strangers": notes.strangers,
        "recordings": check_recordings(work / "recordings", notes.frames, events),
        "uses": run["uses"],
        "zombies": run["zombies"],
        "undone": run["undone"],
        "spoiled": [one["fault"] for one in spoiled],
        "left": run["left"],
        "secrets": _secrets(work),
    }
    found["goals"] = goals(found)
    return found


def _sound(run: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The faults, and those that say nothing: this program had not mended what it had broken.

    They go on until all was well again.
    """
    failed = {text.partition(":")[0] for text in run["undone"]}
    sound: list[dict[str, Any]] = []
    spoiled: list[dict[str, Any]] = []
    broken = False
    for event in run["events"]:
        broken = broken or event["fault"] in failed
        (spoiled if broken else sound).append(event)
        broken = broken and not event["well_ns"]
    return sound, spoiled


def _fault(kind: Fault, notes: Notes, gaps: Rows) -> dict[str, Any]:
    """All of one kind, that came alone."""
    events = [one for one in notes.run["events"] if one["fault"] == kind.name]
    alone = [one for one in events if not one["pair"]]
    seen = [_seen(kind, one, notes) for one in alone] if kind.seen else []
    back = [_back(kind, one, notes, gaps) for one in alone]
    lost = [_lost(one, notes.frames) for one in alone]
    logged = sum(bool(re.search(kind.log, line)) for line in notes.lines) if kind.log else None
    known = [one for one in back if one is not None]
    noticed = [one for one in seen if one is not None]
    return {
        "fault": kind.name,
        "times": len(events),
        "alone": len(alone),
        "own": kind.own,
        "goal_s": kind.goal_s,
        "back_s": back,
        "missed": sum(one is None or one > kind.goal_s for one in back),
        "p50_s": float(np.median(known)) if known else None,
        "max_s": max(known, default=None),
        "seen": kind.seen,
        "seen_goal_s": kind.seen_goal_s,
        "seen_s": seen,
        "seen_p50_s": float(np.median(noticed)) if noticed else None,
        "seen_missed": sum(one is None or one > kind.seen_goal_s for one in seen),
        "frames_missing": lost,
        "logged": logged,
    }


def _window(event: dict[str, Any]) -> tuple[int, int]:
    """From the fault to when all was well again [ns]."""
    end = event["well_ns"] or event["mended_ns"] + 90 * 10**9
    return event["begun_ns"], end + round(_MORE_S * 1e9)


def _back(kind: Fault, event: dict[str, Any], notes: Notes, gaps: Rows) -> float | None:
    """Time until what the fault broke works again [s]; None = it did not."""
    begun, end = _window(event)
    since = event["mended_ns"]
    if not event["well_ns"]:
        return None
    what, _, name = kind.back.partition(" ")
    if what == "stream":
        wide = gaps[(gaps[:, 1] - gaps[:, 0] > HOLE_S * 1e9) & (gaps[:, 1] > begun)]
        wide = wide[(wide[:, 0] < event["well_ns"]) & (wide[:, 1] > since)]
        return max(0.0, (int(wide[-1, 1]) - since) * 1e-9) if len(wide) else 0.0
    if what == "ready":
        told = [(at, there) for at, who, which, there in notes.robot["tokens"]
                if who == name and which == "ready" and begun <= at <= end]  # fmt: skip
        ups = [at for at, there in told if there]
        return (ups[-1] - since) * 1e-9 if ups else None
    if what == "state":
        states = [one for one in notes.robot["statuses"] if one["service"] == name]
        bad = [one["at_ns"] for one in states
               if begun <= one["at_ns"] <= end and one["state"] != "READY"]  # fmt: skip
        if not bad:
            return 0.0
        good = [one["at_ns"] for one in states
                if one["at_ns"] > bad[-1] and one["state"] == "READY"]  # fmt: skip
        return max(0.0, (good[0] - since) * 1e-9) if good else None
    answered = [began + took for began, took, said in notes.robot["queries"]
                if said == "answered" and began + took > since * 1e-9]  # fmt: skip
    return min(answered) - since * 1e-9 if answered else None


def _seen(kind: Fault, event: dict[str, Any], notes: Notes) -> float | None:
    """Time until somebody on the bus could know of it [s]; None = nobody could."""
    begun, end = _window(event)
    what, _, name = kind.seen.partition(" ")
    first: int | None = None
    if what == "token":
        first = _first(at for at, who, _, there in notes.robot["tokens"]
                       if who == name and not there and begun <= at <= end)  # fmt: skip
    elif what == "stale":
        rows = notes.estimates
        before = rows[rows[:, _ARRIVAL] < begun]
        if len(before):
            # The robot's own clock tells it, whoever else is silent.
            later = rows[(rows[:, _ARRIVAL] >= begun)]
            stamps = np.concatenate([before[-1:, _STAMP], later[:, _STAMP]])
            arrivals = np.append(later[:, _ARRIVAL], end)
            too_old = np.maximum.accumulate(stamps) + round(FRESH_S * 1e9)
            late = np.flatnonzero(arrivals > too_old)
            first = int(too_old[late[0]]) if len(late) else None
    else:
        # What is told of it may come before whoever does it has done.
        tried = event["tried_ns"]
        said = [one for one in notes.robot["statuses"] if tried <= one["at_ns"] <= end]
        if what == "state":
            first = _first(one["at_ns"] for one in said
                           if one["service"] == name and one["state"] == "DEGRADED")  # fmt: skip
        elif what == "lost":
            first = _first(one["at_ns"] for one in said
                           if one["service"] == "gateway" and "LOST" in one["sensors"].values()
                           )  # fmt: skip
            frames = notes.frames[notes.frames[:, _ARRIVAL] < (first or end)]
            if first is not None and len(frames):
                return (first - int(frames[-1, _STAMP])) * 1e-9
        else:
            first = _counted(kind.seen, said, notes, tried)
    return None if first is None else max(0.0, (first - begun) * 1e-9)


def _counted(what: str, said: Sequence[dict[str, Any]], notes: Notes, begun: int) -> int | None:
    """When a counter had first grown after the fault."""
    who = "gateway" if what == "steps" else "features"
    before = [one[what] for one in notes.robot["statuses"]
              if one["service"] == who and one["at_ns"] < begun]  # fmt: skip
    base = before[-1] if before else 0
    return _first(one["at_ns"] for one in said if one["service"] == who and one[what] > base)


def _first(times: Iterable[int]) -> int | None:
    return min(times, default=None)


def _lost(event: dict[str, Any], frames: Rows) -> int:
    """Frames of the device that the robot did not get while the fault went on."""
    begun, end = _window(event)
    inside = frames[(frames[:, _ARRIVAL] >= begun) & (frames[:, _ARRIVAL] <= end)]
    before = frames[frames[:, _ARRIVAL] < begun]
    ticks = np.concatenate([before[-1:, _TICK], inside[:, _TICK]])
    steps = np.diff(ticks)
    return int(np.maximum(steps[steps > 0] - 1, 0).sum())


def _pairs(notes: Notes, gaps: Rows) -> list[dict[str, Any]]:
    """Two at once: each must be over within the sum of both goals."""
    kinds = {kind.name: kind for kind in catalogue()}
    found = []
    events = [one for one in notes.run["events"] if one["pair"]]
    for first, second in zip(events[::2], events[1::2], strict=True):
        both = [kinds[one["fault"]] for one in (first, second)]
        back = [
            _back(kind, one, notes, gaps) for kind, one in zip(both, (first, second), strict=True)
        ]
        goal_s = sum(kind.goal_s for kind in both)
        found.append(
            {
                "faults": [kind.name for kind in both],
                "back_s": back,
                "goal_s": goal_s,
                "met": all(one is not None and one <= goal_s for one in back),
            }
        )
    return found


def _calm(events: Sequence[dict[str, Any]], began: int, ended: int) -> list[tuple[int, int]]:
    """Times outside of faults: from a second after all was well to the next fault [ns]."""
    calm, free = [], began
    for event in sorted(events, key=lambda one: one["begun_ns"]):
        if event["begun_ns"] > free:
            calm.append((free, event["begun_ns"]))
        free = max(free, _window(event)[1])
    if ended > free:
        calm.append((free, ended))
    return calm


def _stream(rows: Rows) -> dict[str, Any]:
    """Order, age and holes of what the robot got."""
    same = rows[1:, _RUN] == rows[:-1, _RUN]
    steps = np.diff(rows[:, _SEQUENCE])
    ages_s = (rows[:, _ARRIVAL] - rows[:, _STAMP]) * 1e-9
    return {
        "received": len(rows),
        "runs": int((~same).sum()) + 1,
        "missing": int(np.maximum(steps[same] - 1, 0).sum()),
        "out_of_order": int((steps[same] <= 0).sum()),
        "older_than_last": int((np.diff(rows[:, _STAMP]) <= 0).sum()),
        "repeated": len(rows) - len(np.unique(rows[:, [_RUN, _SEQUENCE]], axis=0)),
        "from_the_future": int((ages_s < -0.005).sum()),
        "p50_s": float(np.median(ages_s)),
        "p99_s": float(np.percentile(ages_s, 99)),
        "max_s": float(ages_s.max()),
    }


def _told_lost(counters: dict[str, int]) -> int:
    """What palpate's subscriber itself says is missing."""
    return counters.get("lost_on_bus", 0) + counters.get("dropped", 0)


def _queries(notes: Notes) -> dict[str, Any]:
    queries = [one for one in notes.robot["queries"] if one[0] > notes.run["began_ns"] * 1e-9]
    said = Counter(one[2] for one in queries)
    times = [one[1] for one in queries if one[2] == "answered"]
    late = sum(one[1] > HUNG_S for one in queries)
    return {
        "asked": len(queries) + notes.robot["unanswered"],
        "said": dict(said.most_common()),
        "hung": late + notes.robot["unanswered"],
        "untyped": sum(count for what, count in said.items() if what.startswith("untyped")),
        "past_deadline": sum(one[1] > QUERY_S + 1.0 for one in queries),
        "p50_s": float(np.median(times)) if times else None,
        "longest_s": max((one[1] for one in queries), default=None),
    }


def _secrets(work: Path) -> dict[str, int]:
    """How often a secret of the station stands in a log or a recording."""
    secrets = {"private key": b"PRIVATE KEY"}
    for role in ("router", "gateway", "service"):
        key = (work / "certs" / role / "key.pem").read_text("ascii").splitlines()[1]
        secrets[f"key of the {role}"] = key.encode()
    token = work / "token"
    if token.exists() and (text := token.read_bytes().strip()):
        secrets["admin token"] = text
        secrets["admin token in hexadecimals"] = text.hex().encode()
    found: defaultdict[str, int] = defaultdict(int)
    for folder in ("logs", "recordings"):
        for file in (work / folder).rglob("*"):
            data = file.read_bytes() if file.is_file() else b""
            for name, secret in secrets.items():
                found[name] += secret in data
    return {name: found[name] for name in secrets}


def _spread(values: Sequence[float]) -> dict[str, float]:
    return {"least": min(values), "median": float(np.median(values)), "most": max(values)}


def goals(found: dict[str, Any]) -> list[dict[str, Any]]:
    """What must hold of the whole run, what was found, and whether it holds."""
    estimates, frames, queries = found["estimates"], found["frames"], found["queries"]
    records = found["recordings"]
    kinds = found["faults"]
    start, end = found["uses"]["start"], found["uses"]["end"]
    grown = {
        what: sum(one[what] for one in end["processes"].values())
        - sum(one[what] for one in start["processes"].values())
        for what in ("rss_bytes", "threads", "descriptors")
    }
    flooded = [one for one in found["strangers"] if one["what"] == "flood"]
    unlogged = [one["fault"] for one in kinds if one["logged"] is not None
                and one["logged"] < one["times"]]  # fmt: skip
    slow = [one["fault"] for one in kinds if one["missed"]]
    unseen = [one["fault"] for one in kinds if one["seen_missed"]]
    never = sum(one["well_s"] is None for one in found["events"])
    table = [
        ("all is well again after every fault", f"{never} times not", never == 0),
        ("every fault is over in time", ", ".join(slow) or "all", not slow),
        ("every fault is noticed in time", ", ".join(unseen) or "all", not unseen),
        ("two at once are over in the sum of their goals",
         f"{sum(one['met'] for one in found['pairs'])} of {len(found['pairs'])}",
         all(one["met"] for one in found["pairs"])),
        ("no estimate out of order, repeated, or from the future",
         f"{estimates['out_of_order']}, {estimates['repeated']}, {estimates['from_the_future']}",
         not (estimates["out_of_order"] or estimates["repeated"] or estimates["from_the_future"])),
        ("no estimate that is older than the one before",
         str(estimates["older_than_last"]), estimates["older_than_last"] == 0),
        ("a controller never acts on a stale estimate, or one with a negative age",
         f"{found['availability']['asked']['stale_used']}, "
         f"{found['availability']['asked']['negative']} of "
         f"{found['availability']['asked']['fresh']}",
         not (found["availability"]["asked"]["stale_used"]
              or found["availability"]["asked"]["negative"])),
        ("missing frames: palpate's own count is the robot's",
         f"{frames['told_lost']} told, {frames['missing']} found",
         frames["told_lost"] == frames["missing"]),
        ("questions: each answered, or a typed error",
         f"{queries['asked']} asked, {queries['hung']} hung, {queries['untyped']} untyped",
         not (queries["hung"] or queries["untyped"])),
        ("a flood is refused with a typed error",
         f"{sum(one.get('resource_exhausted', 0) for one in flooded)} refused, "
         f"{sum(one.get('untyped', 0) + one.get('timeout', 0) for one in flooded)} otherwise",
         all(not one.get("untyped") and not one.get("timeout") for one in flooded)),
        ("every recording is readable",
         f"{records['readable']} of {records['files']}", records["readable"] == records["files"]),
        ("no cut-off recording is left, or looks whole",
         f"{records['parts']} left, {records['look_whole']} look whole",
         not (records["parts"] or records["look_whole"])),
        ("a killed recorder loses at most 0.3 s",
         f"{records['lost_max_s']:.3f} s at most" if records["kills"] else "not killed",
         records["lost_max_s"] <= 0.3),
        ("every fault is in the journal or a log", ", ".join(unlogged) or "all", not unlogged),
        ("no secret in a log or a recording",
         str(sum(found["secrets"].values())), not any(found["secrets"].values())),
        ("no zombie", str(sum(found["zombies"].values())), not found["zombies"]),
        ("as many processes as at the start", f"{start['count']} to {end['count']}",
         start["count"] == end["count"]),
        ("no more threads and descriptors than at the start (10 % allowed)",
         f"{grown['threads']:+d}, {grown['descriptors']:+d}",
         all(grown[what] <= 0.1 * sum(one[what] for one in start["processes"].values())
             for what in ("threads", "descriptors"))),
        (f"memory of all grows by {MEMORY_BYTES >> 20} MiB at most",
         f"{grown['rss_bytes'] / 1e6:+.0f} MB", grown["rss_bytes"] <= MEMORY_BYTES),
        ("nothing is left in memory or temporary folders after the stop",
         ", ".join(found["left"]) or "nothing", not found["left"]),
    ]  # fmt: skip
    return [{"what": what, "found": said, "met": bool(met)} for what, said, met in table]
