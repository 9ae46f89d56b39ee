"""A station with certificates that is attacked, its logs, and what others see of it."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zenoh
from tests.lab_router import make_certificates

from palpate.admin import read_token, token_file
from palpate.bus import Session
from palpate.config import LinkConfig, TlsConfig
from palpate.files.signature import make_signing_key
from palpate.messages import Status
from palpate.process import Closing
from palpate_deploy.station.host import free_endpoint

LIVE_S = 60.0
STATION = "attacked"
_LOGS = ("router", "gateway", "features")

_PROFILE = """
station = "{station}"
processes = ["router", "gateway", "features"]
[router]
listen = ["{endpoint}", "{outside}"]
[link]
certificates = "{certificates}"
[[gateway.sensors]]
name = "finger"
options = {{ model = "formula", seed = 3, untouched_s = 0.5 }}
[[gateway.sensors]]
name = "arm"
driver = "pose_zenoh"
[gateway.sensors.options]
robot = "arm"
indenter = "sphere_7mm"
base_sensor = {placement}
flange_indenter = {placement}
[models]
folder = "{folder}/models"
state = "{folder}/state"
trusted_keys = ["{folder}/lab.key.pub"]
"""


class Lab(Closing):
    """A running station in ``folder``, with a certificate for each role.

    Its router has two listeners: ``endpoint`` is for processes of the station's host, and
    ``outside`` for all others, at ``port``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.certificates = make_certificates(folder / "certs")
        self.key = folder / "lab.key"
        make_signing_key(self.key)
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self.outside = free_endpoint().replace("tcp/", "tls/")
        self.port = int(self.outside.rpartition(":")[2])
        self.profile = folder / "station.toml"
        self.profile.write_text(
            _PROFILE.format(
                station=STATION,
                endpoint=self.endpoint,
                outside=self.outside,
                certificates=self.certificates,
                folder=folder,
                placement="{ position_m = [0, 0, 0], orientation_wxyz = [1, 0, 0, 0] }",
            )
        )
        environment = {
            **{name: value for name, value in os.environ.items() if "PALPATE_" not in name},
            "XDG_STATE_HOME": str(folder / "xdg"),
        }
        self._up = subprocess.Popen(
            [sys.executable, "-m", "palpate_deploy", "up", "--profile", str(self.profile)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        self._sessions = contextlib.ExitStack()
        try:
            self.operator = self._sessions.enter_context(self.join("operator", honest=True))
            self.wait(self._serves, "the station serves")
        except BaseException:
            self.close()
            raise

    def link(self, holder: str, *, honest: bool = False, **changes: Any) -> LinkConfig:
        """The link of whoever holds the certificate in a folder of the lab.

        Who is not ``honest`` does not keep to the roles: its own Zenoh refuses nothing.
        """
        tls = TlsConfig.of_folder(self.certificates / holder).model_copy(update={"roles": honest})
        values: dict[str, Any] = {
            "connect": (self.endpoint,),
            "tls": tls,
            "wait_for_router_s": LIVE_S,
        }
        return LinkConfig(**(values | changes))

    def join(self, holder: str, *, honest: bool = False, **changes: Any) -> Session:
        """A session of that holder; see ``link``."""
        return Session.open(self.link(holder, honest=honest, **changes), station=STATION)

    def robot(self) -> Session:
        """A session of a robot that has just come; of the same one only the first refusal is told.

        It comes from outside, and does not keep to its role.
        """
        return self.join("robot", connect=(self.outside,))

    def _serves(self) -> bool:
        features = self.status("features")
        return features is not None and features.counters.get("estimates_published", 0) > 10

    def status(self, service: str) -> Status | None:
        """What a process says of itself, to the operator; None = nothing."""
        from palpate.bus.endpoints import STATUS
        from palpate.messages import ServiceRequest

        found = self.operator.query_all(STATUS, ServiceRequest(), service=service, timeout_s=5.0)
        return next((one for one in found if isinstance(one, Status)), None)

    def counter(self, service: str, name: str) -> int:
        """A counter of a process; 0 = it does not count that."""
        status = self.status(service)
        return 0 if status is None else int(status.counters.get(name, 0))

    def log(self, service: str) -> str:
        """What the log of a process holds."""
        logs = sorted((self.folder / "xdg").glob(f"palpate/runs/*/logs/{service}.log"))
        return logs[-1].read_text(errors="replace") if logs else ""

    def logged(self, service: str, words: str, since: int) -> str:
        """The line of a log that holds these words, after so many characters; waits for it."""

        def find() -> str:
            lines = self.log(service)[since:].splitlines()
            return next((line for line in lines if words in line), "")

        return _soon(find)

    def lengths(self) -> dict[str, int]:
        """How long the log of each process is now [characters]."""
        return {service: len(self.log(service)) for service in _LOGS}

    def told_refused(self, role: str, since: Mapping[str, int]) -> str:
        """The line of any log that says that messages are refused of somebody; waits for it.

        Who it is, the router's log says: somebody with the certificate of that role.
        """

        def find() -> str:
            joined = self.log("router")
            for service, length in since.items():
                for line in self.log(service)[length:].splitlines():
                    found = re.search(r"refused: a message of ([0-9a-f]+):", line)
                    if found and f"joins: {role} (id {found[1]}" in joined:
                        return line
            return ""

        return _soon(find)

    def processes(self) -> dict[str, int]:
        """Process ids of the station's processes by service."""
        found = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError):
                    words = (entry / "cmdline").read_bytes().decode().split("\0")
                    if "run" in words and any(str(self.folder) in word for word in words):
                        found[words[words.index("run") + 1]] = int(entry.name)
        return found

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until something holds.

        Raises:
            TimeoutError: It does not within ``LIVE_S``.
        """
        deadline = time.monotonic() + LIVE_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"not within {LIVE_S:g} s: {what}")
            time.sleep(0.1)

    def goes_on(self, before: int) -> bool:
        """Whether estimates still come, and none was lost of ``before`` by a restart."""
        now = self.counter("features", "estimates_published")
        with contextlib.suppress(TimeoutError):
            self.wait(
                lambda: self.counter("features", "estimates_published") > now + 20, "estimates"
            )
            return now >= before
        return False

    def fresh(self, name: str) -> Path:
        """A path of the lab at which nothing is."""
        path = self.folder / "attacks" / name
        shutil.rmtree(path, ignore_errors=True)
        path.parent.mkdir(exist_ok=True)
        return path

    @property
    def token(self) -> bytes:
        """The station's admin token."""
        return read_token(token_file(self.folder / "state", STATION))

    def close(self) -> None:
        """Stop the station."""
        self._sessions.close()
        if self._up.poll() is None:
            self._up.send_signal(signal.SIGTERM)
            try:
                self._up.wait(LIVE_S)
            except subprocess.TimeoutExpired:
                self._up.kill()
                self._up.wait()


def _soon(find: Callable[[], str]) -> str:
    """What is found in a log as soon as it is there; empty if it does not come."""
    deadline = time.monotonic() + 10.0
    while not (line := find()) and time.monotonic() < deadline:
        time.sleep(0.1)
    return line


class Heard(Closing):
    """What an honest listener hears under a key, by raw payload."""

    def __init__(self, session: Session, key: str) -> None:
        self.payloads: list[bytes] = []
        self._subscriber = session._raw.declare_subscriber(
            key, lambda sample: self.payloads.append(sample.payload.to_bytes())
        )

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()


def raw(session: Session) -> zenoh.Session:
    """Zenoh's session: an attacker does not use palpate's own."""
    return session._raw


def resident_bytes(pid: int) -> int:
    """Resident memory of a process [bytes]."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmRSS"))


def copy_of_bundle(folder: Path, name: str) -> Path:
    """A bundle that ships, under another name: what an attacker would offer."""
    import json

    from palpate_services.inference.repository import resolve

    shutil.copytree(resolve("features-virtual"), folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    text = json.dumps(manifest | {"name": name, "version": 1})
    (folder / "manifest.json").write_text(text)
    return folder
