"""Every fault of every emulator, through the gateway's worker and pipeline.

This is the one proof that drivers handle faults on the wire; tests of a driver hold only what needs
its own errors or a special device. A fault must show by its counters or errors, no value that was
not measured may be published, and good messages must come again when it is over. Each fault is
tried for a time and, for devices whose decoders have to find their place again, for a single frame.
``docs/make_faults.py`` measures how soon all is well again.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from fnmatch import fnmatch
from functools import partial

import pytest
from tests.gateway.device_cases import CASES, Case
from tests.gateway.fault_bench import FaultBench, Outcome
from tests.gateway.fault_names import (
    COUNTERS,
    FORBIDDEN,
    NAMES,
    UNTOLD,
    entry_of,
    is_lasting,
    told_by,
    why_untold,
)

LASTS_S = 0.25
"""Longer than any sensor may be silent before it is said to be lost."""

AT_ONCE = 3
"""Devices that are tried at the same time: most of a trial is waiting."""

TRIALS = 3
"""Most trials of a fault that lasts."""

SINGLE = 2
"""Trials of a fault of a single frame."""

DECODED = ("biotac_*", "wrench_kms40")
"""Cases whose faults are also tried for single frames."""

AWAY = ("absent", "busoff", "clock_drift", "restart", "silence", "stuck", "unplug")
"""Faults that have no single frame."""

TRIED = [
    case
    for case in CASES
    if case.emulate is not None
    and all(importlib.util.find_spec(package) for package in case.packages)
    and case.name != "wrench_rdt-schunk_ftn"  # the Axia by another name
]


def faults_of(case: Case) -> list[str]:
    assert case.emulate is not None
    return sorted(case.emulate().faults)


PAIRS = [(case.name, fault) for case in TRIED for fault in faults_of(case)]


def try_one(bench: FaultBench, case: Case, fault: str) -> list[Outcome]:
    """Outcomes of a fault that lasts, then of the same fault for single frames.

    On a busy machine a fault may last until the device is started again or lost. Then its numbers
    and its clock start anew, and no counter sees the gap: the fault is tried again.
    """
    shows = None if why_untold(case.name, fault) else partial(told_by, fault)
    outcomes: list[Outcome] = []
    for _ in range(TRIALS):
        outcomes.append(bench.trial(fault, LASTS_S, shows=shows))
        if counted_all(case.name, fault, outcomes[-1]):
            break
    if any(fnmatch(case.name, pattern) for pattern in DECODED) and fault not in AWAY:
        outcomes += [bench.trial(fault, 0.0) for _ in range(SINGLE)]
    return outcomes


def counted_all(case: str, fault: str, outcome: Outcome) -> bool:
    """Whether every counter that must count a fault has counted it."""
    return all(map(outcome.counted.get, entry_of(COUNTERS, case, fault).split()))


def try_all(case: Case) -> dict[str, list[Outcome] | BaseException]:
    """All faults of a device, one after the other; a new device after one that went wrong."""
    outcomes: dict[str, list[Outcome] | BaseException] = {}
    left = [fault for fault in faults_of(case) if not is_lasting(case.name, fault)]
    while left:
        with FaultBench(case) as bench:
            while left:
                fault = left.pop(0)
                try:
                    outcomes[fault] = try_one(bench, case, fault)
                except BaseException as error:
                    outcomes[fault] = error
                    break
    return outcomes


@pytest.fixture(scope="module")
def outcomes_of() -> Callable[[str, str], list[Outcome]]:
    """Outcomes of a fault of a case; all are tried at the first call."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        tries: dict[str, Future[dict[str, list[Outcome] | BaseException]]] = {
            case.name: pool.submit(try_all, case) for case in TRIED
        }

    def find(case: str, fault: str) -> list[Outcome]:
        outcomes = tries[case].result()[fault]
        if isinstance(outcomes, BaseException):
            raise outcomes
        return outcomes

    return find


@pytest.mark.parametrize(("case", "fault"), PAIRS)
def test_a_fault_shows_and_nothing_wrong_is_published(
    outcomes_of: Callable[[str, str], list[Outcome]], case: str, fault: str
) -> None:
    if is_lasting(case, fault):
        pytest.skip("it lasts until a user ends it in the device")
    outcomes = outcomes_of(case, fault)
    for outcome in outcomes:
        assert outcome.wrong == 0
        assert outcome.disordered == 0
        for name in entry_of(FORBIDDEN, case, fault).split():
            assert not outcome.counted.get(name), outcome
    if not why_untold(case, fault):
        assert told_by(fault, outcomes[0].counted, outcomes[0].errors), outcomes[0]
    assert any(counted_all(case, fault, outcome) for outcome in outcomes), outcomes[:TRIALS]


def test_every_fault_has_a_name() -> None:
    faults = {fault for _, fault in PAIRS}
    assert faults <= NAMES.keys() | {fault for _, fault in UNTOLD}
    if len(TRIED) == len([case for case in CASES if case.emulate is not None]) - 1:
        assert NAMES.keys() <= faults
        for pattern, fault in (*COUNTERS, *FORBIDDEN):
            assert any(fnmatch(case, pattern) and fault == one for case, one in PAIRS)
