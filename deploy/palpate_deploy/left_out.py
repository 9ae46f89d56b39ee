"""What a command left out, and why: the first few for people, all of it with ``--json``."""

from __future__ import annotations

from collections.abc import Sequence

import typer

SHOWN = 10
"""How many people are told of."""


def show_left_out(pairs: Sequence[tuple[str, str]]) -> None:
    """Print names with their reasons."""
    for name, why in pairs[:SHOWN]:
        typer.echo(f"  {name}: {why}")
    if len(pairs) > SHOWN:
        typer.echo(f"  ... {len(pairs) - SHOWN} more; all of them: --json")
