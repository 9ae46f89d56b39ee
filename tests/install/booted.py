"""The same under a systemd that runs: it starts the units with all that they forbid.

Debian's own systemd becomes process 1 of namespaces of its own: mounts, processes, network, control
groups. It may not set the clock, load modules or write kernel settings. Needs control groups of
version 2 (a mount of them beside version 1 is enough) and root.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.install import image
from tests.install.cases import VIRTUAL

ROOT = Path(__file__).resolve().parents[2]
NAME = "proof"
PALPATE = "/opt/palpate/bin/palpate"
PATIENCE_S = 300.0
PROFILE = VIRTUAL.replace('"recorder"]', '"fem", "recorder"]')
TAKEN = "-sys_time,-sys_boot,-sys_module,-sys_rawio,-syslog"
_OF_SYSTEMD = re.compile(
    r". /(?:etc/(?:machine-id|\.pwd\.lock|\.updated)"
    r"|var/(?:lib/(?:private|systemd)|cache/(?:private|ldconfig)|log|\.updated))(?:/.*)?"
)
"""What a system writes while it runs, whatever runs on it."""


class NotHere(RuntimeError):
    """This host has no place for it."""


def groups() -> Path:
    """Where control groups of version 2 are mounted."""
    for place in (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified")):
        if (place / "cgroup.procs").exists() and (place / "cgroup.controllers").exists():
            if os.access(place / "cgroup.procs", os.W_OK):
                return place
    raise NotHere("no control groups of version 2 that can be written")


def become_systemd(root: Path) -> None:
    """Inside the namespaces: mount what systemd needs, and be it."""
    image.enter(root)
    image.mount("--bind", str(root / "proc" / "sys"), str(root / "proc" / "sys"))
    image.mount("-o", "remount,bind,ro", str(root / "proc" / "sys"))
    image.mount("-t", "sysfs", "-o", "ro", "sysfs", str(root / "sys"))
    image.mount("-t", "cgroup2", "cgroup2", str(root / "sys" / "fs" / "cgroup"))
    (root / "dev" / "pts").mkdir()
    image.mount("-t", "devpts", "-o", "newinstance,ptmxmode=0666", "devpts", str(root / "dev/pts"))
    (root / "dev" / "ptmx").symlink_to("pts/ptmx")
    shutil.copytree(ROOT / "docs" / "examples", root / "tmp" / "examples")
    (root / "tmp" / f"{NAME}.toml").write_text(PROFILE, encoding="utf-8")
    (root / "run" / "host").mkdir()
    os.chdir(root)
    subprocess.run(["pivot_root", ".", "run/host"], check=True)
    subprocess.run(["umount", "-l", "/run/host"], check=True)
    # As every container manager does: what is mounted for a service, its credentials, must reach
    # the namespace of that service.
    image.mount("--make-rshared", "/")
    words = ["setpriv", f"--bounding-set={TAKEN}", "env", "-i", "container=other"]
    os.execvp("setpriv", [*words, f"PATH={image.PLAIN['PATH']}", "/lib/systemd/systemd"])


class Booted:
    """A system whose systemd runs, in a control group; use it in a ``with`` block."""

    def __init__(self, root: Path, group: str = "") -> None:
        self._group = groups() / (group or f"palpate-proof-{os.getpid()}")
        self._group.mkdir()
        inner = [sys.executable, "-m", "tests.install.booted", str(root)]
        namespaces = ["--mount", "--net", "--pid", "--ipc", "--uts", "--cgroup", "--fork"]
        join = f'echo $$ > {self._group}/cgroup.procs; exec "$@"'
        self._process = subprocess.Popen(
            ["sh", "-c", join, "sh", "unshare", *namespaces, "--kill-child", *inner],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
        )
        self._first = 0

    def __enter__(self) -> Booted:
        def first() -> bool:
            pid = self._process.pid
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            self._first = int(children[0]) if children else 0
            comm = Path(f"/proc/{self._first}/comm")
            return bool(self._first) and comm.exists() and comm.read_text().strip() == "systemd"

        try:
            until(first, "systemd is there")
            until(
                lambda: self.run("systemctl", "is-system-running").strip() == "running", "it runs"
            )
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        remove_group(self._group)

    @property
    def first(self) -> int:
        """Process id of its systemd, as the host counts."""
        return self._first

    def run(self, *command: str, status: int | None = None) -> str:
        """Output of a command in the system; with ``status`` it must end so."""
        where = [
            "nsenter",
            f"--target={self._first}",
            "--mount",
            "--net",
            "--pid",
            "--ipc",
            "--uts",
        ]
        variables = [f"{key}={value}" for key, value in image.PLAIN.items()]
        done = subprocess.run(
            [*where, "--cgroup", "env", "-i", "--chdir=/", *variables, *command],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
        if status is not None and done.returncode != status:
            raise SystemExit(f"{command} ended with {done.returncode}: {done.stdout}{done.stderr}")
        return done.stdout

    def property(self, unit: str, key: str) -> str:
        """What systemd says of a unit."""
        return self.run("systemctl", "show", "--value", "-p", key, unit).strip()

    def commands(self) -> dict[str, str]:
        """Command lines of its processes by process id, as the system counts."""
        found = {}
        for folder in Path(f"/proc/{self._first}/root/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                found[folder.name] = (folder / "cmdline").read_bytes().decode().replace("\0", " ")
        return found

    def pid_of(self, service: str) -> str:
        """Process id of a supervised process; empty = none."""
        asked = f"palpate_deploy run {service} "
        return next((pid for pid, line in self.commands().items() if asked in line), "")


def remove_group(group: Path) -> None:
    """Remove a control group with all below it, as soon as its processes have ended."""
    for _attempt in range(100):
        for folder, _folders, _files in os.walk(group, topdown=False):
            with contextlib.suppress(OSError):
                os.rmdir(folder)
        if not group.exists():
            return
        time.sleep(0.1)


def until(done: Callable[[], bool], what: str) -> float:
    """Wait; how long it took [s]."""
    began_s = time.monotonic()
    while not done():
        if time.monotonic() - began_s > PATIENCE_S:
            raise SystemExit(f"it did not happen: {what}")
        time.sleep(0.1)
    return time.monotonic() - began_s


def under_systemd(root: Path, step: Callable[[str], Any]) -> dict[str, Any]:
    """Install, use, hang, upgrade, roll back, uninstall; what was found.

    Raises:
        NotHere: This host cannot run it.
    """
    found: dict[str, Any] = {}
    unit, solver = f"palpate@{NAME}", f"palpate-fem@{NAME}"
    profile = f"/etc/palpate/{NAME}.toml"
    with contextlib.ExitStack() as stack:
        with step("systemd as process 1 of its own namespaces"):
            system = stack.enter_context(Booted(root))
        found["systemd"] = system.run("systemctl", "--version").split()[1]
        bare = image.contents(root)
        with step("palpate install, systemctl start"):
            system.run(PALPATE, "install", f"/tmp/{NAME}.toml", status=0)
            assert system.run("systemctl", "is-enabled", unit).strip() == "enabled"
            system.run("systemctl", "start", unit, status=0)
        with step("palpate status, until everything is ready"):
            ready(system, profile)
        with step("a robot: 300 estimates, and an indentation"):
            python = "/opt/palpate/bin/python"
            said = system.run(python, "/tmp/examples/features_stream.py", status=0)
            found["estimates"] = said.count(" N ")
            said = system.run(python, "/tmp/examples/simulate.py", status=0)
            found["simulation"] = said.splitlines()[-1].strip()
        log = system.run("sh", "-c", f"cat /var/lib/palpate/{NAME}/state/palpate/runs/*/logs/*.log")
        found["one_core"] = "one_core: on core" in log
        found["hung"] = dict(hangs(system, unit, solver, step))
        with step("a wrong profile: it fails, and is not started again"):
            system.run("sh", "-c", f"cp {profile} /tmp/good; echo wrong = 1 >> {profile}", status=0)
            system.run("systemctl", "restart", unit)
            found["wrong_profile"] = system.property(unit, "Result")
            found["wrong_profile_starts"] = int(system.property(unit, "NRestarts"))
            system.run("cp", "/tmp/good", profile, status=0)
            system.run("systemctl", "reset-failed", unit, solver)
        with step("upgrade, rollback, each with a restart"):
            system.run("ln", "-s", "/opt/palpate", "/opt/palpate-2", status=0)
            system.run("/opt/palpate-2/bin/palpate", "install", profile, "--program",
                       "/opt/palpate-2/bin/palpate", status=0)  # fmt: skip
            system.run("systemctl", "restart", unit, status=0)
            found["upgraded"] = "/opt/palpate-2/" in system.property(unit, "ExecStart")
            system.run(PALPATE, "install", profile, "--rollback", status=0)
            system.run("systemctl", "restart", unit, status=0)
            found["rolled_back"] = "/opt/palpate/" in system.property(unit, "ExecStart")
            system.run("rm", "/opt/palpate-2", status=0)
            records = system.run("sh", "-c", f"ls /var/lib/palpate/{NAME}/runs").splitlines()
            found["records"] = sum(one.endswith(".mcap") for one in records)
        with step("palpate uninstall --purge"):
            system.run(PALPATE, "uninstall", NAME, "--purge", status=0)
        assert not [line for line in system.commands().values() if "/opt/palpate" in line]
        found["units_left"] = system.run(
            "systemctl", "list-units", "--all", "--no-legend", "*palpate*.service"
        ).split()
        left = image.difference(bare, image.contents(root))
        found["left"] = [line for line in left if not _OF_SYSTEMD.fullmatch(line)]
    return found


def ready(system: Booted, profile: str) -> float:
    """Wait until the station says that nothing is missing [s]."""
    ask = ("sh", "-c", f"{PALPATE} status --profile {profile} >/tmp/said && echo ready")
    return until(lambda: "ready" in system.run(*ask), "the station is ready")


def hangs(
    system: Booted, unit: str, solver: str, step: Callable[[str], Any]
) -> Iterator[tuple[str, float]]:
    """Stop one after the other (SIGSTOP); how long until it works again [s]."""
    with step("SIGSTOP features: the supervisor replaces it"):
        old = system.pid_of("features")
        system.run("sh", "-c", f"kill -STOP {old}", status=0)
        yield "features", round(until(lambda: system.pid_of("features") not in ("", old), "new"), 1)
        assert system.property(unit, "NRestarts") == "0"
    for name in (unit, solver):
        with step(f"SIGSTOP the main process of {name}: systemd starts it again"):
            old = system.property(name, "MainPID")
            system.run("systemctl", "kill", "--kill-whom=main", "--signal=STOP", name, status=0)

            def again(name: str = name, old: str = old) -> bool:
                new = system.property(name, "MainPID")
                return new not in ("0", old) and system.property(name, "SubState") == "running"

            yield name, round(until(again, f"{name} runs again"), 1)
    ready(system, f"/etc/palpate/{NAME}.toml")


if __name__ == "__main__":
    become_systemd(Path(sys.argv[1]))
