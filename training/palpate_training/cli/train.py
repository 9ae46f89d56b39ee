"""Commands ``palpate train``: bundles of every task, and the tables of results."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate.files.bundle import read_bundle, read_manifest
from palpate.files.card import model_card
from palpate.process import told_in_log, typed_command
from palpate_training.cli.data import AxesOption, ForceOption
from palpate_training.datasets.features import open_dataset

Mixed = Annotated[Path, typer.Argument(help="Mixed data set (.h5).")]
Bundle = Annotated[Path, typer.Argument(help="Folder of the bundle; must not exist.")]
Version = Annotated[
    int | None,
    typer.Option(min=1, help="Version of the bundle; none = the folder's name, if a number, or 1."),
]
Epochs = Annotated[int, typer.Option(min=1, help="Passes over the rows at most, each network.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of split and weights.")]

Serials = Annotated[
    list[str] | None,
    typer.Option(
        "--serial",
        help="Serial number of a sensor that the bundle is made for; one that ends in * stands for "
        "all that begin so; may be repeated. Estimates of other sensors are flagged UNCALIBRATED.",
    ),
]
GainSpread = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1.0,
        help="Spread of the random gains that electrodes get in training, which stand for other "
        "fingers; 0 for a network that will only read the fingers it is trained on.",
    ),
]

Width = Annotated[int, typer.Option(min=1, help="Of the residual layers.")]

BlockCount = Annotated[int, typer.Option(min=1, help="Residual blocks of two layers.")]

Device = Annotated[
    str, typer.Option(help="Where it is trained: cpu, cuda, or auto = on a GPU if there is one.")
]
BatchRows = Annotated[
    int, typer.Option(min=1, help="Rows in one step; more for more rows, and on a GPU.")
]

EPOCHS = 80
BATCH_ROWS = 256
WIDTH, BLOCKS = 256, 3
GAIN_SPREAD = 0.1
"""The defaults of ``MembersConfig``, whose module needs torch."""

console = Console(markup=False)  # names of sensors and files may have brackets


def train_field(
    data: Mixed,
    out: Bundle,
    units: Annotated[
        str, typer.Option(help="Specimens to train on, with commas between; empty = all.")
    ] = "",
    name: Annotated[str, typer.Option(help="Name of the bundle.")] = "field",
    version: Version = None,
    seed: Seed = 0,
    epochs: Epochs = EPOCHS,
    gain_spread: GainSpread = GAIN_SPREAD,
    serials: Serials = None,
    device: Device = "auto",
    batch_rows: BatchRows = BATCH_ROWS,
) -> None:
    """Electrodes -> displacement of the whole skin: train, test on unseen trajectories, write.

    palpate train field mixed.h5 models/field-twin/1 --name field-twin
    """
    from palpate_training.tasks.fields import field_bundle

    version = _version(version, out)
    chosen = tuple(unit.strip() for unit in units.split(",") if unit.strip())
    metrics = _bundle(
        field_bundle,
        "field",
        data,
        out,
        epochs,
        batch_rows,
        device=device,
        gain_spread=gain_spread,
        units=chosen,
        name=name,
        version=version,
        seed=seed,
        serials=serials or (),
    )
    _show(metrics, f"{name} {version}: unseen trajectories", out)


def train_synthesis(
    data: Mixed,
    out: Bundle,
    unit: Annotated[str, typer.Option(help="The specimen whose electrodes are synthesised.")],
    name: Annotated[str, typer.Option(help="Name of the bundle.")] = "synthesis",
    version: Version = None,
    seed: Seed = 0,
    epochs: Epochs = EPOCHS,
    device: Device = "auto",
    batch_rows: BatchRows = BATCH_ROWS,
) -> None:
    """Displacement of the skin -> electrodes of one unit: train, test on unseen, write.

    palpate train synthesis mixed.h5 models/synthesis-twin/1 --unit biotac-2 --name synthesis-twin
    """
    from palpate_training.tasks.synthesis import synthesis_bundle

    version = _version(version, out)
    metrics = _bundle(
        synthesis_bundle, "synthesis", data, out, epochs, batch_rows,
        device=device, unit=unit, name=name, version=version, seed=seed,
    )  # fmt: skip
    _show(metrics, f"{name} {version}, {unit}: unseen trajectories", out)


def train_all(
    data: Annotated[
        Path,
        typer.Argument(help="Mixed data set (.h5), or folder of published files (biotac1.hdf5)."),
    ],
    out: Annotated[Path, typer.Argument(help="Folder of the bundles, and of cards.md.")],
    unit: Annotated[
        str, typer.Option(help="Specimen whose electrodes are synthesised; empty = the first.")
    ] = "",
    name: Annotated[str, typer.Option(help="Bundles are called features-NAME, ...")] = "twin",
    version: Annotated[int, typer.Option(min=1, help="Version of the bundles.")] = 1,
    seed: Seed = 0,
    epochs: Epochs = EPOCHS,
    gain_spread: GainSpread = GAIN_SPREAD,
    assumed_rest: Annotated[
        int | None,
        typer.Option(min=0, max=4095, help="Rest [counts] of trials whose file has none."),
    ] = None,
    serials: Serials = None,
    device: Device = "auto",
    batch_rows: BatchRows = BATCH_ROWS,
    axes: AxesOption = "x,y,z",
    force_on_indenter: ForceOption = False,
) -> None:
    """Bundles of all tasks from one data set: features, field, synthesis, and their model cards.

    palpate train all runs/rest/mixed.h5 models --unit biotac-2 --version 6 --serial 'VIRTUAL-*'
    """
    from palpate_training.datasets.experiment import MixedDataset
    from palpate_training.datasets.export import features
    from palpate_training.datasets.features import write_dataset
    from palpate_training.datasets.inspect import load
    from palpate_training.learning.export import refuse_existing
    from palpate_training.learning.splits import by_trajectory, of_units

    _, experiment = load(data, axes=axes.split(","), force_on_indenter=force_on_indenter)
    tasks = (
        ("features", "field", "synthesis")
        if isinstance(experiment, MixedDataset)
        else ("features",)
    )
    folders = {task: out / f"{task}-{name}" / str(version) for task in tasks}
    for folder in folders.values():
        refuse_existing(folder)
    if isinstance(experiment, MixedDataset):
        chosen = unit or experiment.experiment.unit_names[0]
        # The last training would refuse an unknown one, hours later.
        of_units(experiment.experiment, by_trajectory(experiment.experiment, seed=seed), [chosen])
    with tempfile.TemporaryDirectory() as scratch:
        rows = Path(scratch) / "features.h5"
        write_dataset(rows, features(experiment, assumed_rest=assumed_rest))
        train_features_command(
            rows,
            folders["features"],
            f"features-{name}",
            version,
            seed,
            epochs,
            gain_spread,
            serials,
            device,
            batch_rows,
        )
    if isinstance(experiment, MixedDataset):
        train_field(
            data,
            folders["field"],
            "",
            f"field-{name}",
            version,
            seed,
            epochs,
            gain_spread,
            serials,
            device,
            batch_rows,
        )
        synthesis = f"synthesis-{name}"
        train_synthesis(
            data,
            folders["synthesis"],
            chosen,
            synthesis,
            version,
            seed,
            epochs,
            device,
            batch_rows,
        )
    else:
        console.print("no field and no synthesis: the data set has no displacements")
    cards = [read_bundle(folder) for folder in folders.values()]
    with written_whole(out / "cards.md") as part:
        part.write_text("\n".join(model_card(one.manifest, one.sha256) for one in cards), "utf-8")
    console.print(f"wrote {out / 'cards.md'}")


def train_force_real(
    data: Annotated[Path, typer.Option(help="Data set from `palpate data ingest-lasa`.")],
    out: Annotated[Path, typer.Option(help="Folder for force-real.md, .json and .png.")],
    seeds: Annotated[int, typer.Option(min=1, help="Networks for each fold.")] = 5,
) -> None:
    """Force on real BioTacs: blocks held out and a BioTac never seen, beside the baselines.

    palpate train force-real --data lasa.h5 --out docs/results
    """
    from palpate.files.outputs import check_folder
    from palpate_training.tasks.force_real import experiment_count, run_force_real, write_report
    from palpate_training.tasks.results import rich_table

    dataset = open_dataset(data)
    check_folder(out, "--out")
    with _progress() as progress:
        task = progress.add_task("networks", total=experiment_count(dataset, seeds))
        report = run_force_real(dataset, seeds=seeds, on_network=lambda: progress.advance(task))
    write_report(out, report, command=typed_command())
    console.print(rich_table(report.results, "Force on real BioTacs"))
    console.print(f"wrote {out}/force-real.md, .json, .png")


def train_transfer(
    train: Annotated[
        list[Path], typer.Option(help="Data set (.h5) of other fingers; may be repeated.")
    ],
    test: Annotated[
        Path,
        typer.Option(
            help="Data set (.h5) of the finger that is tested; of several, each is, and the JSON's "
            "first figures are those of the one with the largest median error: worst_finger."
        ),
    ],
    shots: Annotated[int, typer.Option(min=0, help="Its presses with known forces.")] = 0,
    unlabelled: Annotated[
        bool | None,
        typer.Option(
            "--unlabelled/--tare-only",
            help="Whether mean and spread of its electrodes over the whole recording may be used; "
            "not given: only with shots.",
        ),
    ] = None,
    draws: Annotated[
        int, typer.Option(min=1, help="How often the presses are drawn; results are means.")
    ] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    twin: Annotated[
        bool, typer.Option(help="Whether a line through the twin's presses is the prior.")
    ] = True,
    line: Annotated[
        Path | None,
        typer.Option(
            help="Line of `palpate train line` to take as the prior; none = the one that ships."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """Force on a finger that training has not met, and after a few presses of it.

    palpate train transfer --train one.h5 --test two.h5 --shots 5
    """
    from palpate_training.evaluation.transfer import (
        FIGURES,
        as_dict,
        fingers_of,
        remarks,
        run_transfer,
        steps_of,
    )
    from palpate_training.learning.twin_line import read_line

    if line is not None and not twin:
        raise ConfigError(
            "--line names a prior, --no-twin is for none", remedy="leave one of them out"
        )
    prior = read_line(line) if twin else None
    known = [finger for path in train for finger in fingers_of(open_dataset(path))]
    tested = fingers_of(open_dataset(test))
    with _progress(Console(stderr=True)) as progress:
        steps = len(tested) * steps_of(len(known), shots=shots, draws=draws)
        bar = progress.add_task("transfer", total=steps)
        results = [
            run_transfer(
                known,
                finger,
                shots=shots,
                unlabelled=shots > 0 if unlabelled is None else unlabelled,
                draws=draws,
                seed=seed,
                line=prior,
                on_step=lambda: progress.advance(bar),
            )
            for finger in tested
        ]
    if as_json:
        console.print_json(data=as_dict(results), allow_nan=False)
        return
    for result in results:
        names = ", ".join(result["train"])
        table = Table(title=f"{result['test']}, from {names}, with {shots} labelled presses")
        for column in ("", "magnitude, median [N]", "95 % below [N]", "angle, median [rad]"):
            table.add_column(column, justify="right" if column else "left")
        rows = {"palpate": result, "ridge": result["ridge"], "constant": result["constant"]}
        for name, one in rows.items():
            table.add_row(name, *(f"{one[figure]:.3f}" for figure in FIGURES))
        console.print(table)
        console.print(
            f"90 % intervals: half width {result['interval_median_n']:.2f} N,"
            f" hold {100 * result['coverage_90']:.0f} % of the true magnitudes"
        )
        for remark in remarks(result):
            console.print(remark)


def train_features_command(
    data: Annotated[Path, typer.Option(help="Data set (.h5).")],
    out: Annotated[Path, typer.Option(help="Folder of the bundle; must not exist.")],
    name: Annotated[str, typer.Option(help="Name of the bundle.")] = "features",
    version: Version = None,
    seed: Seed = 0,
    epochs: Epochs = EPOCHS,
    gain_spread: GainSpread = GAIN_SPREAD,
    serials: Serials = None,
    device: Device = "auto",
    batch_rows: BatchRows = BATCH_ROWS,
    width: Width = WIDTH,
    blocks: BlockCount = BLOCKS,
) -> None:
    """Train force and contact location, test on unseen presses, write the bundle.

    palpate train features --data presses.h5 --out models/features-virtual/1 --name features-virtual
    """
    from palpate_training.tasks.features import FEATURES_CONFIG, train_features
    from palpate_training.tasks.intervals import PRESSES_LEAST

    version = _version(version, out)
    with _progress() as progress:
        tasks = {}

        def on_epoch(quantity: str, done: int, total: int) -> None:
            if quantity not in tasks:
                _finish(progress)
                tasks[quantity] = progress.add_task(quantity, total=total)
            progress.update(tasks[quantity], completed=done)

        report = train_features(
            data,
            out,
            name=name,
            version=version,
            config=replace(
                FEATURES_CONFIG,
                epochs=epochs,
                gain_spread=gain_spread,
                batch_rows=batch_rows,
                width=width,
                blocks=blocks,
            ),
            seed=seed,
            serials=serials or (),
            device=device,
            on_epoch=on_epoch,
        )
        _finish(progress)
    _show(report.metrics, f"{name} {version}: unseen presses", out)
    if report.bound_presses < PRESSES_LEAST:
        console.print(
            f"The bounds of its errors are of {report.bound_presses} tested presses, too few to be"
            f" relied on: {PRESSES_LEAST} are needed. palpate train intervals takes presses that no"
            " training has seen.",
            markup=False,
        )


def train_population_command(
    data: Annotated[
        Path, typer.Argument(metavar="FEATURES.h5", help="Rows of a population of specimens.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="For population.npz, .json and .onnx.")
    ],
    device: Device = "auto",
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of split and weights; none = 0, or as it was trained."),
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the rows at most.")] = 60,
    batch_rows: Annotated[int, typer.Option(min=1, help="Rows in one step.")] = 4096,
    width: Width = WIDTH,
    blocks: BlockCount = BLOCKS,
    common: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Share of the electrodes' common mode that it reads."),
    ] = 1.0,
    common_sd: Annotated[
        float, typer.Option(min=0.0, help="Random offset of all electrodes in training [log Ohm].")
    ] = 0.03,
    gain_spread: GainSpread = 0.03,
    stiffness_sd: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Random factor of a specimen's forces in training, which its presses tell [log].",
        ),
    ] = 0.3,
    measure: Annotated[
        bool, typer.Option("--measure", help="Measure the network in FOLDER again; do not train.")
    ] = False,
) -> None:
    """One network for a population, told a specimen by presses of it.

    It is tested on specimens and presses that it has not met.

    palpate train population features.h5 runs/population --device cuda
    """
    from palpate_training.learning.population_net import PopulationConfig
    from palpate_training.tasks.population import train_population

    config = PopulationConfig(
        epochs=epochs, batch_rows=batch_rows, width=width, blocks=blocks,
        common=common, common_sd=common_sd, gain_sd=gain_spread, stiffness_sd=stiffness_sd,
    )  # fmt: skip
    with _progress() as progress:
        bar = progress.add_task("measured" if measure else "population", total=epochs)
        _, facts = train_population(
            data, out, config=config, device=device, seed=seed, measure=measure,
            on_epoch=lambda: progress.advance(bar),
        )  # fmt: skip
    for name, cell in facts["cells"].items():
        rivals = [key for key, value in cell.items() if isinstance(value, dict) and key != "shots"]
        table = Table("", *rivals, title=f"{name.replace('_', ' ')}: {cell['presses']} presses")
        for key in cell["constant"]:
            table.add_row(key, *(f"{cell[rival].get(key, float('nan')):.3f}" for rival in rivals))
        console.print(table)
        shots = {key: one["network"] for key, one in cell.get("shots", {}).items() if key.isdigit()}
        if shots:
            table = Table("", *(f"{key} presses" for key in shots), title="the same, presses known")
            for key in shots["0"]:
                if key != "ci95":
                    table.add_row(key, *(f"{one[key]:.3f}" for one in shots.values()))
            for name in cell["shots"]["0"].get("bounds", ()):
                held = (cell["shots"][key]["bounds"][name]["held"] for key in shots)
                table.add_row(f"bound of {name} holds", *(f"{100 * one:.1f} %" for one in held))
            console.print(table)
    console.print(f"wrote {out}")


def train_line(
    data: Annotated[
        Path, typer.Argument(metavar="FEATURES.h5", help="Rows of a population of specimens.")
    ],
    out: Annotated[Path, typer.Argument(metavar="LINE.json", help="File to write.")],
) -> None:
    """A line through a population's presses, for `palpate train transfer --line`.

    palpate train line features.h5 twin-line.json
    """
    from palpate_training.learning.twin_line import check_place, fit_line, write_line

    check_place(out)
    write_line(out, fit_line(open_dataset(data)))
    console.print(f"wrote {out}")


def train_upgrade(
    bundle: Annotated[Path, typer.Argument(help="Folder of the older bundle.")],
    data: Annotated[Path, typer.Argument(help="Data set (.h5) like the one it was trained on.")],
    out: Bundle,
    units: Annotated[
        str, typer.Option(help="Specimens it was trained on, with commas between; empty = all.")
    ] = "",
) -> None:
    """An older bundle with what newer ones say: what it was trained on; a field's coefficients.

    palpate train upgrade models/features-twin/1 features.h5 models/features-twin/2
    """
    from palpate_training.tasks.upgrade import upgrade_bundle

    chosen = tuple(unit.strip() for unit in units.split(",") if unit.strip())
    digest = upgrade_bundle(bundle, data, out, units=chosen)
    console.print(f"wrote {out}, digest {digest.hex()}")
    manifest = read_manifest(out)
    known = manifest.training_range
    if known is not None and known.data_sha256 != manifest.training_data_sha256:
        console.print(
            f"its range is of {data}, which is not what it was trained on: palpate train intervals"
            " cannot tell presses that its training saw, so hold out those that it did not",
        )


def train_location(
    bundle: Annotated[Path, typer.Argument(help="Folder of a features bundle.")],
    out: Bundle,
    exact: Annotated[
        list[Path],
        typer.Option(
            help="Presses (.h5) whose locations are exact, and that no training has seen; "
            "repeatable.",
            show_default=False,
        ),
    ],
    seed: Seed = 0,
) -> None:
    """Free a bundle's contact location of the registration errors of its training's robots.

    palpate train location models/features-twin/12 new/features --exact runs/e1/mixed.h5
    """
    from palpate_training.tasks.location import correct_location

    report = correct_location(bundle, exact, out, seed=seed)
    console.print(
        f"location on presses that nothing was learned from: {report.after_m * 1e3:.3f} mm"
        f" (median), before {report.before_m * 1e3:.3f} mm",
    )
    console.print(f"wrote {out}, digest {report.digest.hex()}")


def train_intervals(
    bundle: Annotated[Path, typer.Argument(help="Folder of a features or field bundle.")],
    out: Bundle,
    held_out: Annotated[
        list[Path],
        typer.Option(
            help="Presses (.h5) that no training has seen, features or mixed; repeatable.",
            show_default=False,
        ),
    ],
    other: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recording (.h5) of a sensor that the bundle was not made for; repeatable.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """A bundle with bounds of its errors, from presses held out; weights and answers stay.

    palpate train intervals models/features-twin/7 models/features-twin/8 --held-out mixed.h5
    """
    from palpate_training.tasks.intervals import add_intervals

    digest = add_intervals(bundle, held_out, out, others=other or ())
    console.print(f"wrote {out}, digest {digest.hex()}")


def _version(given: int | None, out: Path) -> int:
    """Of a bundle in a folder, unless it is given."""
    from palpate_training.learning.export import version_of

    return version_of(out, 1) if given is None else given


def _bundle(
    train: Callable[..., dict[str, float]],
    task: str,
    data: Path,
    out: Path,
    epochs: int,
    batch_rows: int,
    *,
    gain_spread: float = GAIN_SPREAD,
    **options: Any,
) -> dict[str, float]:
    """Train a field or synthesis bundle; its held-out metrics."""
    from palpate_training.datasets.experiment import read_mixed
    from palpate_training.tasks.fields import FieldFitConfig

    with _progress() as progress:
        config = FieldFitConfig(epochs=epochs, gain_spread=gain_spread, batch_rows=batch_rows)
        bar = progress.add_task(task, total=epochs * config.members)
        return train(
            read_mixed(data), out, config=config, on_epoch=lambda: progress.advance(bar), **options
        )


@contextmanager
def _progress(to: Console = console) -> Iterator[Progress]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    progress = Progress(*columns, TimeElapsedColumn(), console=to)
    with progress, told_in_log(progress):
        yield progress


def _finish(progress: Progress) -> None:
    """Fill the bars: a network that learns nothing more ends before its last epoch."""
    for task in progress.tasks:
        progress.update(task.id, total=task.completed)


def _show(metrics: dict[str, float], title: str, out: Path) -> None:
    table = Table(title=title, caption=f"wrote {out}")
    table.add_column("metric")
    table.add_column("value", justify="right")
    for key, value in metrics.items():
        table.add_row(key, f"{value:.5g}")
    console.print(table)
