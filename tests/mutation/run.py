"""Mutation testing of the central modules: small faults are planted, the tests should notice.

    python -m tests.mutation.run                     # all modules; writes mutation.json
    python -m tests.mutation.run splits              # one; the others stay in mutation.json
    python -m tests.mutation.run splits --survivors  # of the last run, after tests were added
    python -m tests.mutation.run splits --sample 20  # a look at a few; writes nothing

Cosmic Ray plants the faults (`pip install cosmic-ray`); each mutant is tried in a copy of the
project, by a process forked from one that has the libraries loaded already, so that a mutant takes
the time of its tests only. `equivalent.json` lists mutants that change nothing that anyone can see,
with the reason; they are recognised by their text, so that other lines may move.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import importlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator
from tests.mutation.page import EQUIVALENT, RESULTS, key_of

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("protos", "gateway", "fem", "services", "training", "deploy")
SEED = 20261122

PRELOADED = (
    "numpy", "scipy.signal", "scipy.sparse.linalg", "scipy.spatial", "scipy.optimize", "h5py",
    "zenoh", "google.protobuf.descriptor_pb2", "mcap.writer", "pydantic_settings", "typer", "rich",
    "onnx", "onnxruntime", "warp", "torch", "pytest", "hypothesis.extra.numpy",
)  # fmt: skip

PATIENCE = 5.0
"""A mutant may take this many times as long as the tests without it, and 20 s more."""

CPU_LIMIT_S = 300

OPERATORS = (
    *(
        f"ReplaceComparisonOperator_{change}"
        for change in (
            "Lt_LtE", "Lt_Gt", "LtE_Lt", "LtE_GtE", "Gt_GtE", "Gt_Lt", "GtE_Gt", "GtE_LtE",
            "Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is",
        )
    ),
    *(
        f"ReplaceBinaryOperator_{change}"
        for change in (
            "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "Pow_Mul",
            "BitAnd_BitXor", "LShift_RShift", "RShift_LShift",
        )
    ),
    "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not", "AddNot",
    "ReplaceAndWithOr", "ReplaceOrWithAnd", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue",
    "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "NumberReplacer",
    "ZeroIterationForLoop",
)  # fmt: skip
"""One or two faults for each kind of place. `|` is left alone: mostly it stands between types."""


class Fate(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    TIMEOUT = "timeout"
    SURVIVED = "survived"
    EQUIVALENT = "equivalent"


@dataclass(frozen=True, slots=True)
class Target:
    """A module, and the fast tests that ought to notice a fault in it."""

    file: str
    tests: tuple[str, ...]
    sample: int


@dataclass(frozen=True, slots=True)
class Mutant:
    """One planted fault."""

    line: int
    before: str
    after: str
    operator: str
    occurrence: int
    fate: Fate = Fate.SURVIVED
    reason: str = ""


def _targets() -> dict[str, Target]:
    table = json.loads(Path(__file__).with_name("targets.json").read_text(encoding="utf-8"))
    return {
        name: Target(entry["file"], tuple(entry["tests"]), entry["sample"])
        for name, entry in table.items()
    }


def _mutants(source: str) -> list[tuple[Mutant, str]]:
    """Every mutant of a module with its text, in the order of the lines."""
    found = []
    lines = source.splitlines()
    tree = get_ast(source)
    for name in OPERATORS:
        operator = get_operator(f"core/{name}")()
        places = [place for node in ast_nodes(tree) for place in operator.mutation_positions(node)]
        for occurrence in range(len(places)):
            changed = mutate_code(source, operator, occurrence)
            if changed is None or changed == source:
                continue
            after = changed.splitlines()
            # A mutation may span lines; the first that differs tells it from the others.
            at = next((i for i, (a, b) in enumerate(zip(lines, after, strict=False)) if a != b), -1)
            if at < 0:
                continue
            before, now = lines[at].strip(), after[at].strip()
            if before.startswith("@dataclass(") or now == before.replace("*,", "/,"):
                continue  # frozen, slots, keyword-only: habits of ours, not behaviour
            found.append((Mutant(at + 1, before, now, name, occurrence), changed))
    return sorted(found, key=lambda one: (one[0].line, one[0].operator, one[0].occurrence))


def _copy(folder: Path) -> None:
    """The project without its history, environment and caches."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def _child(folder: Path, tests: tuple[str, ...]) -> None:
    """Run the tests; never returns."""
    os.setsid()
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: it ends with its parent
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S))
    os.chdir(folder)
    silent = os.open(os.devnull, os.O_RDWR)
    output = os.open(folder / "pytest.out", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(silent, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    paths = [str(folder / room) for room in ROOMS]
    sys.path[:0] = paths
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    sys.dont_write_bytecode = True  # two mutants of the same second would share a .pyc
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    pytest = importlib.import_module("pytest")
    status = 99
    with contextlib.suppress(BaseException):
        status = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]))
    os._exit(status)


def _run(folder: Path, tests: tuple[str, ...], limit_s: float) -> int | None:
    """Exit status of the tests; None if they did not end in time."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _child(folder, tests)
    deadline = time.monotonic() + limit_s
    try:
        while time.monotonic() < deadline:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):  # and what it started
            os.killpg(child, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)


@contextlib.contextmanager
def _changed(path: Path, text: str) -> Iterator[None]:
    original = path.read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(original, encoding="utf-8")


def examine(name: str, target: Target, sample: int, reasons: dict[str, str]) -> dict[str, Any]:
    """Plant a sample of faults in one module; what became of each."""
    every = _mutants((ROOT / target.file).read_text(encoding="utf-8"))
    chosen = every
    if sample < len(every):
        numbers = sorted(random.Random(f"{SEED} {name}").sample(range(len(every)), sample))
        chosen = [every[number] for number in numbers]
    tried = _try(name, target, chosen, reasons)
    return {
        "file": target.file,
        "mutants": len(every),
        "tried": len(tried),
        **{fate.value: sum(one.fate is fate for one in tried) for fate in Fate},
        "not_killed": [asdict(m) for m in tried if m.fate in {Fate.SURVIVED, Fate.EQUIVALENT}],
    }


def examine_again(
    name: str, target: Target, before: dict[str, Any], reasons: dict[str, str]
) -> dict[str, Any]:
    """Try the survivors of the last run only, after tests were added."""
    survivors = Counter(
        key_of(target.file, one) for one in before["not_killed"] if one["fate"] == Fate.SURVIVED
    )
    chosen = []
    for mutant, text in _mutants((ROOT / target.file).read_text(encoding="utf-8")):
        key = key_of(target.file, asdict(mutant))
        if survivors[key]:
            survivors[key] -= 1
            chosen.append((mutant, text))
    if gone := survivors.total():
        raise SystemExit(f"{name}: {gone} survivors are not in the module any more; run it anew")
    tried = _try(name, target, chosen, reasons)
    still = [one for one in before["not_killed"] if one["fate"] == Fate.EQUIVALENT]
    still += [asdict(one) for one in tried if one.fate in {Fate.SURVIVED, Fate.EQUIVALENT}]
    found = {fate.value: sum(one.fate is fate for one in tried) for fate in Fate}
    return {
        **before,
        "killed": before["killed"] + found["killed"],
        "timeout": before["timeout"] + found["timeout"],
        "survived": found["survived"],
        "equivalent": before["equivalent"] + found["equivalent"],
        "not_killed": still,
    }


def _try(
    name: str, target: Target, chosen: list[tuple[Mutant, str]], reasons: dict[str, str]
) -> list[Mutant]:
    """Each mutant with its fate."""
    tried: list[Mutant] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary:
        folder = Path(temporary)
        _copy(folder)
        began = time.monotonic()
        status = _run(folder, target.tests, 600)
        if status != 0:
            output = (folder / "pytest.out").read_text(encoding="utf-8", errors="replace")
            raise SystemExit(f"{name}: the tests fail without any fault planted\n{output[-3000:]}")
        limit_s = 20 + PATIENCE * (time.monotonic() - began)
        _say(f"{name}: {len(chosen)} mutants, {limit_s:.0f} s each at most")
        for mutant, text in chosen:
            reason = reasons.get(key_of(target.file, asdict(mutant)), "")
            fate = Fate.EQUIVALENT
            if not reason:
                with _changed(folder / target.file, text):
                    status = _run(folder, target.tests, limit_s)
                fate = {None: Fate.TIMEOUT, 0: Fate.SURVIVED}.get(status, Fate.KILLED)
            change = {"fate": fate, "reason": reason}
            tried.append(Mutant(**{**asdict(mutant), **change}))
            if fate is Fate.SURVIVED:
                _say(f"  {target.file}:{mutant.line} {mutant.operator}")
                _say(f"    - {mutant.before}\n    + {mutant.after}")
    return tried


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Examine the modules that are named, or all of them."""
    targets = _targets()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", help=f"of {', '.join(targets)}; all without")
    parser.add_argument("--sample", type=int, help="mutants of each module at most")
    parser.add_argument(
        "--survivors", action="store_true", help="try only what survived the last run"
    )
    asked = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    for module in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(module)
    reasons: dict[str, str] = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    for name in asked.modules or targets:
        target = targets[name]
        table = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
        if asked.survivors:
            found = examine_again(name, target, table[name], reasons)
        else:
            found = examine(name, target, asked.sample or target.sample, reasons)
        _say(f"{name}: " + ", ".join(f"{found[fate.value]} {fate.value}" for fate in Fate))
        if not asked.sample:
            table = {**table, name: found}
            text = json.dumps({k: table[k] for k in targets if k in table}, indent=1)
            RESULTS.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
