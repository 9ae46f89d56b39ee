"""Play five readers: paste the commands of a page into terminals, as it says, and see what comes.

python -m tests.readers.run [NAME ...] [--dist FOLDER] [--out FILE.json] [--work FOLDER]

Each reader has a fresh folder, a fresh home and the wheel of ``make build``; the page makes the
environment. Times are taken of each command. Hardware is played by the emulators of the page. As
root a reader has a network of its own, so that the ports of the page are free; what installs
packages is outside of it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.readers.desk import CHECKOUT, Desk
from tests.readers.readers import DATA, READERS, ROOT, Reader, Visit
from tests.readers.terminal import Network, Unexpected

OUT = ROOT / "docs" / "results" / "readers.json"
LOGS = ROOT / "build" / "readers"
KEPT = ("PIP_", "SSL_", "CURL_", "REQUESTS_", "HTTP_", "HTTPS_", "NO_PROXY", "OPENBLAS_")
"""Settings of this host's network and processor, which a reader has, too."""


def environment(home: Path) -> dict[str, str]:
    """Variables of a reader's first shell: those of nobody, beside what the host needs."""
    bases = [
        Path(sys.base_prefix) / "bin",
        "/usr/local/bin",
        "/usr/bin",
        "/bin",
        "/usr/sbin",
        "/sbin",
    ]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pip"
    kept = {name: value for name, value in os.environ.items() if name.upper().startswith(KEPT)}
    return {
        "PIP_CACHE_DIR": str(cache),
        **kept,
        "PATH": os.pathsep.join(map(str, bases)),
        "HOME": str(home),
        "LANG": "C.UTF-8",
        "DATA": str(DATA),
    }


def follow(reader: Reader, dist: Path, work: Path) -> dict[str, Any]:
    """Let a reader follow his pages; what happened."""
    home, folder = work / "home", work / "work"
    home.mkdir(parents=True)
    folder.mkdir()
    shutil.copytree(dist, folder / "dist")
    lacks = reader.own(folder) if reader.own is not None else ""
    found: dict[str, Any] = {
        "reader": reader.name, "who": reader.who, "pages": list(reader.pages),
        "promise": reader.promise, "load": round(os.getloadavg()[0], 1),
    }  # fmt: skip
    if lacks:
        return {**found, "skipped": lacks}
    before = work.parent / reader.after / folder.name / "env"
    source = f"source {before / 'bin' / 'activate'}" if reader.after else ""
    with (
        Network() as network,
        Desk(
            folder,
            environment(home),
            prefix=network.prefix,
            source=source,
            here={CHECKOUT: str(ROOT)},
            data=DATA,
        ) as desk,
    ):
        visit = Visit(folder, desk.printed, network.prefix)
        try:
            for page in reader.pages:
                left_out = desk.follow(ROOT / "docs" / page, again=bool(reader.after))
                found.setdefault("left_out", []).extend(left_out)
                if page == reader.pages[-1]:
                    found["found"] = reader.check(visit)
                desk.end_page()
        except Unexpected as error:
            found["failed"] = str(error)
        finally:
            LOGS.mkdir(parents=True, exist_ok=True)
            (LOGS / f"{reader.name}.log").write_text(desk.log(), encoding="utf-8")
    for name, install in (("install_minutes", True), ("minutes", False)):
        spent_s = sum(one["seconds"] for one in desk.steps if one["install"] is install)
        found[name] = round(spent_s / 60, 1)
    return {**found, "steps": desk.steps}


def main() -> int:
    """Play the readers that are named, or all; exit code 1 if one did not get what was promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *(one.name for one in READERS)])
    parser.add_argument("--dist", type=Path, default=ROOT / "dist")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--work", type=Path, help="folder to keep; default: one that is removed")
    given = parser.parse_args()
    if not list(given.dist.glob("palpate-*.whl")):
        raise SystemExit(f"no wheel in {given.dist}: make build")
    work = given.work or Path(tempfile.mkdtemp(prefix="palpate-readers-", dir="/var/tmp"))
    results = _before(given.out)
    try:
        for reader in READERS:
            if given.names and reader.name not in given.names:
                continue
            sys.stderr.write(f"{reader.name}: {', '.join(reader.pages)}\n")
            results[reader.name] = follow(reader, given.dist.resolve(), work / reader.name)
            result = results[reader.name]
            sys.stderr.write(
                f"  {result.get('failed') or result.get('skipped') or result['found']}\n"
            )
            given.out.write_text(json.dumps(_report(results), indent=1) + "\n", encoding="utf-8")
    finally:
        if given.work is None:
            shutil.rmtree(work)
    return int(any("failed" in one for one in results.values()))


def _before(path: Path) -> dict[str, Any]:
    """Readers that were played before, by name."""
    if not path.exists():
        return {}
    return {one["reader"]: one for one in json.loads(path.read_text(encoding="utf-8"))["readers"]}


def _report(results: dict[str, Any]) -> dict[str, Any]:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    order = [one.name for one in READERS]
    return {
        "commit": commit,
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "load": [results[name].get("load", 0.0) for name in order if name in results],
        "readers": [results[name] for name in order if name in results],
    }


if __name__ == "__main__":
    sys.exit(main())
