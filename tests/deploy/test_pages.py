"""Pages that are no guides, quick start and first hour among them: their commands run.

Which of their commands are run by another test, or by none: ``tests/house/test_page_commands.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.deploy.test_guides import PAGES as GUIDES
from tests.readers.desk import CHECKOUT
from tests.readers.offline import follow
from tests.readers.page import blocks_of

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (".", "*", "docs", "docs/devices", "docs/examples", "docs/results")
PAGES = [
    path
    for path in sorted({path for folder in FOLDERS for path in ROOT.glob(f"{folder}/*.md")})
    if path not in GUIDES and any(block.run for block in blocks_of(path.read_text("utf-8")))
]

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="terminals need Linux")


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path,
            id=path.relative_to(ROOT).as_posix(),
            marks=pytest.mark.essential if path == ROOT / "README.md" else (),
        )
        for path in PAGES
    ],
)
def test_commands_of_a_page_run(path: Path, tmp_path: Path, new_port: Callable[[], int]) -> None:
    if CHECKOUT in path.read_text(encoding="utf-8") and not (ROOT / ".git").exists():
        pytest.skip("no git checkout to clone from")
    follow(path, tmp_path, new_port())
