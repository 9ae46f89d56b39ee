"""``palpate fem verify`` and ``palpate fem bench``: what the solver's own checks say, as tables."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palpate.errors import ConfigError
from palpate_fem.cli.show import progress_bar

if TYPE_CHECKING:
    from palpate_fem.verify import VerificationCheck


def verify_command(*, only: str | None, slow: bool, shared_data: Path | None, as_json: bool) -> int:
    """Run the verification suite; a line for each check as it ends.

    Args:
        only: Word in the names of the checks that are run; None = all.
        slow: Also those that take minutes.
        shared_data: Folder that holds the public BioTac's folder; None = beside the project.
        as_json: Print JSON instead of a table.

    Returns:
        0, or 1 if a check failed; one that was skipped has not.

    Raises:
        ConfigError: No check has such a name, or the public BioTac is not in ``shared_data``.
    """
    from palpate_fem.verify import PUBLIC_SKIN, run

    # Where it is asked for by name, a check that is skipped for its lack would be an answer missed.
    if shared_data is not None and not (shared_data / PUBLIC_SKIN).is_dir():
        raise ConfigError(
            f"--public-data {shared_data}: there is no {PUBLIC_SKIN} in it",
            remedy=f"give the folder that holds {PUBLIC_SKIN}, or leave it out",
        )
    checks: list[VerificationCheck] = []
    with progress_bar() as bar:
        task = bar.add_task("verify", total=None)

        def on_check(check: VerificationCheck, done: int, total: int) -> None:
            checks.append(check)
            bar.update(task, completed=done, total=total, info=check.name)

        run(only=only or "", slow=slow, shared_data=shared_data, on_check=on_check)
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
    bench: Any = importlib.import_module("palpate_fem.bench")
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


def _show_checks(checks: list[VerificationCheck]) -> None:
    skipped = sum(check.skipped for check in checks)
    passed = sum(check.passed and not check.skipped for check in checks)
    table = Table(
        title="verification",
        box=SIMPLE_HEAD,  # without lines between its columns a note is not cut off at 80 characters
        padding=(0, 1, 0, 0),
        caption=f"{passed} of {len(checks)} passed"
        + (f", {skipped} skipped" if skipped else "")
        + f" in {sum(check.seconds for check in checks):.0f} s",
    )
    for heading in ("check", "value", "reference", "unit", "tolerance", "", "note"):
        justify = "right" if heading in ("value", "reference", "tolerance") else "left"
        width = 24 if heading == "check" else None
        table.add_column(heading, justify=justify, overflow="fold", width=width)  # type: ignore[arg-type]
    for check in checks:
        table.add_row(
            check.name,
            *("" if check.skipped else f"{x:.6g}" for x in (check.value, check.reference)),
            check.unit,
            f"{check.tolerance:.1g}",
            _verdict(check),
            escape(check.note),
        )
    Console().print(table)


def _verdict(check: VerificationCheck) -> str:
    if check.skipped:
        return "[yellow]skipped[/]"
    return "[green]ok[/]" if check.passed else "[red]FAILED[/]"


def _plain(check: VerificationCheck) -> dict[str, object]:
    """For JSON, which has no NaN and no infinity."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in asdict(check).items()
    }
