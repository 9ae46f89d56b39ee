"""The Debian of the chaos run: Python, systemd and palpate, kept between runs.

What does not change is made once (``base``); palpate itself is built from this working tree and
installed anew each time, so that a run never tests an older one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.install.debian import EXTRAS, ROOT, online, run
from tests.install.image import copy

SUITE = "trixie"
PACKAGES = ("python3", "python3-venv", "systemd")
NEEDED = ("debootstrap", "unshare", "nsenter", "ip", "mkfs.ext4", "losetup", "gcc")
CLOCK = Path(__file__).with_name("clock.c")
CLOCK_IN_IMAGE = "/usr/local/lib/palpate-clock.so"

DISK_BYTES = 1 << 30

_MADE = ".palpate-made"


def check_host() -> None:
    """Check that this host can make and boot the image.

    Raises:
        SystemExit: A program is missing, or this is not root.
    """
    if os.geteuid() != 0:
        raise SystemExit("only root can boot a system in namespaces: sudo make chaos")
    if missing := [name for name in NEEDED if shutil.which(name) is None]:
        raise SystemExit(
            f"missing: {', '.join(missing)}; apt-get install debootstrap util-linux iproute2 "
            "e2fsprogs gcc"
        )


def make(work: Path) -> Path:
    """Make the system in ``work``, or renew palpate in the one that is there; its folder."""
    base, root = work / "base", work / "root"
    work.mkdir(parents=True, exist_ok=True)
    if not base.exists():
        shutil.rmtree(work / "new", ignore_errors=True)
        packages = ",".join(PACKAGES)
        run("debootstrap", "--variant=minbase", f"--include={packages}", SUITE, work / "new")
        (work / "new").rename(base)
    wheel = _wheel(work)
    if not (base / _MADE).exists():
        _install(base, wheel, f"{wheel.name}[{EXTRAS}]")
        (base / _MADE).touch()
    copy(base, root)
    _install(root, wheel, f"{wheel.name} --no-deps --force-reinstall")
    (root / CLOCK_IN_IMAGE[1:]).parent.mkdir(parents=True, exist_ok=True)
    run("gcc", "-O2", "-shared", "-fPIC", "-o", root / CLOCK_IN_IMAGE[1:], CLOCK, "-ldl")
    return root


def _wheel(work: Path) -> Path:
    folder = work / "wheels"
    shutil.rmtree(folder, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    run(*pip, "--wheel-dir", folder, ROOT)
    (wheel,) = folder.glob("palpate-*.whl")
    return wheel


def _install(root: Path, wheel: Path, what: str) -> None:
    shutil.copy(wheel, root / "tmp" / wheel.name)
    online(
        root,
        "test -x /opt/palpate/bin/pip || python3 -m venv /opt/palpate; "
        f"cd /tmp; /opt/palpate/bin/pip install -q ./{what}; rm {wheel.name}",
        {"PIP_DEFAULT_TIMEOUT": "180", "PIP_NO_CACHE_DIR": "1"},
    )


@contextlib.contextmanager
def disk(work: Path) -> Iterator[str]:
    """A disk in a file of ``work``, with an ext4; its device is freed at the end."""
    image = work / "disk.img"
    image.unlink(missing_ok=True)
    with open(image, "wb") as file:
        file.truncate(DISK_BYTES)
    run("mkfs.ext4", "-q", "-m", "0", "-O", "^has_journal", image)
    command = ["losetup", "--find", "--show", str(image)]
    device = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    try:
        yield device
    finally:
        subprocess.run(["losetup", "--detach", device], check=False)
        image.unlink()


def commit() -> str:
    """The commit of this working tree, with ``+`` if it has changed since."""
    command = ("git", "describe", "--always", "--dirty=+")
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()
