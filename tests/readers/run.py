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
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.readers.page import Block, blocks_of, missing_lines
from tests.readers.readers import DATA, READERS, ROOT, Reader, Visit
from tests.readers.terminal import Network, Terminal, Unexpected, plain

OUT = ROOT / "docs" / "results" / "readers.json"
LOGS = ROOT / "build" / "readers"
LIMIT_S = 1200.0
"""For one command, on a host with other work."""
KEPT = ("PIP_", "SSL_", "CURL_", "REQUESTS_", "HTTP_", "HTTPS_", "NO_PROXY", "OPENBLAS_")
"""Settings of this host's network and processor, which a reader has, too."""
CHECKOUT = "<this repository>"


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


def installs(block: Block) -> bool:
    """Whether a block makes an environment."""
    return block.marks.get("make readers", "").startswith(("installs", "makes an environment"))


class Desk:
    """The terminals of a reader, and what was done in them."""

    def __init__(
        self, folder: Path, home: Path, network: Network, stack: ExitStack, source: str
    ) -> None:
        self.folder, self._variables = folder, environment(home)
        self._network, self._stack = network, stack
        self._front: Terminal | None = None
        self._running: list[tuple[str, Terminal]] = []
        self._source = source
        self._all: list[Terminal] = []
        self.steps: list[dict[str, Any]] = []
        self.visit = Visit(folder, prefix=network.prefix)

    def do(self, block: Block) -> str:
        """Run a block; what it printed.

        Raises:
            Unexpected: A command fails, or does not do what the block's marks say.
        """
        install = installs(block)
        if install:
            terminal = self._open(())
        elif "background until" in block.marks or self._front is None:
            terminal = self._open(self._network.prefix)
        else:
            terminal = self._front
        printed = ""
        for number, line in enumerate(block.lines):
            last = number == len(block.lines) - 1
            printed += self._line(terminal, line, block, last=last, install=install)
        if install:
            self.folder = terminal.folder
            terminal.close()
            self._front = None
        elif "background until" in block.marks:
            self._running.append((block.lines[-1], terminal))
        else:
            self._front = terminal
        return printed

    def _line(
        self, terminal: Terminal, line: str, block: Block, *, last: bool, install: bool
    ) -> str:
        answers = block.marks["answers"].split("|") if last and "answers" in block.marks else []
        answers = [answer.strip() for answer in answers]
        pasted = line.replace(CHECKOUT, str(ROOT))
        sys.stderr.write(f"  $ {line}\n")
        began_s = time.monotonic()
        if last and "background until" in block.marks:
            text = terminal.start(
                pasted, block.marks["background until"], answers=answers, timeout_s=LIMIT_S
            )
        else:
            code, text = terminal.run(pasted, answers=answers, timeout_s=LIMIT_S)
            expected = int(block.marks.get("exits", 0)) if last else 0
            if code != expected:
                raise Unexpected(f"$ {line}\nexit {code}\n{text}")
            if line.startswith("source "):
                self._source = line.replace("source ", f"source {terminal.folder}/", 1)
        took_s = time.monotonic() - began_s
        sys.stderr.write(f"    {took_s:.1f} s\n")
        self.steps.append({"line": line, "seconds": round(took_s, 1), "install": install})
        self.visit.printed[line] = text
        return text

    def _open(self, prefix: tuple[str, ...]) -> Terminal:
        """A new terminal where the reader is, with the environment that he has activated."""
        terminal = self._stack.enter_context(Terminal(self.folder, self._variables, prefix))
        self._all.append(terminal)
        if self._source:
            terminal.run(self._source, timeout_s=60)
        return terminal

    def end_page(self) -> None:
        """Ctrl-C in the other terminals, the last first.

        Raises:
            Unexpected: A program shows a traceback when it is ended.
        """
        for line, terminal in reversed(self._running):
            _code, text = terminal.interrupt(LIMIT_S)
            if "Traceback" in text:
                raise Unexpected(f"$ {line}\nCtrl-C\n{text}")
        self._running.clear()

    def log(self) -> str:
        """What all terminals showed."""
        parts = [f"==== terminal {n}\n{plain(one.shown)}\n" for n, one in enumerate(self._all, 1)]
        return "".join(parts)


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
    with ExitStack() as stack:
        source = (
            f"source {work.parent / reader.after}/work/env/bin/activate" if reader.after else ""
        )
        desk = Desk(folder, home, stack.enter_context(Network()), stack, source)
        try:
            for page in reader.pages:
                left_out = _page(ROOT / "docs" / page, desk, folder, again=bool(reader.after))
                found.setdefault("left_out", []).extend(left_out)
                if page == reader.pages[-1]:
                    found["found"] = reader.check(desk.visit)
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


def _page(path: Path, desk: Desk, folder: Path, *, again: bool) -> list[str]:
    """Do what a page says; which commands were left out, and why.

    ``again``: the environment is there.

    Raises:
        Unexpected: Something is not as the page says.
    """
    printed, left_out = "", []
    for block in blocks_of(path.read_text(encoding="utf-8")):
        marks = block.marks
        if marks.get("needs data") and not (DATA / marks["needs data"]).is_dir():
            left_out.append(f"the rest of {path.name}: no ../shared/data/{marks['needs data']}")
            break
        if "file" in marks:
            (desk.folder / marks["file"]).write_text(block.text, encoding="utf-8")
        elif marks.get("stand-in for") and (folder / marks["stand-in for"]).exists():
            printed = ""
        elif again and installs(block):
            printed = ""
        elif "not run" in marks:
            left_out.extend(f"`{line}`: {marks['not run']}" for line in block.lines)
            printed = ""
        elif block.language == "sh":
            printed = desk.do(block)
        elif block.language == "text" and printed:
            if missing := missing_lines(block.text, printed):
                raise Unexpected(f"{path.name} promises {missing}; printed was\n{printed}")
    return left_out


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
