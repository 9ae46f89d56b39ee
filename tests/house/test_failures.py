"""The catalogue of failures knows every typed error, and each says what to do about it."""

from __future__ import annotations

import ast
import importlib
import runpy
from pathlib import Path
from typing import Any

import pytest

from palpate.errors import PalpateError

ROOT = Path(__file__).resolve().parents[2]
CATALOGUE = runpy.run_path(str(ROOT / "docs" / "make_failures.py"))

PLANTED = '''
from palpate.errors import DeviceError, PalpateError

ADVICE = "plug it in"
COMMON = {1: "wait", 2: "look again"}


class Torn(DeviceError):
    """The cable is torn."""

    def __init__(self, name):
        super().__init__(f"cable {name} is torn", remedy="mend it")


def check(name, number):
    if number == 1:
        raise Torn("red")
    if number == 2:
        raise DeviceError(f"{name} is silent", remedy=ADVICE)
    if number == 3:
        return _wrong(name, "is too warm")
    if number == 4:
        return _wrong(name, "is too cold", remedy="warm it")
    try:
        ...
    except PalpateError as error:
        raise DeviceError(f"{name}: {error.problem}", remedy=error.remedy) from error
    raise DeviceError("nothing helps", remedy="")


def _wrong(name, problem, *, remedy="cool it"):
    return DeviceError(f"{name} {problem}", remedy=remedy)
'''


@pytest.fixture(scope="module")
def code() -> list[tuple[str, ast.Module]]:
    """Every module of the product."""
    found: list[tuple[str, ast.Module]] = CATALOGUE["modules"]()
    return found


@pytest.fixture(scope="module")
def classes(code: list[tuple[str, ast.Module]]) -> dict[str, Any]:
    found: dict[str, Any] = CATALOGUE["error_classes"](code)
    return found


def test_every_place_that_makes_an_error_says_what_to_do(
    code: list[tuple[str, ast.Module]], classes: dict[str, Any]
) -> None:
    made = CATALOGUE["failures"](code, classes)
    assert len(made) > 900, "the catalogue lost sight of the code"
    without = [one for one in made if not (one.remedy or "").strip()]
    assert not without
    assert not [one for one in made if not one.problem.strip()]


def test_every_error_of_the_code_is_in_the_catalogue(classes: dict[str, Any]) -> None:
    """As Python sees them, once the rooms' modules are imported."""
    for module in (
        "palpate.errors",
        "palpate_fem.store.files",
        "palpate_deploy.station.supervision",
    ):
        importlib.import_module(module)

    def below(kind: type[PalpateError]) -> set[type[PalpateError]]:
        return {kind}.union(*(below(one) for one in kind.__subclasses__()))

    for kind in below(PalpateError):
        if kind.__module__.startswith("palpate"):
            assert classes[kind.__name__].code == kind.code.name
            assert classes[kind.__name__].meaning, f"{kind.__name__} does not say what it means"


def test_errors_are_read_as_a_reader_sees_them(code: list[tuple[str, ast.Module]]) -> None:
    planted = [*code, ("planted", ast.parse(PLANTED))]
    classes = CATALOGUE["error_classes"](planted)
    made = {
        (one.error, one.problem, one.remedy)
        for one in CATALOGUE["failures"](planted, classes)
        if one.module == "planted"
    }
    assert made == {
        ("Torn", "cable red is torn", "mend it"),
        ("DeviceError", "<name> is silent", "plug it in"),
        ("DeviceError", "<name> is too warm", "cool it"),
        ("DeviceError", "<name> is too cold", "warm it"),
        ("DeviceError", "nothing helps", ""),  # the gate would stop this one
    }
