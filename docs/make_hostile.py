"""Write docs/results/hostile-files.md and .json: bad bundles and records, and what they cost.

``python -m docs.make_hostile`` makes each file, gives it to the ``palpate`` command in a process of
its own, and removes it. It takes three minutes on an idle machine, and needs 2 GB of the disk.
"""

from __future__ import annotations

import json
import multiprocessing
import re
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from tests.hostile import bundles, records, trial

from palpate.errors import printable
from palpate_deploy.bench.results import machine

PAGE = Path(__file__).parent / "results" / "hostile-files.md"

SECONDS_MAX = 10.0
BYTES_MAX = 500_000_000

HEAD = """# Bad bundles and records: refused soon, by name, with little memory

What bad bundles and records do to the commands that read them. Made by
`python -m docs.make_hostile`: each file is given to `palpate model verify`, or to
`palpate info`, in a process of its own. *Time* counts from the start of Python; *memory* is the
largest resident memory of the command, or of the child process in which it tries a model. The goal
is a typed error within {seconds:.0f} s and {megabytes:.0f} MB; the first row of each table is a
good file, for comparison. The files are made by `tests/hostile/`, whose tests assert the bounds.

"""


def _trial(make: Callable[[Path], None], command: tuple[str, ...], name: str) -> trial.Trial:
    with tempfile.TemporaryDirectory(prefix="hostile-") as folder:
        path = Path(folder) / name
        # In a process of its own: what it takes to make the file must not count.
        child = multiprocessing.get_context("fork").Process(target=make, args=(path,))
        child.start()
        child.join()
        if child.exitcode != 0:
            raise SystemExit(f"the file for {name} could not be made")
        return trial.run(*command, str(path))


def kept(answer: trial.Trial) -> bool:
    """Whether a bad file was refused as it must be."""
    typed = bool(answer.error) and not answer.traceback and not answer.hung
    return typed and answer.seconds <= SECONDS_MAX and answer.peak_bytes <= BYTES_MAX


def _table(
    title: str,
    cases: Mapping[str, Callable[[Path], None]],
    good: Callable[[Path], None],
    command: tuple[str, ...],
    name: str,
) -> tuple[str, dict[str, trial.Trial]]:
    lines = [f"## {title}", "", "| File | Error | Time | Memory | Says |", "|---|---|---|---|---|"]
    answers = {}
    for what, make in {"nothing is wrong": good, **cases}.items():
        answer = answers[what] = _trial(make, command, name)
        first = answer.says.splitlines()[0] if answer.says else ""
        said = re.sub(r"\S*hostile-\w+/", "", printable(first)).removeprefix("error: ")
        said = said.replace("|", "\\|").replace("`", "'")[:120]
        missed = "" if what == "nothing is wrong" or kept(answer) else " **missed**"
        lines.append(
            f"| {what} | {answer.error or 'none'}{missed} | {answer.seconds:.1f} s | "
            f"{answer.peak_bytes / 1e6:.0f} MB | {said} |"
        )
        sys.stderr.write(f"{lines[-1]}\n")
    return "\n".join(lines) + "\n", answers


def main() -> None:
    """Try everything and write page and JSON; exit with 1 if a goal was missed."""
    tables = [
        _table("Bundles", bundles.CASES, bundles.write_good, ("model", "verify"), "bundle"),
        _table("Records", records.CASES, records.write_good, ("info",), "bad.mcap"),
    ]
    head = HEAD.format(seconds=SECONDS_MAX, megabytes=BYTES_MAX / 1e6)
    PAGE.write_text(head + "\n".join(text for text, _ in tables), encoding="utf-8")
    bad = [
        (what, answer)
        for _, answers in tables
        for what, answer in list(answers.items())[1:]  # the first is the good file
    ]
    values = {
        "bundles": {what: _numbers(answer) for what, answer in tables[0][1].items()},
        "records": {what: _numbers(answer) for what, answer in tables[1][1].items()},
        "goals_met": all(kept(answer) for _, answer in bad),
        "machine": machine(),
    }
    text = json.dumps(values, indent=2, ensure_ascii=True)
    PAGE.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    sys.exit(0 if values["goals_met"] else 1)


def _numbers(answer: trial.Trial) -> dict[str, object]:
    values = asdict(answer)
    return {key: values[key] for key in ("error", "seconds", "peak_bytes", "hung")}


if __name__ == "__main__":
    main()
