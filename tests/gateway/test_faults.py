"""Every fault of every emulator, through the gateway's worker and pipeline.

Each must show by a name, nothing that was not measured may be published, and when it is over good
messages must come again. How soon is not tested here but told by ``docs/make_faults.py``.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

import pytest
from tests.gateway.device_cases import CASES, Case
from tests.gateway.fault_bench import FaultBench, Outcome
from tests.gateway.fault_names import NAMES, UNTOLD, is_lasting, told_by, why_untold

LASTS_S = 0.25
"""Longer than any sensor may be silent before it is said to be lost."""

AT_ONCE = 4
"""Devices that are tried at the same time: most of a trial is waiting."""

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


def try_all(case: Case) -> dict[str, Outcome | BaseException]:
    """All faults of a device, one after the other; a new device after one that went wrong."""
    outcomes: dict[str, Outcome | BaseException] = {}
    left = [fault for fault in faults_of(case) if not is_lasting(case.name, fault)]
    while left:
        with FaultBench(case) as bench:
            while left:
                fault = left.pop(0)
                shows = None if why_untold(case.name, fault) else partial(told_by, fault)
                try:
                    outcomes[fault] = bench.trial(fault, LASTS_S, shows=shows)
                except BaseException as error:
                    outcomes[fault] = error
                    break
    return outcomes


@pytest.fixture(scope="module")
def outcome_of() -> Callable[[str, str], Outcome]:
    """What became of a fault of a case; all are tried at the first question."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        tries: dict[str, Future[dict[str, Outcome | BaseException]]] = {
            case.name: pool.submit(try_all, case) for case in TRIED
        }

    def find(case: str, fault: str) -> Outcome:
        outcome = tries[case].result()[fault]
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    return find


@pytest.mark.parametrize(("case", "fault"), PAIRS)
def test_a_fault_shows_and_nothing_wrong_is_published(
    outcome_of: Callable[[str, str], Outcome], case: str, fault: str
) -> None:
    if is_lasting(case, fault):
        pytest.skip("it lasts until somebody ends it in the device")
    outcome = outcome_of(case, fault)
    assert outcome.wrong == 0
    assert outcome.disordered == 0
    if not why_untold(case, fault):
        assert told_by(fault, outcome.counted, outcome.errors), outcome


def test_every_fault_has_a_name() -> None:
    faults = {fault for _, fault in PAIRS}
    assert faults <= NAMES.keys() | {fault for _, fault in UNTOLD}
    if len(TRIED) == len([case for case in CASES if case.emulate is not None]) - 1:
        assert NAMES.keys() <= faults
