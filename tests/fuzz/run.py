"""Fuzz decoders with coverage: ``python -m tests.fuzz.run DECODER... --seconds 600``.

Needs atheris (extra ``fuzz``). Begins with the target's seeds and the corpus that is kept, runs for
so many seconds of its own CPU time, keeps what reaches new branches in ``tests/fuzz/corpus`` and
its row in ``docs/results/fuzz.md``. An input that breaks a promise ends the run; it is left in
``build/fuzz`` as ``crash-...`` and belongs into the target's seeds together with the repair.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.corpus import TARGETS, archive, load_target, read_corpus, write_corpus
from tests.fuzz.table import Row, write_row

ARTIFACTS = Path("build", "fuzz")
"""Where inputs are left that break a promise, or take long."""

SLICE_S = 60
"""A process is asked to stop after so long [s]; it may be halted meanwhile, so CPU time counts."""

_INPUT_S_MAX = 1200
"""One input that takes longer is a defect [s]; wall time, so a pause must fit."""

_MEMORY_MB_MAX = 1024


@dataclass(slots=True)
class Tally:
    """What the processes of one decoder have done."""

    cpu_s: float = 0.0
    executions: int = 0
    branches: int = 0
    features: int = 0
    crashes: int = 0


def fuzz(name: str, seconds: float) -> Tally:
    """Fuzz one decoder; its corpus and its row are written anew.

    Args:
        name: One of ``TARGETS``.
        seconds: CPU time to spend [s].
    """
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
        found, small = Path(folder, "found"), Path(folder, "small")
        for place, inputs in (
            (found, [*load_target(name).seeds(), *read_corpus(name).values()]),
            (small, []),
        ):
            place.mkdir()
            for number, data in enumerate(inputs):
                (place / f"{number:04}").write_bytes(data)
        while tally.cpu_s < seconds and not tally.crashes:
            left = max(int(seconds - tally.cpu_s), 1)
            _attack(name, tally, f"-max_total_time={min(left, SLICE_S)}", str(found))
            sys.stdout.write(f"{name}: {tally}\n")
            sys.stdout.flush()
        _attack(name, Tally(), "-merge=1", str(small), str(found))
        kept = write_corpus(name, (path.read_bytes() for path in small.iterdir()))
    row = Row(name, round(tally.cpu_s), tally.executions, tally.branches, tally.features, kept,
              archive(name).stat().st_size, tally.crashes)  # fmt: skip
    write_row(row)
    return tally


def _attack(name: str, tally: Tally, *options: str) -> None:
    ARTIFACTS.mkdir(parents=True, exist_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    limits = [f"-timeout={_INPUT_S_MAX}", f"-rss_limit_mb={_MEMORY_MB_MAX}"]
    limits += [f"-artifact_prefix={ARTIFACTS}/", "-print_final_stats=1"]
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.attack", name, *limits, *options],
        stderr=subprocess.STDOUT,
        stdout=subprocess.PIPE,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    said = done.stdout.decode("latin-1")
    tally.cpu_s += after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    tally.executions += sum(map(int, re.findall(r"number_of_executed_units: (\d+)", said)))
    for branches, features in re.findall(r"cov: (\d+) ft: (\d+)", said):
        tally.branches = max(tally.branches, int(branches))
        tally.features = max(tally.features, int(features))
    if done.returncode:
        tally.crashes += 1
        sys.stderr.write(said[-4000:])


def main() -> int:
    """Run the program; 1 if a decoder broke a promise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("decoders", nargs="+", choices=("all", *TARGETS), metavar="DECODER")
    parser.add_argument("--seconds", type=float, default=600.0, help="CPU time of each [s]")
    chosen = parser.parse_args()
    names = TARGETS if "all" in chosen.decoders else chosen.decoders
    return int(any(fuzz(name, chosen.seconds).crashes for name in names))


if __name__ == "__main__":
    sys.exit(main())
