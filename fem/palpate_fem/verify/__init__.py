"""Verification of the solver: against closed forms, other programs and conservation laws.

::

    from palpate_fem import verify

    for check in verify.run(only="hertz"):
        print(check.name, check.value, check.reference, check.passed)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from palpate_fem.verify import (
    closed_forms,
    conservation,
    contact,
    element,
    public_skin,
)
from palpate_fem.verify.check import CASES, VerificationCase, VerificationCheck

__all__ = ["VerificationCase", "VerificationCheck", "run", "suite"]

# Beside a checkout of the project; an installed palpate has none, and its checks are skipped.
SHARED_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
PUBLIC_SKIN = "nvlabs_biotac_mesh"


def suite(
    *, quick: bool = False, only: str = "", shared_data: Path | None = None
) -> tuple[VerificationCase, ...]:
    """The checks that are to be run; each is called without arguments.

    Args:
        quick: Leave out slow checks.
        only: Word in the name, upper or lower case; empty for all.
        shared_data: Folder that holds the public BioTac meshes; None = beside the project.
    """
    folder = (shared_data or SHARED_DATA) / PUBLIC_SKIN
    modules = (element, closed_forms, conservation, contact)
    every = [case for module in modules for case in CASES[module.__name__]]
    every += [
        replace(case, measure=partial(case.measure, folder=folder))
        for case in CASES[public_skin.__name__]
    ]
    word = only.lower()
    return tuple(case for case in every if word in case.name.lower() and not (quick and case.slow))


def run(
    *,
    only: str = "",
    slow: bool = False,
    shared_data: Path | None = None,
    on_check: Callable[[VerificationCheck, int, int], None] | None = None,
) -> list[VerificationCheck]:
    """Run the suite (``palpate fem verify``).

    Args:
        only: See `suite`.
        slow: Also run slow checks.
        shared_data: See `suite`.
        on_check: Called after each check with it, the number done and the total.
    """
    cases = suite(quick=not slow, only=only, shared_data=shared_data)
    checks = []
    for case in cases:
        checks.append(case())
        if on_check is not None:
            on_check(checks[-1], len(checks), len(cases))
    return checks
