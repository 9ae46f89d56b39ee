"""On a Debian that has only Python: install, a virtual station, a robot, uninstall; what is left?

python -m tests.install.debian        (as root; needs debootstrap and a network)

Everything is timed and written into docs/results/install.json; docs/make_install.py makes the page.
The image's processes run in namespaces of their own: no packet leaves the host.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.install.booted import NotHere, under_systemd
from tests.install.image import copy, inside
from tests.install.scores import scores

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "results" / "install.json"
EXTRAS = "gateway,services,fem,metrics,web"
PACKAGES = ("python3", "python3-venv")


class Steps:
    """The steps, with their times."""

    def __init__(self) -> None:
        self.done: list[dict[str, Any]] = []
        self.part = "image"

    @contextlib.contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Do a step."""
        sys.stderr.write(f"{what} ...\n")
        began_s = time.monotonic()
        yield
        took_s = time.monotonic() - began_s
        sys.stderr.write(f"    {took_s:.1f} s\n")
        self.done.append({"part": self.part, "step": what, "seconds": round(took_s, 1)})


def run(*command: str | Path, quiet: bool = True, **options: Any) -> None:
    """Run a command; its output is shown if it fails."""
    done = subprocess.run(
        [str(word) for word in command],
        stdout=subprocess.PIPE if quiet else None,
        stderr=subprocess.STDOUT if quiet else None,
        check=False,
        **options,
    )
    if done.returncode:
        sys.stdout.write((done.stdout or b"").decode(errors="replace")[-4000:])
        raise SystemExit(f"{shlex.join(map(str, command))} ended with {done.returncode}")


def online(root: Path, script: str, variables: dict[str, str] | None = None) -> None:
    """Run a shell script in an image, with the host's network."""
    certificates = os.environ.get("SSL_CERT_FILE", "/etc/ssl/certs/ca-certificates.crt")
    shutil.copy("/etc/resolv.conf", root / "etc" / "resolv.conf")
    shutil.copy(certificates, root / "tmp" / "ca.crt")
    given = {"SSL_CERT_FILE": "/tmp/ca.crt", "PIP_CERT": "/tmp/ca.crt", **(variables or {})}
    run(*inside(root, ["sh", "-ec", script], {"DEBIAN_FRONTEND": "noninteractive", **given}))
    (root / "tmp" / "ca.crt").unlink()


def in_namespaces(module: str, *arguments: str | Path) -> None:
    """Run a program of ours in namespaces of its own."""
    command = ["unshare", "--mount", "--net", "--pid", "--ipc", "--uts", "--fork", "--kill-child"]
    run(*command, sys.executable, "-m", module, *arguments, quiet=False, cwd=ROOT)


def main() -> None:
    """Do everything, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suite", default="trixie", help="Debian's name of the release")
    parser.add_argument("--work", type=Path, help="folder to keep; default: one that is removed")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    for program in ("debootstrap", "unshare", "systemd-analyze"):
        if shutil.which(program) is None:
            raise SystemExit(
                f"{program} is missing: apt-get install debootstrap util-linux systemd"
            )
    if os.geteuid() != 0:
        raise SystemExit("only root can make an image: sudo make debian")
    work = given.work or Path(tempfile.mkdtemp(prefix="palpate-debian-", dir="/var/tmp"))
    work.mkdir(parents=True, exist_ok=True)
    try:
        given.out.write_text(
            json.dumps(prove(given.suite, work), indent=1, sort_keys=True) + "\n", encoding="utf-8"
        )
    finally:
        if given.work is None:
            shutil.rmtree(work)
    sys.stderr.write(f"wrote {given.out}\n")


def prove(suite: str, work: Path) -> dict[str, Any]:
    """All steps; the result."""
    steps = Steps()
    base, lab, wheels = work / "base", work / "lab", work / "wheels"
    with steps.step(f"debootstrap {suite}, minimal"):
        if not base.exists():
            run("debootstrap", "--variant=minbase", suite, work / "new")
            (work / "new").rename(base)
    with steps.step(f"apt-get install {' '.join(PACKAGES)}"):
        copy(base, lab)
        online(
            lab,
            f"apt-get update && apt-get install -y --no-install-recommends {' '.join(PACKAGES)}",
        )
    with steps.step("build the wheel, download what it needs"):
        shutil.rmtree(wheels, ignore_errors=True)
        wheels.mkdir()
        pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
        run(*pip, "--no-build-isolation", "--wheel-dir", wheels, ROOT)
        (wheel,) = wheels.glob("palpate-*.whl")
        shutil.copy(wheel, lab / "tmp")
        online(
            lab,
            f"python3 -m venv /tmp/pip && /tmp/pip/bin/pip wheel -q -w /tmp/wheels "
            f"'/tmp/{wheel.name}[{EXTRAS}]'",
            {"PIP_DEFAULT_TIMEOUT": "180"},
        )
        for file in (lab / "tmp" / "wheels").iterdir():
            shutil.move(file, wheels / file.name)
        for left in (lab / "tmp").iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
    steps.part = "chroot"
    report = work / "station.json"
    in_namespaces("tests.install.station", lab, wheels, report)
    found = json.loads(report.read_text(encoding="utf-8"))
    steps.done += found.pop("steps")
    steps.part = "containers"
    with steps.step("each step of the Dockerfile, then its station"):
        found["image"] = _image(base, work, wheels)
    with steps.step("podman reads the quadlets"):
        found["quadlets"] = _quadlets(lab, work)
    steps.part = "systemd"
    found["booted"] = _booted(work, steps)
    found["scores"] = scores()
    return {
        "debian": suite,
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "steps": steps.done,
        **found,
    }


def stages(dockerfile: str) -> list[list[tuple[str, str]]]:
    """The stages of a Dockerfile: each a list of instructions with their words."""
    found: list[list[tuple[str, str]]] = []
    for line in dockerfile.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        word, _, rest = line.partition(" ")
        if word == "FROM":
            found.append([])
        found[-1].append((word, rest))
    return found


def _image(base: Path, work: Path, wheels: Path) -> dict[str, Any]:
    """Make the image as the Dockerfile says, in folders, and run its station."""
    text = (ROOT / "deploy" / "containers" / "Dockerfile").read_text(encoding="utf-8")
    roots: dict[str, Path] = {}
    commands = 0
    for number, stage in enumerate(stages(text)):
        root = work / f"stage-{number}"
        copy(base, root)
        for word, rest in stage:
            if word == "FROM":
                assert rest.startswith("docker.io/library/debian:"), rest
                roots[rest.rpartition(" AS ")[2]] = root
            elif word == "RUN":
                online(root, rest)
                commands += 1
            elif word == "COPY":
                _copy_into(root, rest.split(), roots, wheels)
    size = sum(p.lstat().st_size for p in root.rglob("*") if p.is_file() and not p.is_symlink())
    report = work / "image.json"
    in_namespaces("tests.install.container", root, report)
    return {
        "commands": commands,
        "bytes": size,
        **json.loads(report.read_text(encoding="utf-8")),
    }


def _copy_into(root: Path, words: list[str], roots: dict[str, Path], context: Path) -> None:
    source, target = words[-2:]
    if words[0].startswith("--from="):
        copy(roots[words[0].removeprefix("--from=")] / source.strip("/"), root / target.strip("/"))
        return
    for file in context.glob(source):
        shutil.copy(file, root / target.strip("/"))


def _booted(work: Path, steps: Steps) -> dict[str, Any]:
    """A Debian with palpate again, and with a systemd that runs."""
    root = work / "booted"
    with steps.step("apt-get install systemd"):
        copy(work / "lab", root)
        copy(work / "stage-1" / "opt" / "palpate", root / "opt" / "palpate")
        online(root, "apt-get update && apt-get install -y --no-install-recommends systemd")
    try:
        return under_systemd(root, steps.step)
    except NotHere as error:
        return {"not_tried": str(error)}


def _quadlets(lab: Path, work: Path) -> dict[str, Any]:
    """What podman's generator makes of the files of deploy/containers."""
    root = work / "podman"
    copy(lab, root)
    online(root, "apt-get update && apt-get install -y --no-install-recommends podman")
    for file in (ROOT / "deploy" / "containers").glob("*.container"):
        shutil.copy(file, root / "tmp")
    program = "/usr/libexec/podman/quadlet"
    done = subprocess.run(
        inside(root, [program, "-dryrun"], {"QUADLET_UNIT_DIRS": "/tmp"}),
        capture_output=True,
        text=True,
        check=False,
    )
    version = subprocess.run(
        inside(root, ["dpkg-query", "--show", "--showformat=${Version}", "podman"]),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return {
        "podman": version.partition("+")[0],
        "status": done.returncode,
        "units": re.findall(r"^---(\S+)---$", done.stdout, flags=re.MULTILINE),
        "complaints": [
            line for line in done.stderr.splitlines() if "Loading source unit file" not in line
        ],
    }


if __name__ == "__main__":
    main()
