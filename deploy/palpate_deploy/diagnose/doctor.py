"""``palpate doctor``: checks of what a station needs on this host, each with a fix."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from rich.console import Console

from palpate.clock import EARLIEST_WALL_S
from palpate.config import endpoint_host_port, is_loopback
from palpate.errors import ConfigError, LinkError, PalpateError
from palpate.process import state_folder
from palpate_deploy.station.host import check_free, join
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.processes import check_certificates, check_packages, role_of
from palpate_deploy.station.profile import Profile, load_profile

Grade = Literal["ok", "warn", "fail"]
Found = tuple[Grade, str, str]
"""Grade, result and fix of one check, see ``Finding``."""

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}
_PYTHON_MIN = (3, 11)
_PACKAGES = (
    # module, distribution, extra; None = always needed
    ("numpy", "numpy", None),
    ("zenoh", "eclipse-zenoh", None),
    ("google.protobuf", "protobuf", None),
    ("mcap", "mcap", None),
    ("supervisor", "supervisor", None),
    ("onnxruntime", "onnxruntime", "services"),
    ("rerun", "rerun-sdk", "services"),
    ("matplotlib", "matplotlib", "services"),
    ("torch", "torch", "training"),
    # Stores of simulations and data sets: `fem` is the lighter of the two extras that bring it.
    ("h5py", "h5py", "fem"),
    ("warp", "warp-lang", "fem"),
    ("scipy", "scipy", "fem"),
    ("pymetis", "pymetis", "fem"),
    ("threadpoolctl", "threadpoolctl", "fem"),
)
# Not ros_bag: a bag of ROS 2 is a folder.
_DRIVERS_OF_A_FILE = ("text_log", "record", "pose_file")
_ROUTER_WAIT_S = 1.0
_SLEEP_S = 0.01
_LATE_WARN_S = 0.005


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: result and fix; ``warn`` means that a station runs, but lacks something."""

    what: str
    grade: Grade
    found: str
    fix: str = ""


def run_doctor(profile_name: str, *, as_json: bool) -> int:
    """Check everything and print the result; the exit code, 1 if a check failed."""
    console = Console(highlight=False)
    findings: list[Finding] = []
    for finding in _all(profile_name):
        findings.append(finding)
        if not as_json:
            colour = _COLOURS[finding.grade]
            console.print(f"[{colour}]{finding.grade:4}[/] {finding.what:12} ", end="")
            console.print(finding.found, markup=False, soft_wrap=True)
            if finding.fix:
                console.print(f"     fix: {finding.fix}", markup=False, soft_wrap=True)
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    return FAILED if any(finding.grade == "fail" for finding in findings) else 0


def _all(profile_name: str) -> Iterator[Finding]:
    yield _python()
    yield from _packages()
    try:
        profile = load_profile(profile_name)
    except PalpateError as error:
        yield Finding("profile", "fail", error.problem, error.remedy)
        return
    yield Finding("profile", "ok", f"{profile_name}: {', '.join(profile.processes)}")
    for what, check in _CHECKS.items():
        try:
            yield Finding(what, *check(profile))
        except PalpateError as error:
            yield Finding(what, "fail", error.problem, error.remedy)
        except OSError as error:  # e.g. a folder of somebody else, which may not be looked into
            where = "" if error.filename is None else f"{error.filename}: "
            yield Finding(what, "fail", f"{where}{error.strerror}", "correct it or its permissions")


def _python() -> Finding:
    found = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info < _PYTHON_MIN:
        return Finding("python", "fail", found, "install Python 3.11 or later")
    return Finding("python", "ok", found)


def _packages() -> Iterator[Finding]:
    for module, distribution, extra in _PACKAGES:
        try:
            if extra is None:
                importlib.import_module(module)
            elif importlib.util.find_spec(module) is None:  # torch takes seconds to import
                raise ModuleNotFoundError(module)
            found = f"{distribution} {version(distribution)}"
        except (ImportError, PackageNotFoundError) as error:
            fix = "reinstall palpate" if extra is None else f'pip install "palpate[{extra}]"'
            grade: Grade = "fail" if extra is None else "warn"
            why = "" if isinstance(error, ModuleNotFoundError) else f": {error}"
            yield Finding("package", grade, f"{distribution} is not installed{why}", fix)
            continue
        yield Finding("package", "ok", found)


def _extras(profile: Profile) -> Found:
    check_packages(profile)
    return "ok", "every process of the profile finds its packages", ""


def _sensors(profile: Profile) -> Found:
    if "gateway" not in profile.processes:
        return "ok", "no gateway in this profile", ""
    from palpate_gateway.drivers import make_device

    names = []
    for sensor in profile.gateway.sensors:
        make_device(sensor.driver, sensor.options, where=f"options of sensor {sensor.name!r}")
        if (path := sensor.options.get("path")) is not None:
            if not Path(str(path)).exists():
                return "fail", f"sensor {sensor.name!r}: {path} does not exist", "set its path"
            if sensor.driver in _DRIVERS_OF_A_FILE and Path(str(path)).is_dir():
                fix = "set its path to a file in it"
                return "fail", f"sensor {sensor.name!r}: {path} is a folder", fix
        names.append(f"{sensor.name} ({sensor.driver})")
    found = ", ".join(names)
    if strange := _unserved(profile):
        return (
            "warn",
            f"{found}; of no gateway of this host: {', '.join(strange)}",
            "correct the names in `sensors` and `bundles` of the services, or listen for the "
            "gateways of other hosts: [router] listen",
        )
    return "ok", found, ""


def _unserved(profile: Profile) -> list[str]:
    """Sensors that the services of a station of this host alone name, and its gateway has not."""
    here = all(is_loopback(endpoint_host_port(one)[0]) for one in profile.router.listen)
    if "router" not in profile.processes or not here:
        return []
    has = {sensor.name for sensor in profile.gateway.sensors}
    return [
        f"{sensor} ([{service}])"
        for service, table in (("features", profile.features), ("field", profile.field))
        if service in profile.processes
        for sensor in dict.fromkeys([*table.sensors, *table.bundles])
        if sensor not in has
    ]


def _router(profile: Profile) -> Found:
    where = ", ".join(profile.link.connect)
    try:
        with join(profile, wait_s=_ROUTER_WAIT_S) as session:
            alive = sorted({one.service for one in session.alive()})
        return "ok", f"answers at {where}; running: {', '.join(alive) or 'nothing'}", ""
    except LinkError as error:
        if "router" not in profile.processes:
            return "fail", error.problem, f"start the router at {where}"
    try:
        check_free(profile.router.listen)
    except LinkError as error:
        return "fail", f"{error.problem} by another program", error.remedy
    return "ok", f"not running; port free at {', '.join(profile.router.listen)}", ""


def _certificates(profile: Profile) -> Found:
    ours = check_certificates(profile, private=True)
    if not ours:
        return "ok", "none: this station is reached from this host only", ""
    from palpate_deploy.station.certificates import WARN_DAYS

    first = min(ours, key=lambda one: one.until)
    roles = dict.fromkeys(role_of(service) for service in profile.processes)
    found = f"{', '.join(roles)}: the first of them ends on {first.until:%Y-%m-%d}"
    if first.authority_ends:
        fix = "their authority ends: make a new one in another folder, and issue all of them again"
        return "warn", found, f"{fix}: palpate certs ca"
    if first.days_left < WARN_DAYS:
        return "warn", found, "issue new ones: palpate certs issue, and start the station again"
    return "ok", found, ""


def _bundle(profile: Profile) -> Found:
    tables = {
        "features": profile.features,
        "field": profile.field,
        "synthesis": profile.synthesis,
    }
    served = [
        (task, sensor, bundle)
        for task, table in tables.items()
        if task in profile.processes
        for sensor, bundle in _served(profile, task, {"": table.bundle, **table.bundles}).items()
    ]
    if not served:
        return "ok", "no service of this profile needs one", ""
    from palpate_services.inference.model import load
    from palpate_services.inference.repository import Repository
    from palpate_services.inference.trial import proven

    repository = Repository.of_config(profile.models)
    serials = {one.name: one.options.get("serial") for one in profile.gateway.sensors}
    loaded = {
        (task, bundle): load(proven(repository.read(repository.resolve(bundle)), task), task)
        for task, bundle in dict.fromkeys((task, bundle) for task, _, bundle in served)
    }
    names = [runtime.label for runtime in loaded.values()]
    strange = [
        f"{sensor} has {loaded[task, bundle].label}{others}"
        for task, sensor, bundle in served
        if (serial := serials.get(sensor))
        and (others := loaded[task, bundle].made_for_others(str(serial)))
    ]
    what = "reproduces its golden vectors" if len(names) == 1 else "reproduce their golden vectors"
    found = f"{', '.join(names)} {what}"
    if strange:
        fix = "palpate calibrate this finger, or palpate model load the bundle that was made for it"
        return "warn", f"{found}; {', '.join(strange)}", fix
    return "ok", found, ""


def _served(profile: Profile, task: str, named: dict[str, str]) -> dict[str, str]:
    """Bundles that a service would serve, by sensor: those that commands chose count."""
    from palpate_services.inference.remembered import RememberedFile

    file = profile.models.served_file(profile.station, task, profile.instance(task))
    try:
        chosen = RememberedFile(file).recall(named) or {}
    except ConfigError as error:
        if not isinstance(error.__cause__, PermissionError):
            raise
        chosen = {}  # an installed station's own, which its user alone may read
    served = named | {sensor: one.bundle for sensor, one in chosen.items() if one.changed}
    return {sensor: bundle for sensor, bundle in served.items() if bundle}


def _disk(profile: Profile) -> Found:
    if "recorder" not in profile.processes:
        return "ok", "no recorder in this profile", ""
    folder = profile.recorder.out.absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        return "fail", f"{existing} is no folder", "set [recorder] out to another folder"
    if not os.access(existing, os.W_OK):
        return "fail", f"{existing} is not writable", "set [recorder] out to another folder"
    free = shutil.disk_usage(existing).free
    found = f"{free / 1e9:.1f} GB free at {existing}"
    if free < profile.recorder.min_free_bytes:
        return "fail", found, "free space: the recorder pauses below its limit"
    if free < 10 * profile.recorder.min_free_bytes:
        return "warn", found, "free space soon"
    keeps = profile.recorder.keep_bytes
    there = 0
    for path in folder.glob(f"{profile.station}-*"):
        with contextlib.suppress(FileNotFoundError):  # the recorder has removed it meanwhile
            there += path.stat().st_size
    if keeps > free + there - profile.recorder.min_free_bytes:
        return (
            "warn",
            f"{found}; the recorder keeps up to {keeps / 1e9:.1f} GB, so it will pause for want of "
            "room before it removes old records",
            "free space, or set [recorder] keep_bytes to what the disk can hold",
        )
    return "ok", found, ""


def _state(_: Profile) -> Found:
    folder = state_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return "fail", f"{folder}: {error.strerror}", "set XDG_STATE_HOME to a writable folder"
    return "ok", f"run folders and logs in {folder}", ""


def _clock(_: Profile) -> Found:
    wall_s = time.time()
    if wall_s < EARLIEST_WALL_S:
        year = time.gmtime(wall_s).tm_year
        return "fail", f"the wall clock says {year}", "set it and synchronise it: chrony"
    lateness = []
    for _attempt in range(50):
        began = time.monotonic()
        time.sleep(_SLEEP_S)
        lateness.append(time.monotonic() - began - _SLEEP_S)
    worst = max(lateness)
    found = f"a 10 ms sleep is late by {worst * 1e3:.1f} ms at worst of 50"
    if worst > _LATE_WARN_S:
        return "warn", found, "the host is busy: frames will be late or dropped"
    return "ok", found, ""


def _wall(profile: Profile) -> Found:
    from palpate_deploy.station.status import wall_words
    from palpate_gateway.clock.wall_clock import wall_discipline

    kept = wall_discipline()
    found = wall_words(kept)
    ends = (*profile.router.listen, *profile.link.connect)
    alone = all(is_loopback(endpoint_host_port(end)[0]) for end in ends)
    if kept is None or kept.synchronised or alone:
        return "ok", found, ""
    fix = "this profile spans several hosts: run chrony or ptp4l on each (docs/time.md)"
    return "warn", found, fix


def _cpu(_: Profile) -> Found:
    cpus = os.cpu_count() or 1
    load = os.getloadavg()[0]
    found = f"{cpus} CPUs, load {load:.1f}"
    if cpus < 2:
        return "warn", found, "a station needs two: estimates will sometimes be late"
    return ("warn", found, "stop what else runs here") if load > cpus else ("ok", found, "")


_CHECKS: dict[str, Callable[[Profile], Found]] = {
    "extras": _extras,
    "sensors": _sensors,
    "router": _router,
    "certificates": _certificates,
    "bundle": _bundle,
    "disk": _disk,
    "state": _state,
    "clock": _clock,
    "wall clock": _wall,
    "cpu": _cpu,
}
