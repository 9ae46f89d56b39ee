"""The verification suite: each quick check holds, and what is wrong is told."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from palpate.errors import SimulationError
from palpate_fem import verify
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.verify import closed_forms, conservation
from palpate_fem.verify.check import (
    Measurement,
    MissingDataError,
    VerificationCase,
    VerificationCheck,
)


def _quick() -> list[Any]:
    return [
        pytest.param(
            case,
            id=case.name,
        )
        for case in verify.suite(quick=True)
    ]


@pytest.mark.parametrize("case", _quick())
def test_quick(case: VerificationCase) -> None:
    check = case()
    if check.skipped:
        pytest.skip(check.note)
    assert check.passed, f"{check.value} is not {check.reference} within {check.tolerance}"


def _check(
    value: float, reference: float, tolerance: float, *, at_least: bool = False
) -> VerificationCheck:
    return VerificationCase(
        "t/one", lambda: Measurement(value, reference), tolerance, at_least=at_least
    )()


def test_a_wrong_value_fails() -> None:
    assert _check(1.009, 1.0, 1e-2).passed
    assert not _check(1.011, 1.0, 1e-2).passed
    assert not _check(0.989, 1.0, 1e-2).passed
    assert _check(-102.0, -100.0, 2.1e-2).passed
    assert not _check(100.0, -100.0, 2.1e-2).passed
    assert _check(-9e-9, 0.0, 1e-8).passed
    assert not _check(2e-8, 0.0, 1e-8).passed
    assert not _check(math.nan, 1.0, 1e-2).passed
    assert not _check(math.inf, 1.0, 1e-2).passed


def test_a_lower_limit_is_one() -> None:
    assert _check(3.0, 2.0, 0.1, at_least=True).passed
    assert _check(1.81, 2.0, 0.1, at_least=True).passed
    assert not _check(1.79, 2.0, 0.1, at_least=True).passed
    assert not _check(math.nan, 2.0, 0.1, at_least=True).passed


def test_no_solution_is_a_failure_with_a_reason() -> None:
    def measure() -> Measurement:
        raise SimulationError("an element turns inside out", remedy="none")

    check = VerificationCase("t/one", measure, 1.0)()
    assert not check.passed
    assert math.isnan(check.value)
    assert "inside out" in check.note


@pytest.mark.parametrize(
    ("name", "residuals"),
    [
        ("newton/order in contact at nodes", [1e-3, 1e-9]),
        ("newton/order in contact at nodes", []),
        ("newton/left by an iteration in mortar contact", [0.5]),
    ],
)
def test_too_few_iterations_to_measure_are_a_failure(
    name: str, residuals: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conservation, "_pressed_in_steps", lambda **_: residuals)
    (found,) = verify.run(only=name)
    assert math.isnan(found.value)
    assert not found.passed


def test_shared_data_lie_beside_the_checkout() -> None:
    assert Path(__file__).resolve().parents[3] / "shared" / "data" == verify.SHARED_DATA


def test_what_is_absent_is_skipped_with_a_reason(tmp_path: Path) -> None:
    def measure() -> Measurement:
        raise MissingDataError("no such part")

    assert VerificationCase("t/one", measure, 1.0)().skipped
    (check, *_) = verify.run(only="skin/filled", shared_data=tmp_path)
    assert check.skipped
    assert "no public BioTac" in check.note


def test_a_compressible_skin_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def soft(*args: Any, bulk_ratio: float, **more: Any) -> Any:
        return EquilibriumSystem(*args, bulk_ratio=20.0, **more)

    monkeypatch.setattr("palpate_fem.verify.bodies.EquilibriumSystem", soft)
    (check,) = verify.run(only="equibiaxial stretch 1.5")
    assert not check.passed
    assert check.value == pytest.approx(check.reference, rel=0.2)


def test_a_wrong_formula_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    (right,) = verify.run(only="hexahedra, stretch 1.1")
    assert right.passed
    exact = closed_forms.thick_sphere
    monkeypatch.setattr(closed_forms, "thick_sphere", lambda *args: 1.02 * exact(*args))
    (wrong,) = verify.run(only="hexahedra, stretch 1.1")
    assert wrong.value == right.value
    assert not wrong.passed


def test_checks_are_chosen_by_a_word_and_told_one_by_one() -> None:
    told: list[tuple[str, int, int]] = []
    checks = verify.run(
        only="PATCH test, wedges", on_check=lambda c, i, n: told.append((c.name, i, n))
    )
    assert told == [("element/patch test, wedges", 1, 1)]
    assert [check.name for check in checks] == ["element/patch test, wedges"]
    assert verify.run(only="no such word") == []


def test_names_are_unique_and_the_quick_ones_are_part_of_all() -> None:
    names = [case.name for case in verify.suite()]
    assert len(set(names)) == len(names)
    assert {case.name for case in verify.suite(quick=True)} < set(names)
