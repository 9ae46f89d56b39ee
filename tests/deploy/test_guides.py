"""Guides: every command runs, in order, and prints what its page promises.

How a page is read: ``tests/readers/page.py``; how its commands run: ``tests/readers/desk.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.readers.offline import build_wheel, follow, offline_desk
from tests.readers.page import Block, blocks_of, missing_lines
from tests.readers.terminal import Unexpected

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "guides").glob("*.md"))

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="terminals need Linux")


@pytest.mark.slow
@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_commands_of_a_page_do_what_it_says(
    path: Path, tmp_path: Path, new_port: Callable[[], int]
) -> None:
    left_out = follow(path, tmp_path, new_port())
    if any(text.startswith("the rest of") for text in left_out):
        pytest.skip(left_out[-1])


@pytest.mark.slow
def test_what_a_page_installs_is_what_it_runs(tmp_path: Path, free_port: int) -> None:
    build_wheel(tmp_path / "dist")
    made = ["python3 -m venv env", "source env/bin/activate", "pip install -f dist palpate"]
    asked = ["which palpate", 'python -c "import palpate, zenoh; print(palpate.__file__)"']
    with offline_desk(tmp_path, free_port) as desk:
        before = desk.do(Block("sh", asked[0]))
        desk.do(Block("sh", "\n".join(made), {"installs": "from the package index"}))
        after = desk.do(Block("sh", "\n".join(asked)))
    assert f"{tmp_path}/commands/palpate" in before
    assert f"{tmp_path}/env/bin/palpate" in after
    assert f"{tmp_path}/env/lib" in after


def test_what_a_page_promises_has_to_be_printed() -> None:
    assert not missing_lines("wrote ... rows\n...\nend", "begin\nwrote 12  rows\nmore\nend")
    assert missing_lines("wrote ... rows", "wrote 12 columns") == ["wrote ... rows"]
    assert missing_lines("b\na", "a\nb") == ["a"], "the order counts"


@pytest.mark.parametrize("text", ["false", "false | true", "(exit 3)"])
def test_a_command_that_fails_fails_its_page(text: str, tmp_path: Path, free_port: int) -> None:
    with offline_desk(tmp_path, free_port) as desk, pytest.raises(Unexpected, match="exit"):
        desk.do(Block("sh", text))


def test_an_unknown_comment_is_no_way_to_leave_a_block_out() -> None:
    with pytest.raises(ValueError, match="no mark"):
        blocks_of("<!-- skip this -->\n```sh\nfalse\n```\n")
