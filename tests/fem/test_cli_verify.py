"""``palpate fem verify``: every check is told, with its unit, also what could not be measured."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from palpate.errors import ConfigError
from palpate_fem.cli.app import fem_app
from palpate_fem.verify import PUBLIC_SKIN, suite
from palpate_fem.verify.check import (
    Measurement,
    MissingDataError,
    VerificationCase,
    VerificationCheck,
)


def _absent() -> Measurement:
    raise MissingDataError("no public mesh [here]")


CASES = (
    VerificationCase("hertz", lambda: Measurement(1.01, 1.0), 1e-3, "N"),
    VerificationCase("patch test", lambda: Measurement(0.0, note="to the last bit"), 1e-12),
    VerificationCase("skin/filled", _absent, 1e-2, "kPa"),
    VerificationCase("skin/thickness", lambda: Measurement(1.011, 1.0), 1.5e-2, "mm"),
)


@pytest.fixture(autouse=True)
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Path | None]:
    """Four checks instead of the suite; the folders that it is asked to look in."""
    folders: list[Path | None] = []

    def run(
        *, only: str, slow: bool, shared_data: Path | None, on_check: Callable[..., None]
    ) -> list[VerificationCheck]:
        folders.append(shared_data)
        checks = [case() for case in CASES if only in case.name]
        for done, check in enumerate(checks, start=1):
            on_check(check, done, len(checks))
        return checks

    monkeypatch.setattr("palpate_fem.verify.run", run)
    monkeypatch.setenv("COLUMNS", "200")
    return folders


def verify(*words: object) -> Result:
    """Run the command; what it raises is raised here."""
    return CliRunner().invoke(fem_app, ["verify", *map(str, words)], catch_exceptions=False)


def _row(result: Result, name: str) -> list[str]:
    (line,) = [line for line in result.stdout.splitlines() if name in line]
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def test_every_check_is_told() -> None:
    done = verify()
    assert done.exit_code == 1
    assert "2 of 4 passed, 1 skipped" in done.stdout
    assert _row(done, "hertz") == ["hertz", "1.01", "1", "N", "0.001", "FAILED"]
    assert _row(done, "patch test")[-2:] == ["ok", "to the last bit"]
    assert _row(done, "skin/thickness") == ["skin/thickness", "1.011", "1", "mm", "0.015", "ok"]


def test_what_is_skipped_says_why_and_fails_nothing() -> None:
    done = verify("--only", "skin/filled")
    assert done.exit_code == 0
    assert _row(done, "skin/filled") == [
        *("skin/filled", "kPa", "0.01", "skipped"),
        "skipped: no public mesh [here]",
    ]


def test_json_is_json() -> None:
    checks = {check["name"]: check for check in json.loads(verify("--json").stdout)}
    assert [check["passed"] for check in checks.values()] == [False, True, True, True]
    skipped = checks["skin/filled"]
    assert (skipped["skipped"], skipped["value"], skipped["unit"]) == (True, None, "kPa")


def test_no_such_check() -> None:
    assert verify("--only", "patch").exit_code == 0
    with pytest.raises(ConfigError, match="nonsense"):
        verify("--only", "nonsense")


def test_a_check_that_is_only_slow_is_not_said_to_be_missing() -> None:
    (slow, *_) = set(suite()) - set(suite(quick=True))
    with pytest.raises(ConfigError, match="take minutes") as caught:
        verify("--only", slow.name)
    assert caught.value.remedy == "add --slow"


def test_the_public_mesh_may_lie_elsewhere(tmp_path: Path, asked: list[Path | None]) -> None:
    with pytest.raises(ConfigError, match=PUBLIC_SKIN):
        verify("--public-data", tmp_path)
    (tmp_path / PUBLIC_SKIN).mkdir()
    verify("--public-data", tmp_path)
    assert asked == [tmp_path]
