"""What `make durations` writes of tests and of shared fixtures, and what it keeps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tests import conftest

FILE, FIXTURE = "tests/house/test_durations.py", "tests/house::shared"
KNOWN: dict[str, Any] = {
    "fixtures": {FIXTURE: 9.0},
    "files": {FILE: {"seconds": 30.0, "quick": ["long"], "test": ["long"]}},
}


def after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int, seconds: dict[str, float]
) -> dict[str, Any]:
    """What the file holds after a run that ended so, in which the tests took so long."""
    place = tmp_path / "durations.json"
    place.write_text(json.dumps(KNOWN), encoding="utf-8")
    monkeypatch.setattr(conftest, "DURATIONS", place)
    recording = conftest._Recording()
    for test, took in seconds.items():
        report = pytest.TestReport(
            f"{FILE}::{test}", (FILE, 1, test), {}, "passed", None, "setup", duration=took
        )
        report.user_properties = [(FIXTURE, 0.1)]
        recording.pytest_runtest_logreport(report)
    recording.pytest_sessionfinish(status)
    found: dict[str, Any] = json.loads(place.read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("status", [pytest.ExitCode.INTERRUPTED, pytest.ExitCode.INTERNAL_ERROR])
def test_an_interrupted_run_loses_nothing_that_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    assert after(tmp_path, monkeypatch, status, {"short": 0.3}) == KNOWN


@pytest.mark.parametrize("status", [pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED])
def test_a_whole_run_writes_tests_and_fixtures_of_a_folder_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    """The fixture is quick now, so no test is left out because of it."""
    found = after(tmp_path, monkeypatch, status, {"short": 0.2, "longer": 12.0})
    assert found == {
        "fixtures": {},
        "files": {FILE: {"seconds": 12.2, "quick": ["longer"], "test": ["longer"]}},
    }


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("keyword", "a"),
        ("markexpr", "slow"),
        ("lf", True),
        ("deselect", [FILE]),
        ("tier", "quick"),
    ],
)
def test_only_whole_files_are_measured(
    pytestconfig: pytest.Config, monkeypatch: pytest.MonkeyPatch, option: str, value: object
) -> None:
    monkeypatch.delattr(pytestconfig, "workerinput", raising=False)
    monkeypatch.setattr(pytestconfig, "args", [FILE])
    monkeypatch.setattr(pytestconfig.option, "record_durations", True)
    monkeypatch.setattr(pytestconfig.option, option, value, raising=False)  # without a cache no lf
    with pytest.raises(pytest.UsageError, match="measures whole files"):
        conftest.pytest_configure(pytestconfig)
