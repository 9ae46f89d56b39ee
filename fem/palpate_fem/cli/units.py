"""``palpate fem units fit`` and ``show``."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palpate.errors import ConfigError
from palpate_fem.cli.show import progress_bar
from palpate_fem.electrodes.sensor import Electrodes
from palpate_fem.population.answers import geometry_of
from palpate_fem.population.fitting import deep_states, fit_member
from palpate_fem.population.member import PAPER, Member, read_population, write_population
from palpate_fem.store.read import SimulationStore
from palpate_fem.trajectory import ANGLED_DEPTH_M, CLEARANCE_M, NORMAL_DEPTH_M

console = Console()


def planned_travel_m(name: str) -> float:
    """Travel that the paper plans for a trajectory, from its first pose on [m], by its name."""
    return CLEARANCE_M + (NORMAL_DEPTH_M if name.endswith("/normal") else ANGLED_DEPTH_M)


def fit_command(store: Path, out: Path, *, overtravel_m: float) -> int:
    """Fit the paper's three units on a store.

    Args:
        store: Trajectories of the whole set.
        out: Population file to write.
        overtravel_m: How much deeper than planned the store's paths go [m].

    Raises:
        ConfigError: The overtravel is negative.
        DatasetError: The store is empty, damaged, or of another mesh.
    """
    if overtravel_m < 0:
        raise ConfigError(f"overtravel of {overtravel_m} m", remedy="give 0 or more")
    opened = SimulationStore.open(store)
    fingertip = opened.fingertip()
    geometry = geometry_of(fingertip)
    sensor = Electrodes(geometry)
    rest = sensor.finder.measure(fingertip.pressurised_nodes)
    ids = opened.ids()
    with progress_bar() as bar:
        task = bar.add_task("films", total=len(ids))
        states = deep_states(
            opened, sensor, planned_travel_m, on_trajectory=lambda: bar.advance(task)
        )
        bar.update(task, description="units", total=len(PAPER), completed=0)
        members: list[Member] = []
        for number, wanted in enumerate(PAPER, 1):
            members.append(fit_member(geometry, rest, states, wanted, number, most_m=overtravel_m))
            bar.advance(task)
    source = f"{len(ids)} trajectories of the fingertip {fingertip.key[:12]}"
    write_population(out, members, source=source)
    _table(members)
    console.print(f"wrote {out}", soft_wrap=True, markup=False, highlight=False)
    return 0


def show_command(file: Path | None, *, as_json: bool) -> int:
    """Print a population.

    Raises:
        ConfigError: The file cannot be read, or is none.
    """
    members = read_population(file)
    if as_json:
        console.print_json(json.dumps([asdict(member) for member in members]))
    else:
        _table(members)
    return 0


def _table(members: Sequence[Member]) -> None:
    table = Table(title="units: found (published)")
    table.add_column("")
    for member in members:
        table.add_column(member.unit.name, justify="right")
    rows: list[tuple[str, Callable[[Member], str]]] = [
        ("lowest tared value", lambda m: f"{m.found['low']:.3f} ({m.wanted.low})"),
        ("highest tared value", lambda m: f"{m.found['high']:.3f} ({m.wanted.high})"),
        (
            "largest force [N]",
            lambda m: f"{m.found['max_force_n']:.1f} ({m.wanted.max_force_n})",
        ),
        ("pressed deeper by [mm]", lambda m: f"{m.overtravel_m * 1e3:.1f}"),
        ("conductivity [S/m]", lambda m: f"{m.unit.sigma_s_m:.3f}"),
        ("sides nearer to the core by [mm]", lambda m: f"{m.unit.side_closing_m * 1e3:.2f}"),
        ("squeeze pressure [kPa]", lambda m: f"{m.unit.squeeze_pa * 1e-3:.1f}"),
        ("film at infinite pressure [um]", lambda m: f"{m.unit.floor_m * 1e6:.1f}"),
    ]
    for label, value in rows:
        # Rich takes [N] for a style.
        table.add_row(escape(label), *(value(member) for member in members))
    console.print(table)
