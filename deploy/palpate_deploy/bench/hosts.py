"""Network namespaces that stand for hosts: a site, and hosts that each have a cable to it.

The site has one address on every cable, so that each host reaches it and, unless the site forwards,
no other. What crosses a cable is counted by the kernel. Only root can make them; all of them go
when the lab is closed, after an error and after Ctrl-C, too. One that was killed leaves its own
behind, and the next lab removes those whose process is gone.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from palpate.errors import ConfigError
from palpate.process import Closing

PREFIX = "palpate-lab"
"""Namespaces are called ``palpate-lab-<process id>-<host>``."""

_NET = "10.213"
_COMMAND_S = 30.0


def why_no_hosts() -> str:
    """Why namespaces cannot be made here; empty = they can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no command ip (Debian: iproute2)"
    probe = f"{PREFIX}-{os.getpid()}-probe"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, check=False)
    if made.returncode:
        return f"this kernel or container allows none: {made.stderr.decode().strip()}"
    subprocess.run(["ip", "netns", "del", probe], check=False)
    return ""


@dataclass(frozen=True, slots=True)
class LabHost:
    """One host: its namespace, its address, and the site's address on the cable to it."""

    name: str
    namespace: str
    address: str
    site: str
    cable: str

    def inside(self, command: Sequence[str]) -> list[str]:
        """The command that runs ``command`` on this host."""
        return ["ip", "netns", "exec", self.namespace, *command]


class HostLab(Closing):
    """A site and its hosts; closing it removes everything.

    Raises:
        ConfigError: Namespaces cannot be made here; says why.
    """

    def __init__(self) -> None:
        if reason := why_no_hosts():
            raise ConfigError(f"no hosts can be made: {reason}", remedy="run it as root, on Linux")
        remove_leftovers()
        self._hosts: dict[str, LabHost] = {}
        self.site = self._namespace("site")

    def _namespace(self, name: str) -> str:
        namespace = f"{PREFIX}-{os.getpid()}-{name}"
        _ip("netns", "add", namespace)
        _ip("-n", namespace, "link", "set", "lo", "up")
        return namespace

    def add(self, name: str) -> LabHost:
        """A new host with a cable to the site."""
        number = len(self._hosts) + 1
        namespace = self._namespace(name)
        cable = f"c{number}"
        _ip(
            *("-n", self.site, "link", "add", cable, "type", "veth"),
            *("peer", "name", "eth0", "netns", namespace),
        )
        host = LabHost(name, namespace, f"{_NET}.{number}.2", f"{_NET}.{number}.1", cable)
        _ip("-n", self.site, "address", "add", f"{host.site}/24", "dev", cable)
        _ip("-n", namespace, "address", "add", f"{host.address}/24", "dev", "eth0")
        _ip("-n", self.site, "link", "set", cable, "up")
        _ip("-n", namespace, "link", "set", "eth0", "up")
        _ip("-n", namespace, "route", "add", "default", "via", host.site)
        self._hosts[name] = host
        return host

    def at_site(self, command: Sequence[str]) -> list[str]:
        """The command that runs ``command`` at the site."""
        return ["ip", "netns", "exec", self.site, *command]

    def plug(self, host: LabHost, *, plugged: bool) -> None:
        """Plug the cable of a host in, or pull it: packets are lost, and no connection is reset."""
        _ip("-n", self.site, "link", "set", host.cable, "up" if plugged else "down")
        if plugged:  # the kernel dropped it with the link
            _ip("-n", host.namespace, "route", "replace", "default", "via", host.site)

    def impair(self, host: LabHost, words: Sequence[str]) -> str:
        """Delay or lose packets both ways (``tc netem``), e.g. ``("delay", "10ms")``; () = none.

        Returns:
            Why the kernel does not do it; empty = it does.
        """
        for namespace, device in ((self.site, host.cable), (host.namespace, "eth0")):
            verb = ["replace"] if words else ["del"]
            command = ["tc", "-n", namespace, "qdisc", *verb, "dev", device, "root"]
            if words:
                command += ["netem", *words]
            done = subprocess.run(command, capture_output=True, check=False, timeout=_COMMAND_S)
            if done.returncode and words:
                return done.stderr.decode().strip() or "tc failed"
        return ""

    def crossed_bytes(self, host: LabHost) -> tuple[int, int]:
        """Bytes that have crossed the cable: from the host to the site, and back."""
        statistics = f"/sys/class/net/{host.cable}/statistics"
        text = subprocess.run(
            self.at_site(["cat", f"{statistics}/rx_bytes", f"{statistics}/tx_bytes"]),
            capture_output=True,
            text=True,
            check=True,
            timeout=_COMMAND_S,
        ).stdout.split()
        return int(text[0]), int(text[1])

    def close(self) -> None:
        """Remove every namespace of this process, and the cables with them."""
        for namespace in namespaces():
            if namespace.startswith(f"{PREFIX}-{os.getpid()}-"):
                _delete(namespace)

    def __enter__(self) -> Self:
        return self


def namespaces() -> list[str]:
    """Every namespace of a lab, of any process."""
    folder = Path("/run/netns")
    with contextlib.suppress(FileNotFoundError):
        return sorted(one.name for one in folder.iterdir() if one.name.startswith(f"{PREFIX}-"))
    return []


def remove_leftovers() -> list[str]:
    """Remove namespaces whose process is gone, and what runs in them; returns their names."""
    gone = []
    for namespace in namespaces():
        pid = namespace.removeprefix(f"{PREFIX}-").partition("-")[0]
        if pid.isdigit() and not Path(f"/proc/{pid}").exists():
            _delete(namespace)
            gone.append(namespace)
    return gone


def _delete(namespace: str) -> None:
    """Kill what runs in a namespace that is ours, and remove it."""
    pids = subprocess.run(
        ["ip", "netns", "pids", namespace], capture_output=True, text=True, check=False
    ).stdout.split()
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(pid), 9)
    subprocess.run(["ip", "netns", "del", namespace], capture_output=True, check=False)


def _ip(*arguments: str) -> None:
    done = subprocess.run(
        ["ip", *arguments], capture_output=True, text=True, check=False, timeout=_COMMAND_S
    )
    if done.returncode:
        raise ConfigError(
            f"ip {' '.join(arguments)}: {done.stderr.strip()}", remedy="run it as root, on Linux"
        )
