"""The gateway's process stays on one core if it is told to."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest

from palpate.errors import ConfigError
from palpate_gateway.one_core import stay_on_one_core

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")

_IN_ANOTHER_PROCESS = """
import os, threading
from palpate_gateway.one_core import stay_on_one_core
early, seen = threading.Event(), {}
def look(name):
    early.wait()
    seen[name] = os.sched_getaffinity(0)
first = threading.Thread(target=look, args=("first",)); first.start()
core = stay_on_one_core(CHOICE)
second = threading.Thread(target=look, args=("second",)); second.start()
early.set(); first.join(); second.join()
print(repr((core, seen["first"], seen["second"], os.sched_getaffinity(0))))
"""


def elsewhere(choice: str) -> tuple[Any, ...]:
    code = _IN_ANOTHER_PROCESS.replace("CHOICE", choice)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    told: tuple[Any, ...] = eval(done.stdout)
    return told


def test_all_threads_stay_on_the_core_that_is_named() -> None:
    core = max(os.sched_getaffinity(0))
    assert elsewhere(str(core)) == (core, {core}, {core}, {core})


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one core only")
def test_the_idlest_is_one_of_those_that_are_allowed() -> None:
    core, *affinities = elsewhere('"idlest"')
    assert core in os.sched_getaffinity(0)
    assert affinities == [{core}] * 3


def test_any_leaves_it_to_the_system() -> None:
    everywhere = os.sched_getaffinity(0)
    assert elsewhere('"any"') == (None, everywhere, everywhere, everywhere)


def test_a_core_that_is_not_there_is_told() -> None:
    with pytest.raises(ConfigError, match=r"core 9999: this process may run on .*idlest"):
        stay_on_one_core(9999)
