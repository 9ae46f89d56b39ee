"""Every command of the site is run: as pasted, by a test that is named, or not, and why.

How a page is read: ``tests/readers/page.py``. What is run as pasted is run by
``tests/deploy/test_guides.py`` and ``tests/deploy/test_pages.py``; this file looks at all else.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
from tests.deploy.test_guides import PAGES as GUIDES
from tests.deploy.test_pages import PAGES
from tests.readers.elsewhere import CI, ROOT, runs
from tests.readers.page import Block, blocks_of

from palpate_deploy.cli.app import app

COMMAND = re.compile(
    r"^\s*(?:\$ )?(?:sudo|(?:[\w./-]*/)?(?:palpate|python3?|pip3?|make|git|docker|podman|kubectl|"
    r"systemctl|journalctl|ros2|rerun|source|export|cd|cp|mkdir|rm|ls|cat|echo|apt|apt-get|npm|openssl|curl|"
    r"ssh|scp|chronyc|ptp4l|phc2sys|pmc|ip|pytest|pre-commit|ruff|ray|nvidia-smi))(?: [^=]|$)",
    re.MULTILINE,
)
"""How a line begins that a reader would paste."""

INDENTED = re.compile(r"^ +.*", re.MULTILINE)

LANGUAGES = {"", "sh", "text", "python", "toml", "ini", "csv", "c"}

NOT_RUN = {
    "chronyc", "docker build", "docker compose", "export", "ip", "kubectl apply",
    "kubectl create", "make audit", "make nightly", "make quick", "make setup", "mkdir", "phc2sys",
    "pmc", "pre-commit", "ptp4l", "rerun", "ros2 topic", "sudo pip", "sudo python3", "sudo rm",
    "sudo systemctl",
}  # fmt: skip
"""All that no test runs. A page says of each why, and which other program does, if one does."""


@pytest.fixture(scope="module")
def pages(project_files: list[Path]) -> dict[Path, list[Block]]:
    """Blocks of every page of the site (tests/house/test_site.py: those are all but fragments)."""
    fragment = re.compile(r".+\.(added|changed|fixed)\.md")
    return {
        path: blocks_of(path.read_text(encoding="utf-8"))
        for path in project_files
        if path.suffix == ".md" and not fragment.fullmatch(path.name)
    }


@pytest.fixture(scope="module")
def palpate() -> Any:
    """The tree of commands."""
    return typer.main.get_command(app)


def problems_of(page: str, blocks: list[Block]) -> list[str]:
    """What blocks of a page do not say of themselves."""
    wrong = []
    page = re.sub(r"^ +```(?:python|toml)\n.*?^ +```$", "", page, flags=re.MULTILINE | re.DOTALL)
    fences = re.findall(r"^[ \t]*(?:```|~~~)", page, flags=re.MULTILINE)
    if len(fences) != 2 * len(blocks):
        wrong.append("a block that is indented, has another fence, or does not end")
    before = None
    for block in blocks:
        if block.language not in LANGUAGES:
            wrong.append(f"{block}: a block of {block.language!r}")
        # What a command prints may tell others, indented.
        text = block.text if block.language != "text" else INDENTED.sub("", block.text)
        if block.language in {"", "text"} and COMMAND.search(text):
            wrong.append(f"{block}: has a command; say sh")
        if block.language == "text" and (before is None or before.language != "sh"):
            wrong.append(f"{block}: is printed by no command")
        if block.language == "sh" and not block.lines:
            wrong.append("an empty block of commands")
        if len(block.marks.get("not run", "and why").split()) < 2:
            wrong.append(f"{block}: is not run, and no reason says why")
        before = block
    return wrong


def problems_elsewhere(block: Block, palpate: Any) -> list[str]:
    """Commands of a block that are not run as pasted, nor by what is named."""
    wrong = []
    for line, marks in block.left_out.items():
        for mark, name in marks:
            if mark == "not run":
                continue
            file = ROOT / name
            is_test = re.fullmatch(r"tests/.+/test_\w+\.py", name) and file.is_file()
            if not (is_test or file == CI or (file.suffix == ".md" and file.is_file())):
                wrong.append(f"{line}: {name} is no test and no page")
            elif not runs(file, line, palpate):
                wrong.append(f"{line}: {name} does not run it")
    return wrong


def program_of(line: str) -> str:
    """A command without folders, versions and what it is told: ``sudo palpate install``."""
    words = [Path(word).name for word in shlex.split(line, comments=True)]
    length = 2 if words[0] in {"make", "docker", "kubectl", "ros2"} else 1
    if words[0] == "sudo":
        length = 2
    elif words[0] == "palpate":
        length = len(words)
    return " ".join(words[:length])


def test_every_block_says_what_it_is(pages: dict[Path, list[Block]]) -> None:
    """No command is left out without a reason, and none by its language."""
    wrong = {
        path.relative_to(ROOT).as_posix(): found
        for path, blocks in pages.items()
        if (found := problems_of(path.read_text(encoding="utf-8"), blocks))
    }
    assert not wrong
    assert len(pages) > 100


def test_what_is_not_run_as_pasted_is_run_by_what_is_named(
    pages: dict[Path, list[Block]], palpate: Any
) -> None:
    wrong = {
        path.relative_to(ROOT).as_posix(): found
        for path, blocks in pages.items()
        if (found := [one for block in blocks for one in problems_elsewhere(block, palpate)])
    }
    assert not wrong


def test_pages_with_commands_are_run(pages: dict[Path, list[Block]]) -> None:
    with_commands = {path for path, blocks in pages.items() if any(one.run for one in blocks)}
    assert with_commands == {*GUIDES, *PAGES}
    assert not set(GUIDES) & set(PAGES)


def test_what_no_test_runs_is_known(pages: dict[Path, list[Block]]) -> None:
    """A new line that nothing runs has to be entered above, so that somebody decides it."""
    found = {
        program_of(line)
        for blocks in pages.values()
        for block in blocks
        for line, marks in block.left_out.items()
        for mark, _ in marks
        if mark == "not run"
    }
    assert found == NOT_RUN


@pytest.mark.parametrize(
    ("page", "said"),
    [
        ("```\npalpate status\n```\n", "say sh"),
        ("```\n$ make demo\n```\n", "say sh"),
        ("```sh\nls\n```\n```text\nsudo reboot\n```\n", "say sh"),
        ("```console\npalpate status\n```\n", "a block of 'console'"),
        ("```text\nready\n```\n", "printed by no command"),
        ("1. run\n\n   ```\n   palpate status\n   ```\n", "indented"),
        ("<!-- not run: no -->\n```sh\npalpate status\n```\n", "no reason"),
        ("```\npalpate: ready\n```\n", ""),
        ("```sh\nls\n```\n", ""),
    ],
)
def test_a_command_cannot_hide(page: str, said: str) -> None:
    wrong = problems_of(page, blocks_of(page))
    assert any(said in one for one in wrong) if said else not wrong


@pytest.mark.parametrize(
    ("mark", "line", "said"),
    [
        ("tests/deploy/test_cli.py", "palpate topic list", ""),
        ("docs/quick-start.md", "palpate record --duration-s 5", ""),
        ("docs/quick-start.md", "git clone <this repository> palpate && cd palpate", ""),
        (".ci/run", "make test   # all", ""),
        ("tests/nowhere.py", "palpate topic list", "is no test"),
        ("deploy/palpate_deploy/cli/app.py", "palpate topic list", "is no test"),
        ("tests/deploy/test_cli.py", "palpate topic list --colour", "does not run it"),
        ("tests/deploy/test_cli.py", "palpate fem units fit", "does not run it"),
        ("docs/quick-start.md", "palpate record --views", "does not run it"),
        ("docs/quick-start.md", "rerun runs/demo/*.rrd", "does not run it"),
        (".ci/run", "make audit", "does not run it"),
        (".ci/run", "make nightly", "does not run it"),
        ("tests/house/test_style.py", "make check", ""),
        ("tests/house/test_style.py", "make sbom", "does not run it"),
    ],
)
def test_a_file_that_does_not_run_it_is_noticed(
    mark: str, line: str, said: str, palpate: Any
) -> None:
    wrong = problems_elsewhere(Block("sh", f"{line}\n", {"run by": mark}), palpate)
    assert any(said in one for one in wrong) if said else not wrong


def test_a_mark_of_some_lines_leaves_the_others() -> None:
    text = "palpate status\npalpate top   # live\npalpate tare finger\n# a comment\n"
    block = Block(
        "sh", text, {"run by": "tests/a.py [palpate top]", "not run": "it asks [palpate ta]"}
    )
    assert block.run == ["palpate status"]
    assert block.left_out["palpate tare finger"] == [("not run", "it asks")]
    with pytest.raises(ValueError, match="no line begins"):
        _ = Block("sh", text, {"not run": "never [palpate down]"}).run
