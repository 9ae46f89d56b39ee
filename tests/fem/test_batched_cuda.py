"""The batch's kernels compile for GPUs, also where there is none: Warp brings the compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import importlib, sys
import warp as wp
from palpate_fem.batched.dense_tiles import THREADS, WIDE

folder, arch = sys.argv[1:]
for name in ("factor_kernels", "solve_kernels"):
    module = wp.get_module(importlib.import_module(f"palpate_fem.batched.{name}").__name__)
    for block in (THREADS, WIDE):
        module.options["block_dim"] = block
        wp.compile_aot_module(module, device=None, arch=int(arch), module_dir=folder)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Warp for macOS has no CUDA compiler")
@pytest.mark.parametrize("arch", [75, 80, 90])
def test_dense_tiles_compile_for_three_generations(tmp_path: Path, arch: int) -> None:
    """Without tensor cores for double precision, with small products, and with large ones."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path), str(arch)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    sources = "".join(path.read_text() for path in tmp_path.glob("*.cu"))
    assert "mma.sync.aligned.m16n8k8" in sources
    assert len([*tmp_path.glob("*.cubin"), *tmp_path.glob("*.ptx")]) == 4
