"""Wheel and source archive in fresh environments of each Python; what is not here is said.

python -m tests.install.wheel [PYTHON ...] [--dist FOLDER] [--out FILE.json]

Without names: each Python that palpate supports, from the search path or of pyenv. In each: install
the wheel, ask `palpate doctor`, run a demo and a simulation, then install the source archive and
compare every file with that of the wheel.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "results" / "wheel.json"
SUPPORTED = ("3.11", "3.12", "3.13")
EXTRAS = "gateway,fem,services,metrics,security,web"
LIMIT_S = 1800.0
DEMO = ("demo", "--seconds", "3", "--out", "demo")
PRESS = ("fem", "run", "--edge-mm", "1.2", "--depth-mm", "0.5", "--steps", "2")


class Failed(RuntimeError):
    """A command did not end with 0."""


def interpreter(name: str) -> Path | None:
    """The Python of a name, path or version, on the search path or of pyenv; None = not here."""
    minor = name.removeprefix("python")
    found = [shutil.which(name), shutil.which(f"python{minor}")]
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found += [str(path) for path in sorted(versions.glob(f"{minor}.*/bin/python"))]
    for one in filter(None, found):
        asked = subprocess.run(
            [one, "-c", "import ensurepip, venv"], capture_output=True, check=False
        )
        if asked.returncode == 0:
            return Path(one)
    return None


def run(*command: str | Path, folder: Path) -> str:
    """Output of a command.

    Raises:
        Failed: It does not end with 0.
    """
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=clean | {"HOME": str(folder), "PIP_CACHE_DIR": str(_cache())},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    if done.returncode:
        raise Failed(f"{' '.join(map(str, command))} ended with {done.returncode}\n{done.stdout}")
    return done.stdout


def _cache() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return Path(os.environ.get("PIP_CACHE_DIR", base / "pip"))


def files_of(home: Path) -> dict[str, str]:
    """Installed files of palpate with their digests; without those that an installation writes."""
    (record,) = home.glob("env/lib/python*/site-packages/palpate-*.dist-info/RECORD")
    with record.open(encoding="utf-8", newline="") as file:
        rows = {name: digest for name, digest, _size in csv.reader(file)}
    own = re.compile(r"__pycache__|\.dist-info/(RECORD|INSTALLER|REQUESTED|direct_url.json)")
    return {name: digest for name, digest in rows.items() if not own.search(name)}


def tried(python: Path, wheel: Path, archive: Path) -> dict[str, Any]:
    """What one Python makes of both files."""
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="palpate-wheel-") as name:
        home = Path(name)
        run(python, "-m", "venv", "env", folder=home)
        pip = (home / "env" / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check")
        run(*pip, f"{wheel}[{EXTRAS}]", folder=home)
        asked = "import platform; print(platform.python_version())"
        version = run(home / "env" / "bin" / "python", "-c", asked, folder=home).strip()
        of_wheel = files_of(home)
        palpate = home / "env" / "bin" / "palpate"
        run(palpate, "doctor", folder=home)
        demo = run(palpate, *DEMO, folder=home)
        (touched,) = re.findall(r"^touched .*$", demo, flags=re.MULTILINE)
        press = run(palpate, *PRESS, folder=home)
        (ended,) = re.findall(r"^1 of 1 run: .*$", press, flags=re.MULTILINE)
        run(*pip, "--no-deps", "--force-reinstall", archive, folder=home)
        of_archive = files_of(home)
    return {
        "python": version,
        "demo": touched,
        "simulation": ended,
        "files": len(of_wheel),
        "archive_gives_the_same_files": of_wheel == of_archive,
        "seconds": round(time.monotonic() - began_s),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Try each; exit code 1 if none could be tried, or the source archive gives other files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=SUPPORTED)
    parser.add_argument("--dist", type=Path, default=ROOT / "dist")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args(arguments)
    (wheel,) = given.dist.resolve().glob("palpate-*.whl")
    (archive,) = given.dist.resolve().glob("palpate-*.tar.gz")
    results: list[dict[str, Any]] = []
    absent, failed = [], []
    for name in given.names:
        python = interpreter(name)
        if python is None:
            absent.append(name.removeprefix("python"))
            sys.stdout.write(f"{name}: not on this host, NOT tried\n")
            continue
        try:
            results.append(tried(python, wheel, archive))
        except Failed as error:
            failed.append(f"{name}: {error}")
            sys.stdout.write(f"{failed[-1]}\n")
            continue
        sys.stdout.write(f"{name}: {json.dumps(results[-1])}\n")
        sys.stdout.flush()
    same = all(one["archive_gives_the_same_files"] for one in results)
    names = ", ".join(one["python"] for one in results) or "none"
    sys.stdout.write(f"tried: {names}; not tried: {', '.join(absent) or 'none'}\n")
    report = {"extras": EXTRAS, "tried": results, "failed": failed, "not_tried": absent}
    given.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0 if results and same and not failed else 1


if __name__ == "__main__":
    sys.exit(main())
