"""Starting Warp: quiet where there is no GPU, and only about that; in processes of their own."""

from __future__ import annotations

import subprocess
import sys

FIRST_ARRAY = """
import numpy as np
from palpate_fem.device import scalars
assert scalars(np.arange(3.0)).numpy().sum() == 3.0
"""

# Warp as it speaks through descriptor 2 on a machine without a GPU, whatever this one has.
A_WARP_THAT_SPEAKS = """
import os
import warp as wp
init = wp.init
def speak():
    os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. "
                b"GPU execution will not be available.\\nthe disk is on fire\\n")
    {then}
wp.init = speak
"""


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)


def test_nothing_is_said_at_the_start() -> None:
    done = run(FIRST_ARRAY)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_what_else_is_said_is_passed_on() -> None:
    done = run(A_WARP_THAT_SPEAKS.format(then="init()") + FIRST_ARRAY)
    assert (done.returncode, done.stderr) == (0, "the disk is on fire\n")


def test_a_start_that_fails_says_why() -> None:
    done = run(
        A_WARP_THAT_SPEAKS.format(then='raise RuntimeError("no kernel cache")') + FIRST_ARRAY
    )
    assert done.returncode == 1
    assert done.stderr.startswith("the disk is on fire\n")
    assert "RuntimeError: no kernel cache" in done.stderr


def test_a_closed_stderr_is_no_obstacle() -> None:
    assert run("import os; os.close(2)\n" + FIRST_ARRAY).returncode == 0
