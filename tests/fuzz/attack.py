"""One process of the fuzzer: ``python -m tests.fuzz.attack DECODER [libFuzzer options] CORPUS``.

``tests.fuzz.run`` starts it. The decoder's modules are imported with counters of their branches.
"""

from __future__ import annotations

import shlex
import sys
from typing import Any

from tests.fuzz.corpus import TARGETS, load_target

from palpate.process import require

_WATCHED = ("palpate_gateway", "palpate.files.record", "palpate.ros", "mcap")
"""Packages whose branches count as coverage."""


def main(name: str, options: list[str]) -> None:
    """Fuzz until an option of libFuzzer says to stop; then the process ends.

    Raises:
        SystemExit: There is no such decoder.
        MissingExtraError: atheris is not installed.
    """
    if name not in TARGETS:
        raise SystemExit(f"no decoder {name!r} -> one of {', '.join(TARGETS)}")
    atheris: Any = require("atheris", extra="fuzz")
    with atheris.instrument_imports(include=list(_WATCHED)):
        target = load_target(name)
    # libFuzzer starts itself again to merge a corpus, through a shell: this is the command.
    again = shlex.join([sys.executable, "-m", "tests.fuzz.attack", name])
    atheris.Setup([again, *options], target.check)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
