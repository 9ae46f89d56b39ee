"""``palpate bench fleet``: stations behind a site's router, on network namespaces as hosts.

A station is its own router and one process that publishes frames and estimates of a finger at
100 Hz, as large as those of a gateway and a features service; what a whole station needs is
measured once, on one host. All links between hosts have mutual TLS. In the same run a consumer is
linked to such a process directly, without any router: the floor of the latency.

Then the host of an active features service, or of a finite-element service, is killed, stopped or
cut off, and the time until another one answers is taken.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from rich.console import Console

from palpate.config import Role
from palpate.errors import LinkError
from palpate.process import cpu_time_s, resident_bytes
from palpate_deploy.bench.harness import read_rows
from palpate_deploy.bench.hosts import HostLab, LabHost
from palpate_deploy.bench.results import finish, machine, owed, write_result
from palpate_deploy.station.certificates import issue, make_authority
from palpate_deploy.station.lifetime import start_child, stop_child

PORT = 21800
_START_S = 120.0
_SETTLE_S = 3.0
_STOP_S = 20.0
_HOSTS_MOST = 24
_LOCAL = f"tls/127.0.0.1:{PORT}"
_TICKS_HZ = os.sysconf("SC_CLK_TCK")
FAULTS = ("kill", "stop", "cut")


class Fleet:
    """A lab of hosts, with processes on them that end with it."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.lab = stack.enter_context(HostLab())
        self._stack = stack
        self.certificates = folder / "certs"
        make_authority(self.certificates)
        addresses = [f"10.213.{number}.{end}" for number in range(1, _HOSTS_MOST) for end in (1, 2)]
        for role in Role:
            issue(self.certificates, role, hosts=addresses)
        self._count = 0

    def start(self, command: Sequence[str], name: str) -> subprocess.Popen[bytes]:
        """Start a process that is stopped with the fleet."""
        self._count += 1
        process = start_child(command, self.folder / f"{self._count}-{name}.log")
        self._stack.callback(_end, process)
        return process

    def part(self, host: LabHost, *words: str) -> subprocess.Popen[bytes]:
        """Start a part of the bench on a host."""
        command = [sys.executable, "-m", "palpate_deploy.bench.fleet_parts", *words]
        return self.start(host.inside(command), f"{words[0]}-{host.name}")

    def run(self, inside: Callable[[Sequence[str]], list[str]], service: str, profile: str) -> Any:
        """Run one process of a profile, given as text."""
        file = self.folder / f"{self._count}.toml"
        file.write_text(profile, encoding="utf-8")
        command = [sys.executable, "-m", "palpate_deploy", "run", service, "--profile", str(file)]
        return self.start(inside(command), service)

    def site(self) -> subprocess.Popen[bytes]:
        """Start the site's router; a station's processes reach it at the address on their cable."""
        profile = _profile("site", ["router"], self.certificates, listen=f"tls/0.0.0.0:{PORT}")
        process: subprocess.Popen[bytes] = self.run(self.lab.at_site, "router", profile)
        return process

    def station_router(self, host: LabHost) -> subprocess.Popen[bytes]:
        """Start the router of the station on a host."""
        up = f"connect = [{json.dumps(up_to(host))}]\n"
        profile = _profile(host.name, ["router"], self.certificates, listen=_LOCAL, router=up)
        process: subprocess.Popen[bytes] = self.run(host.inside, "router", profile)
        return process


def up_to(host: LabHost) -> str:
    """The site's router, as a host reaches it."""
    return f"tls/{host.site}:{PORT}"


def _profile(
    station: str,
    processes: list[str],
    certificates: Path,
    *,
    listen: str = "",
    connect: str = "",
    router: str = "",
    replica: str = "",
    more: str = "",
) -> str:
    lines = [f"station = {json.dumps(station)}", f"processes = {json.dumps(processes)}"]
    lines += [f"replica = {json.dumps(replica)}"] if replica else []
    lines += ["[link]", f"certificates = {json.dumps(str(certificates))}"]
    lines += [f"connect = [{json.dumps(connect)}]"] if connect else []
    lines += ["[router]", f"listen = [{json.dumps(listen)}]", router] if listen else []
    return "\n".join([*lines, more]) + "\n"


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGCONT)
    stop_child(process, _STOP_S)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _until(true: Callable[[], Any], what: str, seconds: float = _START_S) -> None:
    end_s = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end_s:
            raise LinkError(f"the fleet of the bench: {what}", remedy="look at its logs")
        time.sleep(0.05)


def measure_scale(stations: int, seconds: float) -> dict[str, Any]:
    """Costs of a site with so many stations, and latency beside the floor."""
    with tempfile.TemporaryDirectory(prefix="palpate-fleet-") as name, contextlib.ExitStack() as st:
        fleet = Fleet(Path(name), st)
        hosts = [fleet.lab.add(f"s{number + 1}") for number in range(stations)]
        other, floor = fleet.lab.add("consumer"), fleet.lab.add("floor")
        site = fleet.site()
        certs = str(fleet.certificates)
        routers = [fleet.station_router(host) for host in hosts]
        for host in hosts:
            fleet.part(host, "publisher", _LOCAL, certs, host.name)
        door = f"tls/{floor.address}:{PORT}"
        fleet.part(floor, "publisher", "", certs, "floor", door)
        direct = fleet.folder / "floor.npz"
        # The floor's consumer sits at the site's end of that cable: one link, no router.
        command = [sys.executable, "-m", "palpate_deploy.bench.fleet_parts", "consumer", door]
        floor_consumer = fleet.start(
            fleet.lab.at_site(
                [*command, certs, "electrodes", str(direct), f"tls/{floor.site}:{PORT + 1}"]
            ),
            "floor",
        )
        _until(direct.with_suffix(".up").exists, "the floor does not start")
        time.sleep(_SETTLE_S + 1.0 * stations)
        phases: dict[str, Any] = {}
        topics = ("nobody", "features", "electrodes")
        for topic in topics:
            watching, out = None, fleet.folder / f"{topic}.npz"
            if topic != "nobody":
                watching = fleet.part(other, "consumer", up_to(other), certs, topic, str(out))
                _until(out.with_suffix(".up").exists, "the consumer does not join")
                time.sleep(_SETTLE_S)
            before, cpu_s, began_s = (
                [sum(fleet.lab.crossed_bytes(host)) for host in hosts],
                cpu_time_s(site.pid),
                time.monotonic(),
            )
            station_s = [cpu_time_s(one.pid) for one in routers]
            time.sleep(seconds)
            took_s = time.monotonic() - began_s
            after = [sum(fleet.lab.crossed_bytes(host)) for host in hosts]
            used_s, rss = cpu_time_s(site.pid), resident_bytes(site.pid)
            spent = [cpu_time_s(one.pid) - was for one, was in zip(routers, station_s, strict=True)]
            phases[topic] = {
                "bytes_hz_each": round(
                    float(np.mean([b - a for a, b in zip(before, after, strict=True)])) / took_s
                ),
                "site_cpu_ratio": (used_s - cpu_s) / took_s,
                "site_rss_bytes": rss,
                "station_router_cpu_ratio": float(np.mean(spent)) / took_s,
                "station_router_rss_bytes": float(
                    np.mean([resident_bytes(r.pid) for r in routers])
                ),
            }
            if watching is not None:
                end_ns = _stop_consumer(watching)
                phases[topic] |= _latency(out, stations, end_ns)
        end_ns = _stop_consumer(floor_consumer)
        # Of the last phase alone, beside which it stands.
        direct_s = _latency(direct, 1, end_ns, since_ns=round(1e9 * began_s))
        return {
            "stations": stations,
            "phases": phases,
            "floor": direct_s,
            "floor_beside": topics[-1],
            "ratio_p50": phases["electrodes"]["p50_s"] / direct_s["p50_s"],
        }


def _stop_consumer(process: subprocess.Popen[bytes]) -> int:
    """Stop a consumer, which then writes what it took; until when it did [ns, monotonic]."""
    end_ns = time.monotonic_ns()
    stop_child(process, _STOP_S)
    return end_ns


def _latency(out: Path, stations: int, end_ns: int, *, since_ns: int = 0) -> dict[str, Any]:
    """Latency of what a consumer took, and what was lost since its first message.

    A station that fell silent before ``end_ns`` has lost what it would have sent. Messages that
    came before ``since_ns`` are left out; both [ns], host monotonic clock.
    """
    names, rows, _ = read_rows(out)
    names, rows = names[rows[:, 2] >= since_ns], rows[rows[:, 2] >= since_ns]
    if not len(rows):
        raise LinkError("the consumer heard nothing", remedy="look at the logs of the fleet")
    ages_s = (rows[:, 2] - rows[:, 1]) * 1e-9
    lost = 0
    for station in set(names.tolist()):
        own = rows[names == station, 0]
        lost += int(own.max() - own.min() + 1 - len(set(own.tolist())))
        lost += owed(np.sort(rows[names == station, 2]), end_ns)
    p50, p99 = np.percentile(ages_s, (50, 99))
    return {
        "p50_s": float(p50),
        "p99_s": float(p99),
        "received": len(rows),
        "lost": lost,
        "heard_stations": len(set(names.tolist())),
        "expected_stations": stations,
    }


def measure_impaired(seconds: float) -> list[dict[str, Any]]:
    """One station whose cable delays or loses packets."""
    found: list[dict[str, Any]] = []
    for words in ((), ("delay", "10ms"), ("delay", "10ms", "5ms"), ("loss", "1%"), ("loss", "5%")):
        with (
            tempfile.TemporaryDirectory(prefix="palpate-fleet-") as name,
            contextlib.ExitStack() as stack,
        ):
            fleet = Fleet(Path(name), stack)
            host, other = fleet.lab.add("s1"), fleet.lab.add("consumer")
            fleet.site()
            fleet.station_router(host)
            certs, out = str(fleet.certificates), fleet.folder / "heard.npz"
            fleet.part(host, "publisher", _LOCAL, certs, host.name)
            watching = fleet.part(other, "consumer", up_to(other), certs, "electrodes", str(out))
            _until(out.with_suffix(".up").exists, "the consumer does not join")
            time.sleep(_SETTLE_S)
            if words and (why := fleet.lab.impair(host, words)):
                found.append({"netem": " ".join(words), "not_measured": why})
                continue
            time.sleep(seconds)
            end_ns = _stop_consumer(watching)
            found.append({"netem": " ".join(words) or "none", **_latency(out, 1, end_ns)})
    return found


@contextlib.contextmanager
def _fault(
    fleet: Fleet, host: LabHost, process: subprocess.Popen[bytes], kind: str
) -> Iterator[int]:
    """A fault while the block runs; when it began [ns, monotonic]."""
    began_ns = time.monotonic_ns()
    if kind == "kill":
        os.killpg(process.pid, signal.SIGKILL)
    elif kind == "stop":
        os.killpg(process.pid, signal.SIGSTOP)
    else:
        fleet.lab.plug(host, plugged=False)
    try:
        yield began_ns
    finally:
        if kind == "stop":
            os.killpg(process.pid, signal.SIGCONT)
        elif kind == "cut":
            fleet.lab.plug(host, plugged=True)


_FINGER = """
[[gateway.sensors]]
name = "finger"
driver = "virtual"
options = { seed = 1, unit = "biotac-2" }
"""
_FEATURES = '[features]\nbundle = "features-twin"\n'
_WATCH_S = 8.0


def measure_takeovers(times: int) -> list[dict[str, Any]]:
    """Gap in the estimates of a finger when the active features service of two is lost."""
    with tempfile.TemporaryDirectory(prefix="palpate-fleet-") as name, contextlib.ExitStack() as st:
        fleet = Fleet(Path(name), st)
        arm, other = fleet.lab.add("arm1"), fleet.lab.add("consumer")
        hosts = {replica: fleet.lab.add(f"pc-{replica}") for replica in "ab"}
        fleet.site()
        fleet.station_router(arm)
        certs = fleet.certificates
        gateway = _profile("arm1", ["gateway"], certs, connect=_LOCAL, more=_FINGER)
        fleet.run(arm.inside, "gateway", gateway)

        def service(replica: str) -> subprocess.Popen[bytes]:
            host = hosts[replica]
            more, up = _FEATURES, up_to(host)
            text = _profile("arm1", ["features"], certs, connect=up, replica=replica, more=more)
            process: subprocess.Popen[bytes] = fleet.run(host.inside, "features", text)
            return process

        active, waiting = "a", "b"
        running = {active: service(active)}
        time.sleep(15.0)
        running[waiting] = service(waiting)
        time.sleep(15.0)
        found: list[dict[str, Any]] = []
        for kind in [*FAULTS] * times:
            out = fleet.folder / f"{len(found)}.npz"
            watch = fleet.part(other, "consumer", up_to(other), str(certs), "features", str(out))
            _until(out.with_suffix(".up").exists, "the consumer does not join")
            time.sleep(_SETTLE_S)
            with _fault(fleet, hosts[active], running[active], kind) as began_ns:
                time.sleep(_WATCH_S)
            healed_ns = time.monotonic_ns()
            time.sleep(_WATCH_S)
            stop_child(watch, _STOP_S)
            found.append({"fault": kind, **_gap(out, began_ns, healed_ns)})
            if kind == "kill":
                running[active] = service(active)
                time.sleep(12.0)
            if kind != "cut":  # of two that published, the one that began earlier goes on
                active, waiting = waiting, active
        return found


def _gap(out: Path, began_ns: int, healed_ns: int) -> dict[str, Any]:
    """The longest pause of the estimates by a fault [s]; how many came twice or out of order.

    It is from the last estimate before the fault to the first one after its end. Where none came
    after it (``estimates_after_heal`` is 0), the pause is at least as long as is told.
    """
    _, rows, _ = read_rows(out)
    arrivals = rows[:, 2]
    before = arrivals[arrivals <= began_ns]
    during = arrivals[(arrivals > began_ns) & (arrivals <= healed_ns)]
    after = arrivals[arrivals > healed_ns]
    begin = before[-1] if len(before) else began_ns
    end = after[0] if len(after) else healed_ns
    sequences = rows[:, 0]
    return {
        "gap_s": float(np.diff([begin, *during, end]).max() * 1e-9),
        "estimates_after_heal": len(after),
        "gap_after_heal_s": float(np.diff(after).max() * 1e-9) if len(after) > 1 else None,
        "twice": int(len(sequences) - len(set(sequences.tolist()))),
        "out_of_order": int((np.diff(sequences) < 0).sum()),
    }


_FEM = """
[fem]
workers = 1
threads = 1
waiting = 2
options = { edge_m = 1.4e-3 }
fingertip = { fluid_volume_m3 = 0.6e-6 }
"""


def measure_asked_again(times: int) -> list[dict[str, Any]]:
    """Time until another finite-element service answers when the one that computes is lost."""
    with tempfile.TemporaryDirectory(prefix="palpate-fleet-") as name, contextlib.ExitStack() as st:
        fleet = Fleet(Path(name), st)
        hosts = {replica: fleet.lab.add(f"fe-{replica}") for replica in "ab"}
        other = fleet.lab.add("consumer")
        fleet.site()
        certs = fleet.certificates

        def service(replica: str) -> subprocess.Popen[bytes]:
            up = up_to(hosts[replica])
            text = _profile("pool", ["fem"], certs, connect=up, replica=replica, more=_FEM)
            process: subprocess.Popen[bytes] = fleet.run(hosts[replica].inside, "fem", text)
            return process

        running = {replica: service(replica) for replica in "ab"}
        time.sleep(45.0)
        fleet.part(other, "asker", up_to(other), str(certs), "pool", "120")
        log = next(fleet.folder.glob("*-asker-consumer.log"))
        found: list[dict[str, Any]] = []
        for kind in [*FAULTS] * times:
            lines = _lines(log)
            _until(lambda: _solving(_lines(log), len(lines)), "no simulation runs")  # noqa: B023
            shares = {one: _group_cpu_s(running[one].pid) for one in "ab"}
            time.sleep(0.5)
            busy = max("ab", key=lambda one: _group_cpu_s(running[one].pid) - shares[one])
            with _fault(fleet, hosts[busy], running[busy], kind) as began_ns:
                after: list[list[str]] = []

                def answered() -> bool:
                    events = [one for one in _lines(log) if int(one[2]) > began_ns]
                    steps = [one for one in events if one[0] == "progress"]
                    # Another service begins with the first step.
                    again = [one for one in steps if int(one[1]) == 0] + [
                        one for one in events if one[0] == "error"
                    ]
                    after[:] = again[:1]  # noqa: B023
                    return bool(again)

                _until(answered, "nobody answers")
            first = after[0]
            found.append(
                {
                    "fault": kind,
                    "outcome": "error" if first[0] == "error" else "asked again",
                    "what": first[1],
                    "after_s": (int(first[2]) - began_ns) * 1e-9,
                }
            )
            if kind == "kill":
                running[busy] = service(busy)
            time.sleep(30.0)
        return found


def _lines(log: Path) -> list[list[str]]:
    """Whole lines of the asker."""
    text = log.read_text(encoding="utf-8", errors="replace")
    parts = [line.split() for line in text.splitlines()]
    return [one for one in parts if len(one) == 3 and one[0] in ("progress", "done", "error")]


def _solving(lines: list[list[str]], before: int) -> bool:
    """Whether a new simulation has solved its first steps."""
    return len(lines) > before and lines[-1][0] == "progress" and 2 <= int(lines[-1][1]) < 20


def _group_cpu_s(group: int) -> float:
    total = 0.0
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                words = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
                if int(words[2]) == group:
                    total += (int(words[11]) + int(words[12])) / _TICKS_HZ
    return total


def measure_whole_station(seconds: float) -> dict[str, Any]:
    """Processor time and memory of a station: router, gateway of a virtual finger, features."""
    with tempfile.TemporaryDirectory(prefix="palpate-fleet-") as name, contextlib.ExitStack() as st:
        fleet = Fleet(Path(name), st)
        host = fleet.lab.add("arm1")
        fleet.site()
        certs = fleet.certificates
        processes = {"router": fleet.station_router(host)}
        for service, more in (("gateway", _FINGER), ("features", _FEATURES)):
            text = _profile("arm1", [service], certs, connect=_LOCAL, more=more)
            processes[service] = fleet.run(host.inside, service, text)
        time.sleep(20.0)
        before = {service: cpu_time_s(one.pid) for service, one in processes.items()}
        began_s = time.monotonic()
        time.sleep(seconds)
        took_s = time.monotonic() - began_s
        return {
            service: {
                "cpu_ratio": (cpu_time_s(one.pid) - before[service]) / took_s,
                "rss_bytes": resident_bytes(one.pid),
            }
            for service, one in processes.items()
        }


def _leave(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def run_fleet(
    *,
    stations: Sequence[int],
    seconds: float,
    times: int,
    as_json: bool,
    save: bool,
    out: Path | None,
) -> int:
    """Measure and print.

    Raises:
        ConfigError: Namespaces cannot be made here, or there is no history to append to.
        LinkError: A part of the fleet does not work.
    """
    console = Console(stderr=True)
    signal.signal(signal.SIGTERM, _leave)  # as Ctrl-C: an exception closes everything
    values: dict[str, Any] = {"scale": []}
    for number in stations:
        console.print(f"{number} stations ...")
        values["scale"].append(measure_scale(number, seconds))
        _keep(values, out)
    console.print("a whole station ...")
    values["station"] = measure_whole_station(seconds)
    console.print("delays and losses ...")
    values["impaired"] = measure_impaired(seconds)
    _keep(values, out)
    if times:
        console.print("a standby takes over ...")
        values["takeovers"] = measure_takeovers(times)
        _keep(values, out)
        console.print("simulations are asked again ...")
        values["asked_again"] = measure_asked_again(times)
    finish("fleet", values, lambda: _show(values), as_json=as_json, save=save, out=out)
    return 0


def _keep(values: dict[str, Any], out: Path | None) -> None:
    """Write what is known so far: a measurement that breaks off leaves that."""
    if out is not None:
        write_result(out, json.dumps({**values, "machine": machine()}, indent=2) + "\n")


def _show(values: dict[str, Any]) -> None:
    print(json.dumps(values, indent=2))
