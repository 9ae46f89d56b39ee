"""The gate `buf breaking` of `make check`: additions pass, what breaks the contract is stopped."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BASELINE = ROOT / "tests" / "golden" / "palpate-v1.binpb"
TARE_REQUEST = re.compile(r"message TareRequest \{(.*?)\n\}", re.DOTALL)


def _breaking(folder: Path) -> subprocess.CompletedProcess[str]:
    buf = Path(sys.executable).parent / "buf"
    return subprocess.run(
        [str(buf), "breaking", "--against", str(BASELINE)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def planted(tmp_path: Path) -> Callable[[str, str], subprocess.CompletedProcess[str]]:
    """Runs the gate on a copy of the contract in which a line of `TareRequest` is replaced."""
    shutil.copy(ROOT / "buf.yaml", tmp_path)
    for proto in (ROOT / "protos" / "palpate" / "v1").glob("*.proto"):
        target = tmp_path / proto.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(proto, target)

    def plant(pattern: str, replacement: str) -> subprocess.CompletedProcess[str]:
        path = tmp_path / "protos" / "palpate" / "v1" / "service.proto"
        text = path.read_text(encoding="utf-8")
        found = TARE_REQUEST.search(text)
        assert found
        changed, count = re.subn(pattern, replacement, found[0])
        assert count == 1, f"{pattern} is not once in {found[0]}"
        path.write_text(text.replace(found[0], changed), encoding="utf-8")
        return _breaking(tmp_path)

    return plant


def test_the_contract_as_it_is_passes() -> None:
    result = _breaking(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


def test_an_addition_passes(planted: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    result = planted(r"uint32 frames = (\d+);", r"uint32 frames = \1; uint32 planted = 1000;")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("pattern", "replacement"),
    [
        (r"uint32 frames = \d+;", "uint32 frames = 1000;"),
        (r"uint32 frames =", "string frames ="),
        (r"uint32 frames =", "repeated uint32 frames ="),
        (r"uint32 frames = \d+;", ""),
        (r"message TareRequest", "message TareQuestion"),
    ],
    ids=["renumbered", "retyped", "repeated", "removed", "renamed message"],
)
def test_a_planted_break_is_stopped(
    planted: Callable[..., subprocess.CompletedProcess[str]], pattern: str, replacement: str
) -> None:
    result = planted(pattern, replacement)
    assert result.returncode != 0
    assert "TareRequest" in result.stdout, result.stdout + result.stderr
