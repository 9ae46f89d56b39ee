"""The table of docs/results/mutation.md, made from mutation.json.

python -m tests.mutation.page
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "results"
PAGE, RESULTS = FOLDER / "mutation.md", FOLDER / "mutation.json"
EQUIVALENT = Path(__file__).with_name("equivalent.json")
MARKS = ("<!-- made by tests/mutation/page.py -->\n", "<!-- end -->\n")


def key_of(file: str, mutant: dict[str, Any]) -> str:
    """How `equivalent.json` names a mutant: by its text, so that other lines may move."""
    return f"{Path(file).name}: {mutant['before']} -> {mutant['after']}"


def judged(results: dict[str, dict[str, Any]], reasons: dict[str, str]) -> dict[str, Any]:
    """The same results with every reason that is known by now."""
    table = {}
    for name, entry in results.items():
        mutants = []
        for mutant in entry["not_killed"]:
            reason = reasons.get(key_of(entry["file"], mutant), "")
            fate = "equivalent" if reason else "survived"
            mutants.append({**mutant, "fate": fate, "reason": reason})
        counts = {
            fate: sum(mutant["fate"] == fate for mutant in mutants)
            for fate in ("survived", "equivalent")
        }
        table[name] = {**entry, **counts, "not_killed": mutants}
    return table


def table(results: dict[str, dict[str, Any]]) -> str:
    """One row a module and their sum, then the survivors and the equivalent ones by reason."""
    names = ("mutants", "tried", "killed", "timeout", "survived", "equivalent")
    rows = {name: [entry[one] for one in names] for name, entry in results.items()}
    rows["**all**"] = [sum(column) for column in zip(*rows.values(), strict=True)]
    lines = [
        "| module | mutants | tried | killed | too slow | survived | equivalent | score |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in rows.items():
        file = results[name]["file"] if name in results else ""
        shown = f"`{file}`" if file else name
        lines.append("| " + " | ".join([shown, *map(str, row), _score(row)]) + " |")
    return "\n".join([*lines, "", *_survivors(results), "", *_reasons(results), ""])


def _score(row: list[int]) -> str:
    """Killed or too slow, of those that are not equivalent."""
    _, tried, killed, timeout, _, equivalent = row
    return f"{(killed + timeout) / (tried - equivalent):.0%}"


def _survivors(results: dict[str, dict[str, Any]]) -> list[str]:
    found = [
        f"| `{Path(entry['file']).name}` | `{_cell(one['before'])}` | `{_cell(one['after'])}` |"
        for entry in results.values()
        for one in entry["not_killed"]
        if one["fate"] == "survived"
    ]
    if not found:
        return ["None survives."]
    return ["Survivors:", "", "| file | line | mutant |", "| --- | --- | --- |", *found]


def _reasons(results: dict[str, dict[str, Any]]) -> list[str]:
    found = [
        f"| `{Path(entry['file']).name}` | `{_cell(one['after'])}` | {one['reason']} |"
        for entry in results.values()
        for one in entry["not_killed"]
        if one["fate"] == "equivalent"
    ]
    if not found:
        return []
    return ["Equivalent:", "", "| file | mutant | why |", "| --- | --- | --- |", *found]


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("`", "'")


def with_table(page: str, results: dict[str, dict[str, Any]]) -> str:
    """The page with its table made anew."""
    before, _, rest = page.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    return f"{before}{MARKS[0]}\n{table(results)}\n{MARKS[1]}{after}"


def main() -> None:
    """Judge the survivors and write the table anew."""
    reasons = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    results = judged(json.loads(RESULTS.read_text(encoding="utf-8")), reasons)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), results), encoding="utf-8")


if __name__ == "__main__":
    main()
