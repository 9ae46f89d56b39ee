"""The station of the chaos run: installed under a systemd that runs, with a network and a disk.

It is in namespaces of its own. A cable (veth) leads from them to the robot's host, which is the
namespace that this program runs in; the robot comes by mutual TLS, as from any other computer. The
station has a disk of its own, an ext4 on a loop device, which whoever starts this makes.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from tests.chaos.debian import CLOCK_IN_IMAGE
from tests.install.booted import PALPATE, Booted, until

from palpate.config import Role
from palpate_deploy.station.certificates import issue, make_authority

NAME = "chaos"
UNIT, SOLVER = f"palpate@{NAME}", f"palpate-fem@{NAME}"
KERNELS = f"/var/cache/private/palpate/{NAME}"
FOLDER = f"/var/lib/private/palpate/{NAME}"
PROFILE = f"/etc/palpate/{NAME}.toml"
CERTIFICATES = "/etc/palpate/certs"
LINE = "/dev/palpate-finger"
SENSOR = "finger"
PORT, METRICS_PORT = 22447, 22464
STATION_HOST, ROBOT_HOST, NETWORK = "10.77.22.1", "10.77.22.2", "10.77.22.0/24"
ROUTER = f"tls/{STATION_HOST}:{PORT}"
CABLE = "palpate-robot"
SUPERVISED = ("router", "gateway", "features", "field", "recorder", "metrics")

_CLOCK = "/run/palpate-clock"

PROFILE_TEXT = f"""\
station = "lab"
processes = ["router", "gateway", "features", "field", "recorder", "metrics", "fem"]
[router]
listen = ["tls/127.0.0.1:{PORT}", "tls/{STATION_HOST}:{PORT}"]
[link]
certificates = "{CERTIFICATES}"
[[gateway.sensors]]
name = "{SENSOR}"
driver = "biotac_bridge"
options = {{ line = "{LINE}", source = 1, port = 1 }}
[features]
bundle = "features-twin"
[recorder]
out = "runs"
rrd = false
min_free_bytes = 16777216
rotate_s = 120.0
[fem]
workers = 1
options = {{ edge_m = 0.0015, layers = 1 }}
[metrics]
listen = "127.0.0.1:{METRICS_PORT}"
"""

_DROP_IN = f"""\
[Service]
Environment=LD_PRELOAD={CLOCK_IN_IMAGE} CHAOS_CLOCK={_CLOCK}
"""

EMULATOR = [
    PALPATE,
    "emulate",
    "biotac-bridge",
    "--link",
    LINE,
    "--fingers",
    "1",
    "--play",
    "press",
]


@dataclass(frozen=True, slots=True)
class Process:
    """A process of the system, by its ids outside and inside; ``state`` as in /proc (Z: zombie)."""

    pid: int
    inner: int
    parent: int
    state: str
    command: str


class ChaosStation:
    """Boot, install and start it; use it in a ``with`` block.

    Args:
        root: The image; what is installed stays in it.
        work: Folder for certificates and logs.
        disk: A loop device with a file system.
        group: Name of the system's control group.
    """

    def __init__(self, root: Path, work: Path, disk: str, group: str) -> None:
        self.root, self.work, self._disk, self._group = root, work, disk, group
        self.certificates = work / "certs"
        self.broken: list[int] = []
        """Processes that were killed or stopped, and are to be replaced."""
        self._stack = contextlib.ExitStack()
        self._emulator: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self.system = stack.enter_context(Booted(self.root, self._group))
            self.first = self.system.first
            self._connect()
            self._install()
            self.plug()
            stack.callback(self.unplug)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        # Compiled once: on a busy host that takes minutes.
        if (made := self.root / KERNELS[1:]).exists():
            shutil.copytree(made, self.work / "kernels", dirs_exist_ok=True)

    def _connect(self) -> None:
        """A cable to the robot's host."""
        host("ip", "link", "set", "lo", "up")
        host("ip", "link", "add", CABLE, "type", "veth", "peer", "name", "lan", "netns",
             str(self.first))  # fmt: skip
        host("ip", "addr", "add", f"{ROBOT_HOST}/24", "dev", CABLE)
        host("ip", "link", "set", CABLE, "up")
        inside = ("nsenter", f"--target={self.first}", "--net", "ip")
        host(*inside, "addr", "add", f"{STATION_HOST}/24", "dev", "lan")
        host(*inside, "link", "set", "lan", "up")

    def _install(self) -> None:
        shutil.rmtree(self.certificates, ignore_errors=True)
        make_authority(self.certificates, "chaos")
        for role in Role:
            issue(self.certificates, role, "", [STATION_HOST] if role is Role.ROUTER else [])
        # Into the image itself: below /etc of the system that runs.
        target = self.root / CERTIFICATES[1:]
        shutil.rmtree(target, ignore_errors=True)
        for role in (Role.ROUTER, Role.GATEWAY, Role.SERVICE):
            shutil.copytree(self.certificates / role, target / role)
        if (made := self.work / "kernels").exists():
            shutil.copytree(made, self.root / KERNELS[1:], dirs_exist_ok=True)
        (self.root / f"etc/systemd/system/{UNIT}.service.d").mkdir(parents=True, exist_ok=True)
        drop_in = self.root / f"etc/systemd/system/{UNIT}.service.d/clock.conf"
        drop_in.write_text(_DROP_IN, encoding="utf-8")
        (self.root / f"etc/{NAME}.toml").write_text(PROFILE_TEXT, encoding="utf-8")
        self.set_clock(0.0)
        self.run(PALPATE, "install", f"/etc/{NAME}.toml", "--allow", NETWORK)

    def start(self) -> None:
        """Mount the station's own disk, and start the unit."""
        number = self._disk.removeprefix("/dev/loop")
        self.run("sh", "-ec", f"mkdir -p -m 700 /var/lib/private; mkdir -p {FOLDER}; "
                 f"mknod /dev/disk b 7 {number}; mount -t ext4 /dev/disk {FOLDER}; "
                 f"rmdir {FOLDER}/lost+found")  # fmt: skip
        self.run("systemctl", "start", UNIT)

    def run(self, *command: str) -> str:
        """Output of a command in the system, which must succeed."""
        return self.system.run(*command, status=0)

    @property
    def runs(self) -> Path:
        """The folder of the recordings, seen from outside."""
        return Path(f"/proc/{self.first}/root{FOLDER}/runs")

    @property
    def disk(self) -> Path:
        """Where the station's disk is mounted, seen from outside."""
        return Path(f"/proc/{self.first}/root{FOLDER}")

    def set_clock(self, offset_s: float) -> None:
        """Move the wall clock of the station's processes against the host's [s]."""
        file = Path(f"/proc/{self.first}/root{_CLOCK}")
        if not file.exists():
            file.write_bytes(bytes(8))
            file.chmod(0o644)
        with open(file, "r+b") as handle:  # in place: it is mapped
            handle.write(struct.pack("<q", round(offset_s * 1e9)))

    def plug(self) -> None:
        """Start the emulated finger, at its line, for who may use serial lines."""
        self._emulator = self._inside(*EMULATOR)
        line = Path(f"/proc/{self.first}/root{LINE}")
        until(line.is_symlink, "the line is there")
        # As udev would: the system has none.
        self.run("sh", "-ec", f"chgrp dialout $(readlink {LINE}); chmod 660 $(readlink {LINE})")

    def unplug(self) -> None:
        """End the emulated finger, and take its line away."""
        if self._emulator is not None:
            for process in self.find("emulate biotac-bridge"):
                send(process.pid, 9)
            # nsenter ends with its child; killed before, it leaves a zombie that nobody waits for.
            # While a child was stopped it has stopped, too.
            self._emulator.send_signal(signal.SIGCONT)
            self._emulator.wait(10.0)
            self._emulator = None
            self.run("rm", "-f", LINE)

    def _inside(self, *command: str) -> subprocess.Popen[bytes]:
        words = ["nsenter", f"--target={self.first}", "--mount", "--net", "--pid", "--ipc"]
        log = open(self.work / "emulator.log", "ab")
        return subprocess.Popen(
            [*words, *command], stdin=subprocess.DEVNULL, stdout=log, stderr=log, close_fds=True
        )

    def processes(self) -> list[Process]:
        """All processes of the system."""
        found, parents = {}, {}
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError, ValueError):
                rows = dict(
                    line.split(":", 1) for line in (entry / "status").read_text().splitlines()
                )
                pid, parent = int(entry.name), int(rows["PPid"])
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
                command = command or rows["Name"].strip()  # of a zombie no more is known
                inner = int(rows["NSpid"].split()[-1])
                state = rows["State"].split()[0]
                found[pid] = Process(pid, inner, parent, state, command.replace("\0", " "))
                parents[pid] = parent

        def belongs(pid: int) -> bool:
            while pid > 1:
                if pid == self.first:
                    return True
                pid = parents.get(pid, 0)
            return False

        # What was started from outside (nsenter) has its parent outside, and the namespace inside.
        space = os.readlink(f"/proc/{self.first}/ns/pid")
        kept = []
        for pid, process in found.items():
            with contextlib.suppress(OSError):
                if belongs(pid) or os.readlink(f"/proc/{pid}/ns/pid") == space:
                    kept.append(process)
        return kept

    def find(self, words: str) -> list[Process]:
        """Processes whose command has these words."""
        return [one for one in self.processes() if words in one.command and one.state != "Z"]

    def process_of(self, name: str) -> Process:
        """A process of the station by name: of a service, ``supervisord``, ``up`` or ``worker``.

        Raises:
            LookupError: It does not run.
        """
        words = {
            "supervisord": "station.supervisord",
            "up": f"palpate up --profile {PROFILE}",
        }.get(name, f" run {name} ")
        found = self.find(words)
        if not found:
            raise LookupError(name)
        if name == "worker":
            raise LookupError(name)
        return min(found, key=lambda one: one.inner)

    def worker(self) -> Process:
        """The process that solves, a child of the finite elements."""
        served = self.process_of("fem")
        children = [one for one in self.processes() if one.parent == served.pid]
        if not children:
            raise LookupError("worker")
        return max(children, key=lambda one: one.inner)

    def save(self) -> list[str]:
        """Stop the unit; copy journal, logs and recordings into ``work``; what it left behind.

        ``work/logs`` has ``journal.jsonl`` and the logs of all processes of all runs.
        """
        self.run("systemctl", "stop", UNIT)
        logs = self.work / "logs"
        logs.mkdir()
        journal = self.run("journalctl", "--output=json", "--no-pager")
        (logs / "journal.jsonl").write_text(journal, encoding="utf-8")
        for file in sorted(self.disk.glob("state/palpate/runs/*/logs/*")):
            shutil.copy(file, logs / f"{file.parent.parent.name}-{file.name}")
        shutil.copytree(self.runs, self.work / "recordings")
        for token in self.disk.glob("state/palpate/**/*token*"):
            shutil.copy(token, self.work / "token")
        left = [one.command for one in self.find("/opt/palpate") if "emulate" not in one.command]
        return [*self.leavings(), *left]

    def leavings(self) -> list[str]:
        """Files in memory and in temporary folders."""
        found = self.run("find", "/dev/shm", "/tmp", "/var/tmp", "-mindepth", "1")
        # The unit's own, empty /tmp goes with it; its name changes.
        return [line for line in found.splitlines() if "systemd-private" not in line]


def send(pid: int, number: int) -> None:
    """Send a signal; a process that has ended is none to be sorry for."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def host(*command: str) -> None:
    """Run a command in the namespaces of this program.

    Raises:
        OSError: It fails.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")
