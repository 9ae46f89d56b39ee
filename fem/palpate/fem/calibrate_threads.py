"""Threads of a simulation's process; imports nothing, for it must run before NumPy is loaded."""

from __future__ import annotations

import os


def limit_threads(threads: int) -> None:
    """Let the numerical libraries of this process use so many threads."""
    for name in ("OMP", "MKL", "OPENBLAS", "NUMEXPR"):
        os.environ[f"{name}_NUM_THREADS"] = str(threads)
