"""Commands ``palpate data``: make data sets of rows, look into any, convert, draw, hand on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from palpate.errors import ConfigError
from palpate.files.hdf5 import schema_of
from palpate.process import typed_command
from palpate_training.cli.experiment import new_table, print_trials, show
from palpate_training.datasets.experiment import MIXED_SCHEMA, MixedDataset
from palpate_training.datasets.export import UNTOUCHED_ROWS, export_csv, export_published, features
from palpate_training.datasets.features import (
    FEATURE_COLUMNS,
    FEATURES_SCHEMA,
    FeatureDataset,
    electrodes_at_ends,
    joined,
    open_dataset,
    write_dataset,
)
from palpate_training.datasets.ingest import (
    BLOCKS_PER_RECORDING,
    ELECTRODE_LAG_ROWS,
    ingest_lasa,
    ingest_record,
)
from palpate_training.datasets.inspect import ExperimentContents, load
from palpate_training.datasets.inspect import contents as experiment_contents
from palpate_training.datasets.join import PressStarts, join_files, press_starts, pressed_alike
from palpate_training.datasets.lerobot import export_lerobot, read_lerobot
from palpate_training.datasets.shrink import SMALL, SmallSize, shrink_file
from palpate_training.datasets.tables import ColumnMap, dataset_of, export_table, read_table
from palpate_training.datasets.trials import TRIALS_SCHEMA

console = Console(markup=False)  # names of sensors and files may have brackets

SENSORS_TOLD = 4
"""Sensors of a data set whose electrodes at an end of the range are told one by one."""

DataArgument = Annotated[
    Path, typer.Argument(help="Data set (.h5), or folder of published files (biotac1.hdf5, ...).")
]
AxesOption = Annotated[
    str, typer.Option(help="Published files: where the sensor frame's x,y,z are in the file.")
]
ForceOption = Annotated[
    bool, typer.Option("--force-on-indenter", help="Published files: the force has that sign.")
]


def data_ingest_lasa(
    source: Annotated[Path, typer.Argument(help="force_calibration.npz")],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    finger: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Which; may be repeated; none = all in the archive."),
    ] = None,
    blocks: Annotated[
        int, typer.Option(min=10, help="Contiguous blocks that each recording is cut into.")
    ] = BLOCKS_PER_RECORDING,
    lag_rows: Annotated[
        int, typer.Option(min=0, help="Rows by which electrodes lag the force; 0 = as stored.")
    ] = ELECTRODE_LAG_ROWS,
    rate_hz: Annotated[
        float | None,
        typer.Option(min=1.0, max=1e4, help="Rows a second; none = 100 are assumed, as LASA has."),
    ] = None,
) -> None:
    """LASA force calibration (real BioTacs) -> data set. Its rows may not be redistributed.

    palpate data ingest-lasa force_calibration.npz lasa.h5
    """
    data = ingest_lasa(
        source,
        fingers=tuple(finger or ()),
        command=typed_command(),
        blocks_per_recording=blocks,
        lag_rows=lag_rows,
        rate_hz=rate_hz,
    )
    write_dataset(out, data)
    console.print(contents(data, str(out)))


def data_ingest_record(
    source: Annotated[Path, typer.Argument(help="Record (.mcap) with electrodes, tare, wrench.")],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="Name of a finger; may be repeated; none = all in the record."),
    ] = None,
    licence: Annotated[
        str, typer.Option(help="What may be done with the rows; kept with them.")
    ] = "own record",
) -> None:
    """Record of a sensor with its force/torque sensor and indenter -> data set.

    palpate data ingest-record presses.mcap presses.h5
    """
    with console.status(Text(f"reading {source.name}")):
        data = ingest_record(source, sensors=sensor or (), command=typed_command(), licence=licence)
        write_dataset(out, data)
    console.print(contents(data, str(out)))


def data_inspect(
    path: DataArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
    axes: AxesOption = "x,y,z",
    force_on_indenter: ForceOption = False,
) -> None:
    """Check a data set and show what is in it.

    palpate data inspect presses.h5
    """
    schema = schema_of(path, extra="training") if path.is_file() else ""
    if schema == TRIALS_SCHEMA.name:
        print_trials(path, as_json=as_json)
        return
    if schema == FEATURES_SCHEMA.name:
        data = open_dataset(path)
        show(as_json, lambda: _features_summary(data), lambda: contents(data, str(path)))
        return
    kind, experiment = load(
        path,
        axes=axes.split(","),
        force_on_indenter=force_on_indenter,
        others=(FEATURES_SCHEMA.name, TRIALS_SCHEMA.name),
    )
    found = experiment_contents(kind, experiment)
    show(as_json, lambda: asdict(found), lambda: experiment_table(found, str(path)))


def data_import(
    source: Annotated[
        Path, typer.Argument(metavar="TABLE", help="CSV, Parquet, or folder of a LeRobotDataset.")
    ],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    columns: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP.toml", help="Which columns are what; none = palpate's own names."
        ),
    ] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Name of the BioTac, if no column says it.")
    ] = None,
    licence: Annotated[
        str | None,
        typer.Option(help="What may be done with the rows; none = as a file of ours says."),
    ] = None,
    drop_incomplete: Annotated[
        bool, typer.Option("--drop-incomplete", help="Leave rows out that lack a number.")
    ] = False,
) -> None:
    """Table with named columns -> data set.

    palpate data import presses.csv presses.h5 --columns map.toml
    """
    told = ColumnMap.read(columns) if columns else None
    table = read_lerobot(source) if source.is_dir() else read_table(source, told)
    data = dataset_of(
        table,
        told or ColumnMap.ours(table.column_names),
        source=source,
        sensor=sensor,
        licence=licence,
        command=typed_command(),
        drop_incomplete=drop_incomplete,
    )
    write_dataset(out, data)
    console.print(contents(data, str(out)))


def data_export(
    path: DataArgument,
    out: Annotated[Path, typer.Argument(help="Folder or file to write; must not exist.")],
    published: Annotated[
        bool, typer.Option("--published", help="Folder with biotac1.hdf5 and so on.")
    ] = False,
    csv: Annotated[bool, typer.Option("--csv", help="One table of text.")] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="One Parquet file.")] = False,
    lerobot: Annotated[bool, typer.Option("--lerobot", help="Folder of a LeRobotDataset.")] = False,
    fps: Annotated[
        float | None,
        typer.Option(min=1e-3, help="--lerobot: rows a second; none = what their times say."),
    ] = None,
    axes: AxesOption = "x,y,z",
    force_on_indenter: ForceOption = False,
) -> None:
    """Data set -> files for others.

    That of an experiment: --published or --csv. Rows of features: --csv, --parquet or --lerobot.

    palpate data export presses.h5 presses.parquet --parquet
    """
    if published + csv + parquet + lerobot != 1:
        raise ConfigError(
            "give one of --published, --csv, --parquet and --lerobot",
            remedy="see palpate data export --help",
        )
    schema = schema_of(path, extra="training") if path.is_file() else ""
    rows = schema == FEATURES_SCHEMA.name
    if published if rows else parquet or lerobot:
        raise ConfigError(
            f"{path} cannot be exported in that form",
            remedy="--published is of experiments; make rows for the other forms first: "
            "palpate data features",
        )
    if not rows:
        _, experiment = load(path, axes=axes.split(","), force_on_indenter=force_on_indenter)
        if csv:
            console.print(f"wrote {out}: {export_csv(out, experiment)} rows")
        else:
            for file in export_published(out, experiment):
                console.print(f"wrote {file}")
        return
    data = open_dataset(path)
    if lerobot:
        console.print(f"wrote {out}: {export_lerobot(out, data, fps=fps)} episodes")
    else:
        export_table(out, data, csv=csv)
        console.print(f"wrote {out}: {len(data)} rows")


def data_features(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATA...", help="Data sets (.h5), or folders of published files; joined."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5).")],
    untouched_rows: Annotated[
        int, typer.Option(min=0, help="Rows at rest added to each trial.")
    ] = UNTOUCHED_ROWS,
    assumed_rest: Annotated[
        int | None,
        typer.Option(min=0, max=4095, help="Rest [counts] of trials whose file has none."),
    ] = None,
    axes: AxesOption = "x,y,z",
    force_on_indenter: ForceOption = False,
) -> None:
    """Data sets of experiments -> rows for `palpate train features`, all in one file.

    palpate data features twin.h5 twin-features.h5
    """
    parts, groups = [], []
    plans: list[PressStarts] = []
    for path in paths:
        _, data = load(path, axes=axes.split(","), force_on_indenter=force_on_indenter)
        experiment = data.experiment if isinstance(data, MixedDataset) else data
        # A plan may have been pressed on specimens whose files are apart.
        called: dict[str, str] = {}
        for joined_as, starts in press_starts(experiment).items():
            plans.append(starts)
            plan = next(n for n, other in enumerate(plans) if pressed_alike(starts, other))
            called |= {f"{joined_as}{name}": f"{plan}/{name}" for name in starts}
        groups.append([called.get(name, name) for name in experiment.trajectories])
        part = features(data, untouched_rows=untouched_rows, assumed_rest=assumed_rest)
        # Published files do not say what made them, so these rows begin here.
        made_by = part.provenance.command or typed_command()
        provenance = replace(part.provenance, command=made_by)
        parts.append(replace(part, name=str(path), provenance=provenance))
    rows = parts[0] if len(parts) == 1 else joined(parts, groups=groups, command=typed_command())
    write_dataset(out, rows)
    console.print(contents(rows, str(out)))


def data_shrink(
    path: Annotated[Path, typer.Argument(metavar="MIXED", help="Mixed data set (.h5).")],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5); must not exist.")],
    trials: Annotated[
        int, typer.Option(min=1, help="Trials to keep, drawn evenly over the indenters.")
    ] = SMALL.trials,
    rows: Annotated[
        int, typer.Option(min=2, help="Rows of each trial, evenly spaced from first to last.")
    ] = SMALL.rows,
    modes: Annotated[
        int, typer.Option(min=1, help="Modes of the displacement: the most important ones.")
    ] = SMALL.modes,
    force_modes: Annotated[
        int, typer.Option(min=1, help="Modes of the contact forces: the most important ones.")
    ] = SMALL.force_modes,
) -> None:
    """Mixed data set -> a small one of the same kind, to carry elsewhere.

    Its losses are relative to the data set given.

    palpate data shrink mixed.h5 small.h5 --trials 5000
    """
    size = SmallSize(trials, rows, modes, force_modes)
    with console.status(Text(f"reading {path.name}")):
        small = shrink_file(path, out, size, command=typed_command())
    _show_written(small, out)


def data_join(
    paths: Annotated[
        list[Path], typer.Argument(metavar="MIXED...", help="Mixed data sets (.h5) of one mesh.")
    ],
    out: Annotated[Path, typer.Argument(help="Data set to write (.h5); must not exist.")],
    modes: Annotated[
        int, typer.Option(min=1, help="Common modes of the displacement, at most.")
    ] = SMALL.modes,
    force_modes: Annotated[
        int, typer.Option(min=1, help="Common modes of the contact forces, at most.")
    ] = SMALL.force_modes,
) -> None:
    """Mixed data sets of several fingertips -> one.

    Shrink large ones first: all fields are compressed anew.

    palpate data join small/fingertip-*.h5 small.h5
    """
    with console.status("compressing fields"):
        joint = join_files(
            paths, out, modes=modes, force_modes=force_modes, command=typed_command()
        )
    _show_written(joint, out)


def _show_written(data: MixedDataset, out: Path) -> None:
    """What a mixed data set that was just written holds, and its size."""
    console.print(experiment_table(experiment_contents(MIXED_SCHEMA.name, data), str(out)))
    console.print(f"{out.stat().st_size / 1e6:.1f} MB")


def experiment_table(found: ExperimentContents, title: str) -> Table:
    """What a data set of the experiment holds, by unit."""
    lines = [
        f"{found.kind}: {found.trajectories} trajectories, {found.trials} trials,"
        f" {found.rows} rows",
        *(f"{key}: {value or '-'}" for key, value in found.provenance.items()),
        f"content sha256: {found.content_sha256}",
    ]
    if found.nodes:
        lines.insert(
            1,
            f"field: {found.nodes} nodes in {found.modes} modes, loss"
            f" {found.field_loss_mean_m * 1e6:.2f} um mean, {found.field_loss_max_m * 1e6:.1f} um"
            f" at most; simulated force differs by {found.force_rms_n:.3g} N rms",
        )
    numbers = ("trials", "indenters", "rows", "tared min", "tared max", "|force| max [N]")
    table = new_table(title, lines, ("unit",), (*numbers, "electrode sd"))
    for unit in found.units:
        table.add_row(
            unit.unit,
            str(unit.trials),
            str(unit.indenters),
            str(unit.rows),
            f"{unit.tared_min:.3f}",
            f"{unit.tared_max:.3f}",
            f"{unit.force_max_n:.2f}",
            f"{min(unit.electrode_sd):.3f}..{max(unit.electrode_sd):.3f}",
        )
    return table


def _features_summary(data: FeatureDataset) -> dict[str, Any]:
    return {
        "kind": FEATURES_SCHEMA.name,
        "rows": len(data),
        "groups": len(np.unique(data.group)),
        "blocks": len(np.unique(data.block)),
        "units": list(data.sensor_names),
        "arrays": {
            name: {
                "type": str(array.dtype),
                "shape": list(array.shape),
                "unit": FEATURE_COLUMNS[name].unit,
            }
            for name, array in data.arrays().items()
        },
        "at_end_of_range": electrodes_at_ends(data),
        "content_sha256": data.content_sha256(),
        "provenance": asdict(data.provenance),
    }


def _told_ends(data: FeatureDataset) -> Iterator[Text]:
    """Electrodes at an end of the converter's range, a line for each of the first sensors."""
    ends = electrodes_at_ends(data)
    for sensor, electrodes in itertools.islice(ends.items(), SENSORS_TOLD):
        told = ", ".join(f"{name} in {rows} rows" for name, rows in electrodes.items())
        yield Text(f"at an end of the converter's range: {sensor}: {told}", "yellow")
    if len(ends) > SENSORS_TOLD:
        yield Text(f"and electrodes of {len(ends) - SENSORS_TOLD} more sensors", "yellow")


def contents(data: FeatureDataset, title: str) -> Table:
    """What a data set holds: arrays, units, ranges, provenance."""
    groups, blocks = len(np.unique(data.group)), len(np.unique(data.block))
    where = data.provenance
    lines: list[str | Text] = [
        f"{len(data)} rows, {groups} groups, {blocks} blocks, sensors"
        f" {', '.join(data.sensor_names)}",
        f"source: {where.source}",
        f"licence: {where.licence}",
        f"made by: {where.command or '-'} (palpate {where.palpate_version})",
        f"notes: {where.notes or '-'}",
        f"content sha256: {data.content_sha256()}",
        *_told_ends(data),
    ]
    columns = ("dataset", "type", "shape", "unit"), ("min", "median", "max")
    table = new_table(title, lines, *columns)
    for name, array in data.arrays().items():
        values = array.astype(np.float64)
        # Where nothing ever touches, no contact location is known.
        known = not np.isnan(values).all()
        told = [f"{value:.6g}" for value in np.nanpercentile(values, [0, 50, 100])] if known else []
        table.add_row(
            name,
            str(array.dtype),
            str(array.shape),
            FEATURE_COLUMNS[name].unit,
            *(told or ("-", "-", "-")),
        )
    return table


PUBLIC_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
"""Real data beside the project; what is absent there is left out of the page."""


def data_figures(
    experiment: Annotated[Path, typer.Argument(help="Experimental data set (.h5).")],
    out: Annotated[Path, typer.Option(help="Folder for statistics.md and its pictures.")],
    mixed: Annotated[
        Path | None, typer.Option(help="Mixed data set (.h5): skin and skin motion.")
    ] = None,
    idle: Annotated[
        Path | None,
        typer.Option(help="Untouched twin (.npz): rate_hz, and counts (T, 19) for each specimen."),
    ] = None,
    public_data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder that holds lasa_force_calibration, lasa_contact_normal."
        ),
    ] = None,
) -> None:
    """Figures as in the paper and the statistics page of a data set of the experiment.

    palpate data figures experiment.h5 --mixed mixed.h5 --out docs/results/twin
    """
    from palpate_training.datasets.experiment import read_experiment, read_mixed
    from palpate_training.figures.noise import read_idle_real, read_idle_twin
    from palpate_training.figures.page import PAGE, PageSources, write_page
    from palpate_training.figures.plate import read_plate_logs

    if public_data is not None and not public_data.is_dir():
        raise ConfigError(
            f"--public-data {public_data}: there is no such folder",
            remedy="give the folder with lasa_force_calibration and lasa_contact_normal",
        )
    folder = public_data or PUBLIC_DATA
    with console.status("reading") as status:
        sources = PageSources(
            experiment=read_experiment(experiment),
            mixed=read_mixed(mixed) if mixed is not None else None,
            idle=(
                *(read_idle_twin(idle) if idle is not None else ()),
                *read_idle_real(folder),
            ),
            plate=read_plate_logs(folder),
        )
        statistics = write_page(
            out,
            sources,
            command=typed_command(),
            on_step=lambda step: status.update(f"{step} ..."),
        )
    console.print(
        f"{statistics.trajectories} unique trajectories, {statistics.trials} trials,"
        f" {statistics.rows} rows\nwrote {out / PAGE}"
    )
