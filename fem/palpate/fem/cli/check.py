"""``palpate fem verify`` and ``palpate fem bench``: what the solver's own checks say, as tables."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping
from typing import Any, Protocol

import typer
from rich.console import Console
from rich.table import Table

from palpate.fem.cli.show import progress_bar
from palpate.protos.errors import ConfigError


class Check(Protocol):
    """One line of the verification suite, as ``palpate.fem.verify.run`` hands it over."""

    name: str
    value: float
    reference: float
    tolerance: float
    passed: bool
    seconds: float
    note: str


def verify_command(*, only: str | None, slow: bool, as_json: bool) -> int:
    """Run the verification suite; a line for each check as it ends.

    Returns:
        0, or 1 if a check failed.

    Raises:
        ConfigError: No check has such a name.
    """
    verify: Any = importlib.import_module("palpate.fem.verify")
    checks: list[Check] = []
    with progress_bar() as bar:
        task = bar.add_task("verify", total=None)

        def on_check(check: Check, done: int, total: int) -> None:
            checks.append(check)
            bar.update(task, completed=done, total=total, info=check.name)

        verify.run(only=only or "", slow=slow, on_check=on_check)
    if not checks:
        raise ConfigError(f"no check has {only!r} in its name", remedy="leave out --only")
    if as_json:
        typer.echo(json.dumps([_plain(check) for check in checks], indent=1))
    else:
        _show_checks(checks)
    return 0 if all(check.passed for check in checks) else 1


def bench_command(*, edge_mm: float | None, layers: int, as_json: bool) -> int:
    """Measure and show, metric by metric.

    Returns:
        0.
    """
    bench: Any = importlib.import_module("palpate.fem.bench")
    with progress_bar() as bar:
        task = bar.add_task("bench", total=None)
        metrics: Mapping[str, float | str] = bench.run(
            edge_m=None if edge_mm is None else edge_mm * 1e-3,
            layers=layers,
            on_progress=lambda what: bar.update(task, info=what),
        )
    if as_json:
        typer.echo(json.dumps(dict(metrics), indent=1))
        return 0
    table = Table(title="one trajectory")
    table.add_column("metric")
    table.add_column("value", justify="right")
    for name, value in metrics.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    Console().print(table)
    return 0


def _show_checks(checks: list[Check]) -> None:
    failed = [check.name for check in checks if not check.passed]
    table = Table(
        title="verification",
        caption=f"{len(checks) - len(failed)} of {len(checks)} passed in "
        f"{sum(check.seconds for check in checks):.0f} s",
    )
    for heading in ("check", "value", "reference", "tolerance", "", "note"):
        justify = "right" if heading in ("value", "reference", "tolerance") else "left"
        table.add_column(heading, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for check in checks:
        table.add_row(
            check.name,
            f"{check.value:.6g}",
            f"{check.reference:.6g}",
            f"{check.tolerance:.1g}",
            "[green]ok[/]" if check.passed else "[red]FAILED[/]",
            check.note,
        )
    Console().print(table)


def _plain(check: Check) -> dict[str, object]:
    """For JSON, which has no NaN and no infinity."""
    names = ("name", "value", "reference", "tolerance", "passed", "seconds", "note")
    values = {name: getattr(check, name) for name in names}
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
