"""A robot on another host: it reaches the router, and nobody reaches the robot."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from palpate.config import Role
from palpate_deploy.station.certificates import issue, make_authority

PATIENCE_S = 90.0
HERE, THERE = "10.77.23.1", "10.77.23.2"

# The station's host, in a network of its own. It ends with its stdin.
_STATION = f"""
import sys, threading, time
from palpate.bus import Session, run_router
from palpate.bus.topics import STATUS
from palpate.config import LinkConfig, Role
from palpate.health import Health, HealthReporter
sys.stdin.readline()
folder = sys.argv[1]
link = LinkConfig(connect=("tls/127.0.0.1:23447",), certificates=folder)
stop = threading.Event()
listen = ("tls/127.0.0.1:23447", "tls/{THERE}:23447")
args = dict(link=link.as_role(Role.ROUTER))
router = threading.Thread(target=run_router, args=(listen, stop), kwargs=args, daemon=True)
router.start()
with Session.open(link.as_role(Role.SERVICE)) as session:
    with HealthReporter(session, Health("features", "features")):
        sys.stdin.readline()
stop.set()
router.join(10)
"""

_ROBOT = f"""
import subprocess, sys
from palpate import Client
from palpate.bus.topics import STATUS
def run(*words): subprocess.run(words, check=True)
station = subprocess.Popen(
    ["unshare", "--net", sys.executable, "-c", sys.argv[2], sys.argv[1]],
    stdin=subprocess.PIPE, text=True)
import os, time
while os.readlink(f"/proc/{{station.pid}}/ns/net") == os.readlink("/proc/self/ns/net"):
    time.sleep(0.02)
other = ("nsenter", f"--target={{station.pid}}", "--net", "ip")
run("ip", "link", "set", "lo", "up")
run("ip", "link", "add", "here", "type", "veth", "peer", "name", "there", "netns", str(station.pid))
run("ip", "addr", "add", "{HERE}/24", "dev", "here")
run("ip", "link", "set", "here", "up")
run(*other, "link", "set", "lo", "up")
run(*other, "addr", "add", "{THERE}/24", "dev", "there")
run(*other, "link", "set", "there", "up")
station.stdin.write("go\\n"); station.stdin.flush()
with Client("tls/{THERE}:23447", tls=sys.argv[1] + "/robot", timeout_s=60) as robot:
    stream = robot.session.subscriber(STATUS)
    print("got", stream.next(30.0).message.service)
station.communicate("end\\n", timeout=30)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a second network")
@pytest.mark.skipif(shutil.which("ip") is None, reason="ip (iproute2) is not installed")
def test_it_gets_streams(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    _certificates(folder)
    done = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", _ROBOT, str(folder), _STATION],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
    )
    if "unshare failed" in done.stderr or "Operation not permitted" in done.stderr:
        pytest.skip("no network namespaces here")
    assert done.stdout == "got features\n", done.stderr[-2000:]


def _certificates(folder: Path) -> None:
    make_authority(folder)
    for role in Role:
        issue(folder, role, "", [THERE] if role is Role.ROUTER else [])
