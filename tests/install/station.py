"""Inside namespaces: install palpate and a station in an image, use it, uninstall, compare.

Started by ``tests.install.debian``. There is no systemd in the image: each unit's command is run as
the unit says, with its environment, folders and a user without rights, on a read-only system.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.install import image
from tests.install.cases import VIRTUAL
from tests.install.debian import EXTRAS, ROOT, Steps
from tests.install.service_manager import NoticeBoard, UnitFile

USER = 61184
"""The first number of systemd's dynamic users."""

NAME = "proof"
PALPATE = "/opt/palpate/bin/palpate"
PATIENCE_S = 300.0
PROFILE = VIRTUAL.replace('"recorder"]', '"fem", "recorder"]')


def said(root: Path, *command: str, **options: Any) -> str:
    """Output of a command in the image, which must succeed."""
    done = subprocess.run(
        image.inside(root, command, **options),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    if done.returncode:
        raise SystemExit(f"{command} ended with {done.returncode}: {done.stdout}{done.stderr}")
    return done.stdout


def make_folders(root: Path, unit: UnitFile) -> list[Path]:
    """State and cache folders as systemd makes them for a dynamic user: elsewhere, with a link."""
    made = []
    for setting, base in {"StateDirectory": "var/lib", "CacheDirectory": "var/cache"}.items():
        if name := unit.one(setting):
            private = root / base / "private"
            private.mkdir(mode=0o700, exist_ok=True)
            # The user in the unit's own namespace passes through it; here it must be let through.
            private.chmod(0o711)
            folder, link = private / name, root / base / name
            folder.mkdir(parents=True)
            os.chown(folder, USER, USER)
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(os.path.relpath(folder, link.parent))
            made.append(folder)
    return made


@contextlib.contextmanager
def running(root: Path, name: str, unit: UnitFile) -> Iterator[NoticeBoard]:
    """Run a unit's command; what it says to the service manager."""
    log = root / "tmp" / f"{name}.log"
    with NoticeBoard(root / "run" / f"{name}.sock") as board, open(log, "wb") as output:
        variables = {
            **unit.environment,
            "NOTIFY_SOCKET": f"/run/{name}.sock",
            "WATCHDOG_USEC": str(int(unit.one("WatchdogSec")) * 1_000_000),
        }
        folder = unit.one("WorkingDirectory")
        process = subprocess.Popen(
            image.inside(root, unit.command, variables, user=USER, folder=folder),
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            board.wait_for("READY=1", PATIENCE_S)
            yield board
            process.send_signal(signal.SIGTERM)
            ended = process.wait(float(unit.one("TimeoutStopSec")))
            assert ended == 0, f"{name} ended with {ended}"
        except BaseException:
            sys.stdout.write(log.read_text(encoding="utf-8", errors="replace")[-3000:])
            raise
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def main(root: Path, wheels: Path, report: Path) -> None:
    """The whole way; writes the report."""
    steps = Steps()
    found: dict[str, Any] = {}
    steps.part = "chroot"
    image.enter(root)
    shutil.copytree(wheels, root / "tmp" / "wheels")
    shutil.copytree(ROOT / "docs" / "examples", root / "tmp" / "examples")
    (root / "tmp" / f"{NAME}.toml").write_text(PROFILE, encoding="utf-8")
    bare = image.contents(root)
    with steps.step("pip install palpate into /opt/palpate"):
        (wheel,) = wheels.glob("palpate-*.whl")
        said(root, "python3", "-m", "venv", "/opt/palpate")
        pip = ("/opt/palpate/bin/pip", "install", "-q", "--no-index", "--find-links", "/tmp/wheels")
        said(root, *pip, f"/tmp/wheels/{wheel.name}[{EXTRAS}]")
    found["python"] = said(root, "python3", "--version").split()[1]
    found["palpate"] = said(root, PALPATE, "--version").split()[1]
    installed = image.contents(root)
    with steps.step("palpate install"):
        words = said(root, PALPATE, "install", f"/tmp/{NAME}.toml")
    told = re.findall(r"^wrote +(\S+)$", words, flags=re.MULTILINE)
    changed = image.difference(installed, image.contents(root))
    found["written"] = changed
    files = [line[2:] for line in changed if not (root / line[3:]).is_dir()]
    assert set(told) == {file for file in files if "/installed/" not in file}, (told, files)
    units = {
        name: UnitFile.read(root / "etc/systemd/system" / f"{name}@{NAME}.service")
        for name in ("palpate", "palpate-fem")
    }
    with contextlib.ExitStack() as stack:
        folders = [folder for unit in units.values() for folder in make_folders(root, unit)]
        image.read_only(root, folders)
        with steps.step("the units' commands, until both have said READY=1"):
            boards = {
                name: stack.enter_context(running(root, name, unit)) for name, unit in units.items()
            }
        with steps.step("palpate status, until everything is ready"):
            until_ready(root)
        with steps.step("a robot: 300 estimates (features_stream.py)"):
            lines = example(root, "features_stream.py").splitlines()
            found["estimates"] = sum(" N " in line for line in lines)
        with steps.step("a robot: an indentation in finite elements (simulate.py)"):
            found["simulation"] = example(root, "simulate.py").splitlines()[-1].strip()
        began_s = time.monotonic()
        with steps.step("both keep saying WATCHDOG=1"):
            for board in boards.values():
                board.wait_for("WATCHDOG=1", PATIENCE_S, began_s=began_s)
        with steps.step("SIGTERM, until both have ended with 0"):
            stack.close()
        image.writable_again(root, folders)
    found["recorded_bytes"] = sum(
        file.stat().st_size for file in folders[0].glob("runs/*.mcap") if file.is_file()
    )
    with steps.step("palpate uninstall --purge"):
        said(root, PALPATE, "uninstall", NAME, "--purge")
    found["left_by_uninstall"] = without_private(image.difference(installed, image.contents(root)))
    with steps.step("rm -r /opt/palpate"):
        shutil.rmtree(root / "opt" / "palpate")
    found["left_at_all"] = without_private(image.difference(bare, image.contents(root)))
    found["steps"] = steps.done
    report.write_text(json.dumps(found), encoding="utf-8")
    assert not found["left_by_uninstall"], found["left_by_uninstall"]
    assert not found["left_at_all"], found["left_at_all"]


def until_ready(root: Path) -> None:
    """Ask the station until nothing is missing."""
    status = image.inside(root, [PALPATE, "status", "--profile", f"/etc/palpate/{NAME}.toml"])
    began_s = time.monotonic()
    while (done := subprocess.run(status, capture_output=True, text=True, check=False)).returncode:
        if time.monotonic() - began_s > PATIENCE_S:
            raise SystemExit(done.stdout)


def example(root: Path, name: str) -> str:
    """Output of a program of docs/examples, as a user without rights runs it."""
    return said(root, "/opt/palpate/bin/python", f"/tmp/examples/{name}", user=USER + 1)


def without_private(lines: list[str]) -> list[str]:
    """Without the empty folders of systemd itself, which is not there to have made them before."""
    return [line for line in lines if line not in ("+ /var/lib/private", "+ /var/cache/private")]


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
