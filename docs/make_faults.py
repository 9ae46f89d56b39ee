"""Write docs/results/faults.md: every fault of every emulated device, through worker and pipeline.

``python docs/make_faults.py`` takes about ten minutes on an idle machine. A trial in which this
process was suspended is repeated: it would measure the machine, not the gateway.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # where tests/ is

from tests.gateway.device_cases import CASES, Case
from tests.gateway.fault_bench import FaultBench, Outcome
from tests.gateway.fault_names import LASTING, SLOW_S, told_by, why_untold

PAGE = Path(__file__).parent / "results" / "faults.md"

LASTS_S = 0.5
LONG_S = (3.3, 4.1)
"""Durations of an outage [s]; two, because attempts to reopen come at intervals."""

OUTAGES = ("unplug", "restart", "silence", "busoff", "absent")
"""Faults that can last."""

STOOD_STILL_S = 0.2
_TRIES = 20

HEAD = """# Faults: how they show, and how soon they are over

How each fault of each emulated device is reported, and how soon the device works again afterwards.
Made by `python docs/make_faults.py`: the gateway's own worker and pipeline read each device in
software. Each device has each of its faults for {lasts} s, and outages also for {long} s. Every
message is compared with the load or the counts of the device at that time. The emulators in
`gateway/palpate_gateway/emulators` say what each fault is.

*Shows as*: counters and errors that report it (those in `tests/gateway/fault_names.py`). *Wrong*:
the number of messages with values that were not measured, or with a time before that of the message
before, out of all messages from the begin of the fault until the device works again. *Over after*:
time from the end of the fault to the first of several good messages in a row, after {lasts} s and,
in the last column, the longest after an outage. The goal is 1 s.

"""


class _SuspensionWatch:
    """Measures how long this process was suspended."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        last_s = time.monotonic()
        while True:
            time.sleep(0.02)
            now_s = time.monotonic()
            self.longest_s = max(self.longest_s, now_s - last_s)
            last_s = now_s


def _trial(bench: FaultBench, fault: str, lasts_s: float, watch: _SuspensionWatch) -> Outcome:
    for _ in range(_TRIES):
        watch.longest_s = 0.0
        outcome = bench.trial(fault, lasts_s)
        if watch.longest_s < STOOD_STILL_S:
            return outcome
        _tell(f"repeated: suspended for {watch.longest_s:.1f} s")
    raise SystemExit(f"this machine is too busy: {fault} was tried {_TRIES} times")


def _row(bench: FaultBench, fault: str, watch: _SuspensionWatch) -> str:
    name = bench.case.name
    untold = why_untold(name, fault)
    outcome = _trial(bench, fault, LASTS_S if untold else SLOW_S.get(fault, LASTS_S), watch)
    worst = ""
    if fault in OUTAGES:
        outages = [_trial(bench, fault, lasts_s, watch) for lasts_s in LONG_S]
        worst = _milliseconds(max(one.recovery_s for one in outages))
    told = ", ".join(f"`{one}`" for one in told_by(fault, outcome.counted, outcome.errors))
    wrong = outcome.wrong + outcome.disordered
    cells = (fault, untold or told or "**nothing**", f"{wrong} of {outcome.published}",
             _milliseconds(outcome.recovery_s), worst)  # fmt: skip
    return f"| {' | '.join(cells)} |"


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _milliseconds(time_s: float) -> str:
    text = f"{1e3 * time_s:.0f} ms"
    return text if time_s <= 1.0 else f"**{text}**"


def _section(case: Case, watch: _SuspensionWatch) -> str:
    lines = [f"## {case.name}", "", "| Fault | Shows as | Wrong | Over after | after an outage |"]
    lines.append("|---|---|---|---|---|")
    with FaultBench(case) as bench:
        for fault in sorted(bench.emulator.faults):
            if (case.name, fault) in LASTING:
                lines.append(f"| {fault} | {LASTING[case.name, fault]} | | | |")
                continue
            lines.append(_row(bench, fault, watch))
            _tell(f"{case.name} {lines[-1]}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Try everything and write the page."""
    watch = _SuspensionWatch()
    chosen = [case for case in CASES if case.emulate is not None]
    if sys.argv[1:]:
        chosen = [case for case in chosen if case.name in sys.argv[1:]]
    sections = [_section(case, watch) for case in chosen]
    if sys.argv[1:]:
        return  # some devices only: the page must hold all
    head = HEAD.format(lasts=LASTS_S, long=" and ".join(map(str, LONG_S)))
    PAGE.write_text(head + "\n".join(sections), encoding="utf-8")


if __name__ == "__main__":
    main()
