"""Nothing of the machine that made a file is in the file: no paths, package indexes or keys."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

# Written in pieces, so that this file passes its own test.
TRACES = {
    "a path of one machine": re.compile(
        rb"(?<![\w.$}~*-])/(?:"
        + rb"|".join([rb"work", rb"root", rb"home/\w+", rb"Users/\w+"])
        + rb")/"
    ),
    "a scratch path": re.compile(rb"/tmp/" + rb"palpate\b"),
    "a package index": re.compile(
        rb"(?:--|\b)(?:extra-)?" + rb"index" + rb"-url|files\." + rb"pythonhosted|/simple" + rb"/\w"
    ),
    "a private key": re.compile(rb"-----BEGIN [A-Z ]*" + rb"PRIVATE KEY-----"),
}


@pytest.mark.parametrize("trace", TRACES)
def test_no_trace_of_a_machine(
    trace: str, project_files: list[Path], relative: Callable[[Path], str]
) -> None:
    """Binary files too: an exported model or a picture can carry the paths of its maker."""
    found = [
        f"{relative(path)}: {match[0]!r}"
        for path in project_files
        if (match := TRACES[trace].search(path.read_bytes()))
    ]
    assert not found, f"holds {trace}: {found}"


def test_traces_are_recognised() -> None:
    """The patterns above must not rot."""
    samples = {
        "a path of one machine": b'open("/' + b'home/someone/data")',
        "a scratch path": b"see /tmp/" + b"palpate",
        "a package index": b"pip install --index" + b"-url x",
        "a private key": b"-----BEGIN RSA " + b"PRIVATE KEY-----",
    }
    assert samples.keys() == TRACES.keys()
    for trace, sample in samples.items():
        assert TRACES[trace].search(sample), trace
