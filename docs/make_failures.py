"""Write docs/failures.md: every error, its cause and its remedy (``make docs``).

``python docs/make_failures.py``          writes the page
``python docs/make_failures.py --check``  exits 1 if the committed page is not what it would write

The errors are read from the code without running it: each subclass of ``PalpateError``, and each
place that makes one, with the text of problem and remedy as the code has it.
"""

from __future__ import annotations

import ast
import re
import runpy
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from palpate.errors import ErrorCode
from palpate.messages import FaultKind, QualityFlag, SensorState, ServiceState
from palpate_services.inference.estimates import EstimateRefusal

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "failures.md"
ROOMS = ("protos", "gateway", "services", "fem", "training", "deploy")
BASE = "PalpateError"

HEAD = """\
<!-- Written by docs/make_failures.py from the code; do not edit. -->
# When something fails

Find an error message here and read what to do. Search this page for a few words of the message.
`<...>` stands for what the message names in your case; where the code chooses between several
wordings, they are separated by ` / `.

Every error that palpate raises on purpose states the problem and a remedy. A
command writes them as `error: ...` and `  fix: ...` and ends with 1 (failed), 2 (usage or
configuration) or 3 (device or recording). A program gets a `PalpateError` with `problem`, `remedy`,
`code` and `retry_after_s`. A process of a station reports them in its status, which
`palpate status` prints.

To see whether a station works: [operations.md](operations.md). If a device does not answer:
[first-biotac.md](first-biotac.md#when-it-does-not-answer). If the host lacks something:
`palpate doctor`.
"""

STATES = {
    ServiceState.STARTING: (
        "It loads what it needs.",
        "Wait a few seconds; if it lasts, see its log.",
    ),
    ServiceState.READY: ("All is well.", "-"),
    ServiceState.DEGRADED: (
        "It works, but something is lost.",
        "Do what `palpate status` prints under it: the last error with its own remedy.",
    ),
    ServiceState.FINISHED: ("Its finite source, e.g. a recording, has ended.", "-"),
    ServiceState.STOPPING: ("It has been told to end.", "-"),
}
SENSOR_STATES = {
    SensorState.UNKNOWN: ("The state comes from a newer palpate.", "Upgrade this host."),
    SensorState.STARTING: (
        "No reading has come yet.",
        "Check power, cable and address: `palpate doctor`.",
    ),
    SensorState.LIVE: ("It delivers.", "-"),
    SensorState.WARMING: (
        "Its temperature has not settled, so baselines drift.",
        "Wait; tare again when it is `LIVE`.",
    ),
    SensorState.ZERO_LOST: (
        "A force/torque sensor was opened again, or refused a new zero: its own may be gone.",
        "Unload it and `palpate tare NAME`.",
    ),
    SensorState.LOST: (
        "It is silent, or gone.",
        "Check cable and power; the gateway finds it again by itself.",
    ),
    SensorState.ENDED: (
        "A recording is over, or has failed; or a live sensor's options do not fit its device.",
        "See `last_error`.",
    ),
}
FAULTS = {
    FaultKind.UNKNOWN: ("The fault comes from a newer palpate.", "Upgrade this host."),
    FaultKind.SATURATED: ("The channel is at an end of its range.", "Press less."),
    FaultKind.DEAD: (
        "No valid word, or an end of the range while nothing touches the finger.",
        "Check plug and cable; if they are well, the electrode has lost its fluid or its wire.",
    ),
    FaultKind.STUCK: (
        "Its value stays the same; that of an intact channel varies.",
        "Unplug the finger and plug it in again; a line that repeats old words has to be reset.",
    ),
    FaultKind.ODD: (
        "Its values change, but their level at rest is not that of an intact finger.",
        "Look for an air bubble or too little fluid, as the maker's manual says.",
    ),
}
FLAGS = {
    QualityFlag.UNKNOWN: "Upgrade this host.",
    QualityFlag.STALE: "Ask for a newer frame, or allow a larger age.",
    QualityFlag.SATURATED: "Press less; the force is at least the estimate.",
    QualityFlag.UNTARED: "Let go and `palpate tare NAME`.",
    QualityFlag.OUT_OF_RANGE: "Do not act on it; train or calibrate with touches like this one.",
    QualityFlag.EXTRAPOLATING: "Take the value as a lower bound; train with larger touches.",
    QualityFlag.RANGE_UNKNOWN: "`palpate train upgrade` writes the training range into the bundle.",
    QualityFlag.UNCALIBRATED: "`palpate calibrate NAME` makes a bundle for this finger.",
}
REFUSALS = {
    EstimateRefusal.UNTARED: "Let go and `palpate tare NAME`.",
    EstimateRefusal.WRONG_TARE: "Ask about the frame's own finger; or tare again.",
    EstimateRefusal.TARE_UNKNOWN: "Start the gateway that took the tare, or tare again.",
    EstimateRefusal.INVALID_CHANNELS: "See the sensor's faults in `palpate status`.",
    EstimateRefusal.WRONG_SENSOR: "Load a bundle of this kind of sensor: `palpate model load`.",
    EstimateRefusal.WRONG_MESH: "Use field and synthesis bundles of one mesh.",
    EstimateRefusal.NON_FINITE: "`palpate model verify` the bundle; report the frame.",
    EstimateRefusal.STALE: "Find the slow stage in `palpate top`, or raise `max_age_s`.",
    EstimateRefusal.CLOCK_SKEW: "Set the clocks of both hosts ([time](time.md)).",
    EstimateRefusal.REPLAYED: "Set `accept_replayed = true` if no robot moves by these estimates.",
    EstimateRefusal.NO_MODEL: "`palpate model load NAME --sensor SENSOR`.",
    EstimateRefusal.SKIPPED_RATE: "Not a failure; a larger `rate_hz` publishes more.",
}


@dataclass(frozen=True, slots=True)
class ErrorClass:
    """A subclass of ``PalpateError`` as its source says it."""

    name: str
    bases: tuple[str, ...]
    meaning: str
    code: str
    init: ast.FunctionDef | None
    """What puts its texts together, if not its caller."""


@dataclass(frozen=True, slots=True, order=True)
class Failure:
    """A place that makes an error: texts as the code has them, parts that vary in ``<...>``."""

    module: str
    error: str
    problem: str
    remedy: str | None


Module = tuple[str, ast.Module]
Causes = Mapping[Any, tuple[str, str]]
"""Member of an enumeration -> what causes it, and what to do."""


def modules() -> list[Module]:
    """Dotted name and syntax tree of every module that is written by hand."""
    found = []
    for room in ROOMS:
        for path in sorted((ROOT / room).glob("palpate*/**/*.py")):
            if not path.stem.endswith("_pb2"):
                parts = path.relative_to(ROOT / room).with_suffix("").parts
                name = ".".join(part for part in parts if part != "__init__")
                found.append((name, ast.parse(path.read_text(encoding="utf-8"))))
    return found


def error_classes(code: list[Module]) -> dict[str, ErrorClass]:
    """Name -> class of every error, bases before what derives from them."""
    found: dict[str, ErrorClass] = {}
    while True:
        before = len(found)
        for _, tree in code:
            for node in ast.walk(tree):
                if not isinstance(node, ast.ClassDef) or node.name in found:
                    continue
                bases = tuple(ast.unparse(base).rpartition(".")[2] for base in node.bases)
                parents = [base for base in bases if base in found]
                if node.name != BASE and not parents:
                    continue
                code_of = found[parents[0]].code if parents else ErrorCode.INTERNAL.name
                for line in node.body:
                    if isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == "code":
                        code_of = ast.unparse(line.value).rpartition(".")[2]
                meaning = ast.get_docstring(node) or ""
                inits = [one for one in node.body if getattr(one, "name", "") == "__init__"]
                init = inits[0] if inits and isinstance(inits[0], ast.FunctionDef) else None
                own = init if init and "remedy" not in _parameters(init) else None
                found[node.name] = ErrorClass(node.name, bases, meaning, code_of, own)
        if len(found) == before:
            return found


Function = ast.FunctionDef | ast.AsyncFunctionDef
Calls = list[tuple[Function | None, ast.Call]]
Texts = dict[str, str]
"""Name -> the text that it stands for, where the code around shows it."""


def text_of(node: ast.expr | None, known: Texts) -> str:
    """A text as a reader sees it: literal parts as they are, others in ``<...>``."""
    if node is None:
        return ""
    if isinstance(node, ast.FormattedValue):
        node = node.value
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part, known) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left, known) + text_of(node.right, known)
    if isinstance(node, ast.IfExp):
        return _either([text_of(part, known) for part in (node.body, node.orelse)])
    if isinstance(node, ast.Dict):
        return _either([text_of(part, known) for part in node.values])
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        if node.func.attr in {"format", "get"} and ast.unparse(node.func.value) in known:
            return known[ast.unparse(node.func.value)].replace("{", "<").replace("}", ">")
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) in known:
        return known[ast.unparse(node.value)]
    if ast.unparse(node) in known:
        return known[ast.unparse(node)]
    if isinstance(node, ast.Name):
        words = node.id
    else:
        words = re.sub(r"\W+", " ", re.sub(r"self\._?|str\(|len\(", "", ast.unparse(node)))
    words = " ".join(words.replace("_", " ").split()).lower()
    return f"<{words}>" if len(words) <= 40 else "<...>"


def _either(texts: list[str]) -> str:
    """Texts of which one is shown."""
    return " / ".join(dict.fromkeys(text for text in texts if text))


def _is_text(node: ast.expr) -> bool:
    """Whether it is a text that a reader understands without the code."""
    if isinstance(node, ast.Dict):
        return bool(node.values) and all(_is_text(one) for one in node.values)
    if isinstance(node, ast.IfExp):
        return _is_text(node.body) or _is_text(node.orelse)
    if isinstance(node, ast.BinOp):
        return _is_text(node.left) or _is_text(node.right)
    if isinstance(node, ast.JoinedStr):
        return any(_is_text(part) for part in node.values)
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value


def _assigned(lines: Iterable[ast.AST], known: Texts, prefix: str = "") -> Texts:
    """Texts that names stand for; several of one name are shown side by side."""
    found: dict[str, list[str]] = defaultdict(list)
    for line in lines:
        if isinstance(line, ast.Assign):
            targets, value = line.targets, line.value
        elif isinstance(line, ast.AnnAssign) and line.value is not None:
            targets, value = [line.target], line.value
        else:
            continue
        for target in targets:
            if isinstance(target, ast.Name) and _is_text(value):
                found[prefix + target.id].append(text_of(value, known))
    return {name: _either(texts) for name, texts in found.items()}


def failures(code: list[Module], classes: dict[str, ErrorClass]) -> list[Failure]:
    """Every place that makes an error, but for those that pass one on."""
    constants = {module: _assigned(tree.body, {}) for module, tree in code}
    found = []
    for module, tree in code:
        known = dict(constants[module])
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module in constants:
                for alias in node.names:
                    if alias.name in constants[node.module]:
                        known[alias.asname or alias.name] = constants[node.module][alias.name]
            elif isinstance(node, ast.ClassDef):
                known |= _assigned(node.body, known, "self.")
        calls = _calls(tree)
        for function, call in calls:
            if _name(call.func) in classes:
                for texts in _contexts(function, calls, known):
                    made = _failure(module, call, classes[_name(call.func)], texts)
                    found += [made] if made else []
    return sorted(found)


def _parameters(function: Function) -> list[str]:
    """Names of what a function takes by position or by name, in order."""
    taken = [*function.args.posonlyargs, *function.args.args]
    if taken and taken[0].arg in {"self", "cls"}:
        del taken[0]
    return [one.arg for one in [*taken, *function.args.kwonlyargs]]


def _given(function: Function, call: ast.Call) -> dict[str, ast.expr]:
    """Parameter -> what a call gives for it."""
    given = dict(zip(_parameters(function), call.args, strict=False))
    return given | {word.arg: word.value for word in call.keywords if word.arg}


def _defaults(function: Function, known: Texts) -> Texts:
    """Parameter -> the text that stands for it where a call gives none."""
    taken = function.args
    pairs = [*zip(reversed(taken.args), reversed(taken.defaults), strict=False)]
    pairs += [
        (one, value)
        for one, value in zip(taken.kwonlyargs, taken.kw_defaults, strict=True)
        if value
    ]
    return {
        one.arg: text_of(value, known)
        for one, value in pairs
        if _is_text(value) or ast.unparse(value) in known
    }


def _calls(tree: ast.Module) -> Calls:
    """Every call, with the function that it stands in."""
    found: Calls = []

    def look(node: ast.AST, inside: Function | None) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Call):
                found.append((inside, child))
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                look(child, child)
            else:
                look(child, inside)

    look(tree, None)
    return found


def _contexts(function: Function | None, calls: Calls, known: Texts) -> list[Texts]:
    """What names stand for in a function: once for each call that gives it a text."""
    if function is None:
        return [known]
    known = known | _defaults(function, known) | _assigned(ast.walk(function), known)
    contexts = []
    for caller, call in calls:
        if _name(call.func) != function.name or caller is function:
            continue
        around = known if caller is None else known | _assigned(ast.walk(caller), known)
        texts = {
            name: text_of(value, around)
            for name, value in _given(function, call).items()
            if _is_text(value) or ast.unparse(value) in around
        }
        if texts:
            contexts.append(known | texts)
    return contexts or [known]


def _name(function: ast.expr) -> str:
    return ast.unparse(function).rpartition(".")[2]


def _failure(module: str, call: ast.Call, made: ErrorClass, known: Texts) -> Failure | None:
    """The error that a call makes; None if it passes on another one's remedy."""
    if made.init is not None:
        given = _given(made.init, call)
        known = known | {name: text_of(value, known) for name, value in given.items()}
        call = next(
            one
            for one in ast.walk(made.init)
            if isinstance(one, ast.Call) and ast.unparse(one.func) == "super().__init__"
        )
    words = {keyword.arg: keyword.value for keyword in call.keywords}
    problem = text_of(call.args[0] if call.args else words.get("problem"), known)
    remedy = words.get("remedy")
    if isinstance(remedy, ast.Attribute) and remedy.attr == "remedy":
        return None
    return Failure(module, made.name, problem, None if remedy is None else text_of(remedy, known))


def _cell(text: str) -> str:
    """A text inside a cell of a table, shown as it is."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))  # code stays code
    parts[::2] = [re.sub(r"([\\`*_<>\[\]$~#])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts).replace("|", r"\|")


def _meaning(docstring: str) -> str:
    """The first paragraphs of a docstring, before its sections, on one line each."""
    text = re.split(r"\n(?:Attributes|Args|Raises):\n", docstring)[0].strip()
    return re.sub(r"``(.*?)``", r"`\1`", " ".join(text.split()))


def _member_docs(path: str, name: str) -> dict[str, str]:
    """Member -> the docstring below it, of an enumeration."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    (node,) = [one for one in ast.walk(tree) if isinstance(one, ast.ClassDef) and one.name == name]
    docs = {}
    for line, after in zip(node.body, node.body[1:], strict=False):
        if isinstance(line, ast.Assign) and isinstance(after, ast.Expr):
            docs[ast.unparse(line.targets[0])] = _meaning(ast.literal_eval(after.value))
    return docs


def _table(title: str, kind: Iterable[Enum], causes: Causes) -> list[str]:
    """Members of an enumeration with what causes them and what to do."""
    assert set(causes) == set(kind), f"{title} ...: a member has no cause and remedy"
    rows = [f"| `{name_of(one)}` | {' | '.join(causes[one])} |" for one in causes]
    return [f"| {title} | cause | remedy |", "|---|---|---|", *rows, ""]


def name_of(member: Enum) -> str:
    """What a user meets: the name of a counter, else of the state."""
    return member.value if isinstance(member, EstimateRefusal) else member.name


def _states() -> list[str]:
    flags = _member_docs("protos/palpate/messages/estimates.py", "QualityFlag")
    refusals = _member_docs("services/palpate_services/inference/estimates.py", "EstimateRefusal")
    causes: Causes = {one: (flags[one.name], remedy) for one, remedy in FLAGS.items()}
    reasons: Causes = {one: (refusals[one.name], remedy) for one, remedy in REFUSALS.items()}
    return [
        "## States, faults, flags",
        "",
        *_table("A process is", ServiceState, STATES),
        *_table("A sensor is", SensorState, SENSOR_STATES),
        *_table("A channel is", FaultKind, FAULTS),
        *_table("An estimate is flagged", QualityFlag, causes),
        *_table("A frame gets no estimate; the counter is", EstimateRefusal, reasons),
    ]


def page() -> str:
    """The catalogue."""
    code = modules()
    classes = error_classes(code)
    made: dict[str, list[Failure]] = defaultdict(list)
    for failure in failures(code, classes):
        made[failure.error].append(failure)
    lines = [HEAD, *_states(), "## Errors", ""]
    lines += ["| error | is also | code | means |", "|---|---|---|---|"]
    for name, one in classes.items():
        bases = ", ".join(f"`{base}`" for base in one.bases)
        link = f"[{name}](#{name.lower()})" if made[name] else f"`{name}`"
        cells = [link, bases, f"`{one.code}`", _meaning(one.meaning)]
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for name, one in classes.items():
        if not made[name]:
            continue
        lines += [f"## {name}", "", _meaning(one.meaning), ""]
        lines += ["| it says | remedy | from |", "|---|---|---|"]
        rows = [
            f"| {_cell(failure.problem)} | {_cell(failure.remedy or '')} | `{failure.module}` |"
            for failure in made[name]
        ]
        lines += [*dict.fromkeys(rows), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(FRESH["write_or_check"]({PAGE: page()}))
