"""The gates of ``make check`` pass, so that ``make test`` alone covers them; tiers of tests.

The gates are written once, as the lines of target ``check`` in the Makefile; this file reads and
runs them with the tools of the environment that runs the tests.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from tests.conftest import Tier

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
VARIABLES = dict(re.findall(r"^([A-Z]+) := (.*)$", MAKEFILE, flags=re.MULTILINE))


def _gates() -> list[str]:
    """Lines of target ``check``, without the folder of the tools and without the house tests."""
    recipe = re.search(r"^check:.*\n((?:\t.*\n)+)", MAKEFILE, flags=re.MULTILINE)
    assert recipe, "the Makefile has no target check"
    lines = [line.strip().removeprefix("$(BIN)/") for line in recipe[1].splitlines()]
    lines = [re.sub(r"\$\((\w+)\)", lambda name: VARIABLES[name[1]], line) for line in lines]
    return [line for line in lines if not line.startswith("pytest ")]


@pytest.mark.essential
@pytest.mark.parametrize(
    "gate",
    [pytest.param(gate, marks=pytest.mark.slow if gate == "mypy" else ()) for gate in _gates()],
)
def test_gate_passes(gate: str) -> None:
    tool, *arguments = shlex.split(gate)
    result = subprocess.run(
        [str(BIN / tool), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert result.returncode == 0, f"{gate}\n{result.stdout}\n{result.stderr}"


def test_gates_cover_format_lint_types_borders_and_wire() -> None:
    tools = {" ".join(gate.split()[:2]) for gate in _gates()}
    assert tools == {
        "ruff format",
        "ruff check",
        "mypy",
        "lint-imports",
        "buf lint",
        "buf format",
        "buf breaking",
    }


def test_pre_commit_runs_the_same_gates_with_local_tools_only() -> None:
    settings = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    assert set(re.findall(r"^ *- repo: (.*)$", settings, flags=re.MULTILINE)) == {"local"}
    assert set(re.findall(r"^ *language: (.*)$", settings, flags=re.MULTILINE)) == {"system"}
    entries = re.findall(r"^ *entry: \.venv/bin/(.*)$", settings, flags=re.MULTILINE)
    for gate in _gates():
        # ruff gets the changed files from pre-commit, and formats instead of complaining
        words = 2 if gate.startswith("ruff") else None
        start = " ".join(gate.split()[:words])
        assert any(entry.startswith(start) for entry in entries), f"no hook runs: {gate}"


def test_ci_runs_exactly_the_test_command() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111, ".ci/run is not executable"
    commands = [
        line
        for line in script.read_text(encoding="utf-8").splitlines()
        if line and not line.startswith(("#", "set ", "cd "))
    ]
    assert commands == ["make test"]


def test_a_tier_has_the_fastest_tests_of_each_file() -> None:
    tier = Tier(file_s=5.0, always_s=0.1, first_s=20.0, fixture_s=20.0)
    assert tier.left_out({"long": 3.0, "short": 1.0, "middle": 2.0}) == {"long"}
    assert tier.left_out({f"test_{k}": 0.09 for k in range(100)}) == set()
    assert tier.left_out({"only": 19.0}) == set()
    assert tier.left_out({"only": 21.0}) == {"only"}


def test_what_is_essential_is_in_the_test_command() -> None:
    """The gates above among them, however long they take."""
    listed = [sys.executable, "-m", "pytest", "--collect-only", "-q", "tests/house/test_style.py"]

    def collected(*options: str) -> int:
        done = subprocess.run(
            [*listed, *options], cwd=ROOT, capture_output=True, text=True, timeout=120, check=True
        )
        return done.stdout.count("::test_gate_passes[")

    assert collected("--tier", "test") == collected() == len(_gates())
    assert collected("--tier", "quick") < len(_gates())
