"""Memory that a process gives back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PATCHWORK = """
from pathlib import Path
from palpate.process import release_free_memory, use_few_resources

use_few_resources()

def resident_mb():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6

blocks = [bytes(60_000) for _ in range(2000)]
kept = blocks[::50]
del blocks
before = resident_mb()
release_free_memory()
print(before, resident_mb(), len(kept))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's pools")
def test_free_memory_between_used_blocks_is_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PATCHWORK], capture_output=True, text=True, check=True, timeout=60
    )
    before, after, _ = map(float, done.stdout.split())
    assert before > 100
    assert after < before - 80
