"""The documentation site builds without a warning, holds every page, and needs no network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FETCHED = re.compile(r'<(?:script|img|link|iframe)\b[^>]*\b(?:src|href)="(?:https?:)?//[^"]*"')
"""What a browser loads from another site; links that a reader follows are no such thing."""

pytest.importorskip("sphinx", reason="sphinx not installed (extra docs)")


def _build(sources: Path, out: Path) -> subprocess.CompletedProcess[str]:
    """As `make site` does it."""
    options = ["-q", "-W", "--keep-going", "-b", "html", "-c", str(ROOT / "docs" / "site")]
    return subprocess.run(
        [sys.executable, "-m", "sphinx", *options, str(sources), str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )


def test_make_site_builds_it_as_the_test_does() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "sphinx-build -q -W --keep-going -b html -c docs/site . build/site" in makefile


@pytest.mark.slow
def test_site_is_whole_and_needs_no_network(project_files: list[Path], tmp_path: Path) -> None:
    done = _build(ROOT, tmp_path)
    assert done.returncode == 0, done.stderr
    pages = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.html")}
    outside = re.compile(r"docs/changelog\.d/.+\.(added|changed|fixed)\.md")
    for path in project_files:
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".md" and not outside.fullmatch(name):
            assert name.removesuffix(".md") + ".html" in pages, f"{name} is not on the site"
    fetched = {
        found
        for path in tmp_path.rglob("*.html")
        for found in FETCHED.findall(path.read_text(encoding="utf-8"))
    }
    assert not fetched
    client = (tmp_path / "docs" / "site" / "api" / "client.html").read_text(encoding="utf-8")
    assert 'id="palpate.client.robot.Client.features"' in client
    assert "sensortaken" in (tmp_path / "searchindex.js").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("page", "problem"),
    [
        ("[gone](gone.md)", "gone.md"),
        ("[gone](docs/other.md#gone)", "gone"),
        ("![gone](gone.png)", "gone.png"),
        ("fine", ""),
    ],
)
def test_a_dead_link_stops_the_build(page: str, problem: str, tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    (sources / "docs").mkdir(parents=True)
    (sources / "README.md").write_text(f"# First\n\n{page}\n", encoding="utf-8")
    (sources / "docs" / "other.md").write_text("# Other\n", encoding="utf-8")
    done = _build(sources, tmp_path / "out")
    assert (done.returncode == 0) == (not problem), done.stderr
    assert problem in done.stderr
