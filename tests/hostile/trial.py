"""Runs one ``palpate`` command on a hostile file, and measures it: the error, time and memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ENDED_BY_US_S = 60.0
"""A command that takes longer is killed, and counts as hanging."""

_TYPE = "error-type: "


@dataclass(frozen=True, slots=True)
class Trial:
    """What a command did with a file.

    Attributes:
        error: Type of its error; empty = it succeeded.
        says: What it printed to stderr.
        printed: What it printed to stdout.
        seconds: Wall time, with the start of Python [s].
        peak_bytes: Largest resident memory, of the command or of a child that it waited for.
        hung: Whether it had to be killed.
    """

    error: str
    says: str
    printed: str
    seconds: float
    peak_bytes: int
    hung: bool = False

    @property
    def traceback(self) -> bool:
        """Whether the error was not meant to be."""
        return "Traceback" in self.says


def run(*words: str, most_s: float = ENDED_BY_US_S) -> Trial:
    """Run ``palpate WORDS`` in a process of its own."""
    begun = time.monotonic()
    child = subprocess.Popen(
        [sys.executable, __file__, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        out, err = child.communicate(timeout=most_s)
        hung = False
    except subprocess.TimeoutExpired:
        child.kill()
        out, err = child.communicate()
        hung = True
    seconds = time.monotonic() - begun
    lines = out.decode("utf-8", "replace").splitlines(keepends=True)
    kinds = [line.removeprefix(_TYPE).strip() for line in lines if line.startswith(_TYPE)]
    peaks = [line for line in lines if line.startswith("peak-bytes: ")]
    told = "".join(line for line in lines if not line.startswith((_TYPE, "peak-bytes: ")))
    return Trial(
        error=kinds[0] if kinds else "",
        says=err.decode("utf-8", "replace"),
        printed=told,
        seconds=seconds,
        peak_bytes=int(peaks[0].split()[1]) if peaks else 0,
        hung=hung,
    )


def _main(words: list[str]) -> None:
    import resource

    from palpate.errors import PalpateError
    from palpate_deploy.cli import options
    from palpate_deploy.cli.app import app
    from palpate_deploy.station.logs import print_error as show

    def print_error(error: PalpateError) -> None:
        sys.stdout.write(f"{_TYPE}{type(error).__name__}\n")
        show(error)

    setattr(options, show.__name__, print_error)
    code: object = 0
    try:
        app(words)
    except SystemExit as end:
        code = end.code
    finally:
        # Not ru_maxrss of this process: it counts the memory of the process that started it, too.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        mine = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        sys.stdout.write(f"peak-bytes: {max(int(mine), children) << 10}\n")
    sys.exit(code)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[2])
    os.environ.setdefault("COLUMNS", "200")
    _main(sys.argv[1:])
