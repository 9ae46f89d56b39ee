"""``palpate fem verify`` and ``palpate fem bench``."""

from __future__ import annotations


def verify_command(*, only: str | None, slow: bool, as_json: bool) -> int:
    """Run the verification suite."""
    raise NotImplementedError


def bench_command(*, edge_mm: float | None, layers: int, as_json: bool) -> int:
    """Measure a trajectory."""
    raise NotImplementedError
