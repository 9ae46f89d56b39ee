"""``palpate fem verify``, ``bench`` and ``study``: is the solver right, fast, and fine enough?"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palpate.config import looking_at
from palpate.errors import ConfigError
from palpate.files.outputs import check_output
from palpate_fem.calibration.result import without_nan
from palpate_fem.cli.terminal import print_lines, print_table, progress_bar

if TYPE_CHECKING:
    from palpate_fem.study import PathRow, StudyRow
    from palpate_fem.verify import VerificationCheck


def verify_command(*, only: str | None, slow: bool, shared_data: Path | None, as_json: bool) -> int:
    """Run the verification suite, and print one line for each check.

    Returns:
        0, or 1 if a check failed; a skipped check has not failed.
    """
    from palpate_fem.verify import PUBLIC_SKIN, run

    # Whoever names the folder wants the check that needs it, so it must not be skipped silently.
    if shared_data is not None:
        with looking_at(shared_data):
            is_there = (shared_data / PUBLIC_SKIN).is_dir()
        if not is_there:
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
        raise _no_check(only or "")
    if as_json:
        typer.echo(json.dumps(without_nan([asdict(check) for check in checks]), indent=1))
    else:
        _show_checks(checks)
    return 0 if all(check.passed for check in checks) else 1


def _no_check(only: str) -> ConfigError:
    """Why no check with this word in its name was run."""
    from palpate_fem.verify import suite

    if suite(only=only):
        return ConfigError(f"the checks with {only!r} take minutes", remedy="add --slow")
    return ConfigError(f"no check has {only!r} in its name", remedy="leave out --only")


def bench_command(*, edge_mm: float | None, layers: int, as_json: bool) -> None:
    """Measure, and print each metric."""
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
        return
    print_table(
        ("metric", "value"),
        [
            (name, f"{value:.4g}" if isinstance(value, float) else str(value))
            for name, value in metrics.items()
        ],
        title="one trajectory",
        numbers_from=1,
    )


def _show_checks(checks: list[VerificationCheck]) -> None:
    skipped = sum(check.skipped for check in checks)
    passed = sum(check.passed and not check.skipped for check in checks)
    table = Table(
        title="verification",
        box=SIMPLE_HEAD,  # lines between columns would cost the width that notes need
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
            f"{check.tolerance:.2g}",
            _verdict(check),
            escape(check.note),
        )
    Console().print(table)


def _verdict(check: VerificationCheck) -> str:
    if check.skipped:
        return "[yellow]skipped[/]"
    return "[green]ok[/]" if check.passed else "[red]FAILED[/]"


def study_command(what: str, *, png: Path | None, as_json: bool) -> int:
    """Run a study of ``mesh`` or ``steps``.

    Returns:
        0, or 1 if the last refinement changed more than is accepted, or an indentation did not
        complete.

    Raises:
        ConfigError: The picture cannot be written.
    """
    from palpate_fem.study import EDGES_M, PRESSES, STEPS, mesh_study, step_study

    check_output(png, "--png", ".png")
    total = len(PRESSES) * (len(EDGES_M) if what == "mesh" else len(STEPS))
    with progress_bar() as bar:
        task = bar.add_task(f"{what} study", total=total)

        def on_row(row: StudyRow) -> None:
            bar.update(task, advance=1, info=f"{row.press}, {row.seconds:.0f} s")

        rows = (mesh_study if what == "mesh" else step_study)(on_row=on_row)
    if png is not None:
        from palpate_fem.plot.validation import plot_study

        plot_study(rows, png)
    if as_json:
        typer.echo(json.dumps([row.plain() for row in rows], indent=1))
    else:
        _show_study(rows)
    return 0 if all(row.accepted for row in rows[-len(PRESSES) :]) else 1


def _show_study(rows: list[StudyRow]) -> None:
    headings = (
        "press", "edge [mm]", "unknowns", "steps", "force [N]", "change [%]", "moved [um]",
        "at most [um]", "iterations", "seconds", "outcome",
    )  # fmt: skip
    cells = [
        (
            row.press,
            f"{row.edge_m * 1e3:g}",
            f"{row.unknowns:,}",
            str(row.steps),
            f"{row.force_n:.4f}",
            f"{100 * row.force_change:.2f}",
            f"{1e6 * row.displacement_change_m:.1f}",
            f"{1e6 * row.largest_change_m:.1f}",
            str(row.iterations),
            f"{row.seconds:.1f}",
            row.outcome,
        )
        for row in rows
    ]
    print_table(headings, cells, title="what refinement changes", numbers_from=1)


def path_study_command(
    *, count: int, seed: int, edge_m: float, fluid_volume_m3: float | None, as_json: bool
) -> int:
    """Run random paths, and print those that are not as they should be.

    Returns:
        0, or 1 if fewer than 97 % complete, friction gave work on one, or one left a trace.
    """
    from palpate_fem.study import COMPLETE_SHARE, path_study

    with progress_bar() as bar:
        task = bar.add_task("paths", total=count)

        def on_row(row: PathRow) -> None:
            bar.update(task, advance=1, info=f"{row.indenter} {row.outcome}, {row.seconds:.0f} s")

        rows = path_study(
            edge_m=edge_m, count=count, seed=seed, fluid_volume_m3=fluid_volume_m3, on_row=on_row
        )
    complete = sum(row.complete for row in rows)
    if as_json:
        content = {
            "edge_m": edge_m,
            "seed": seed,
            "fluid_volume_m3": fluid_volume_m3,
            "complete": complete,
            "accepted": sum(row.accepted for row in rows),
            "rows": [row.plain() for row in rows],
        }
        typer.echo(json.dumps(content, indent=1))
    else:
        _show_paths(rows)
    return 0 if complete >= COMPLETE_SHARE * count and all(row.accepted for row in rows) else 1


def _show_paths(rows: list[PathRow]) -> None:
    odd = [row for row in rows if not (row.complete and row.accepted)]
    if odd:
        print_table(
            ("indenter", "at mm", "path", "outcome", "steps", "friction uJ", "left um", "why"),
            [
                (
                    row.indenter,
                    f"{row.at_mm[0]:g} {row.at_mm[1]:g}",
                    row.words,
                    row.outcome,
                    f"{row.done} of {row.steps}",
                    f"{1e6 * row.friction_j:.1f}, least {1e6 * row.friction_least_j:.2g}",
                    f"{1e6 * row.undone_m:.4f}",
                    row.reason,
                )
                for row in odd
            ],
            title="not as they should be",
            numbers_from=4,
        )
    whole = [row for row in rows if row.complete]
    left = max((row.undone_m for row in whole), default=float("nan"))
    print_lines(
        f"{len(whole)} of {len(rows)} complete; friction took work on all but "
        f"{sum(not row.took for row in rows)}; at most {1e6 * left:.4f} um left of "
        f"{len(whole)}; {sum(row.seconds for row in rows):.0f} s"
    )
