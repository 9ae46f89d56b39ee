"""Commands of a real experiment: ``palpate data register`` and ``palpate data ingest``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from palpate import __version__
from palpate.errors import ConfigError
from palpate.process import typed_command
from palpate.rigid import Transform
from palpate_training.datasets.container import Provenance, csv_rows, sha256_of
from palpate_training.datasets.trials import TrialsContents, read_contents, write_trials
from palpate_training.experiment.kinematics import ArmKinematics
from palpate_training.experiment.plan import ARMS

console = Console(markup=False)  # names of sensors and files may have brackets

TIMES_COLUMNS = ["trajectory", "start_wall_ns"]
"""Header of the CSV file of ``--starts``."""

UrdfOption = Annotated[
    list[str] | None,
    typer.Option("--urdf", metavar="ARM=FILE", help="URDF of the left or right arm; repeatable."),
]
TipFrameOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="Frame of the URDF that carries the tool.")
]
ToolOption = Annotated[
    float, typer.Option("--tool-mm", help="From that frame along its z to the tip [mm].")
]


def new_table(
    title: str, caption: Sequence[str | Text], words: Sequence[str], numbers: Sequence[str]
) -> Table:
    """A table with columns of words, then columns of numbers, and lines below it."""
    lines = (line if isinstance(line, Text) else Text(line) for line in caption)
    below = Text("\n", "table.caption").join(lines)
    table = Table(title=title, caption=below, caption_justify="left")
    for heading in (*words, *numbers):
        table.add_column(heading, justify="right" if heading in numbers else "left")
    return table


def show(as_json: bool, summary: Callable[[], object], table: Callable[[], Table]) -> None:
    """Print a table for people, or the same as JSON."""
    if as_json:
        console.print_json(json.dumps(summary()))
    else:
        console.print(table())


def data_register(
    holes: Annotated[
        Path,
        typer.Argument(
            metavar="HOLES.csv",
            help="Columns arm, hole, robot_x_m.. (pin by the robot), sensor_x_m.. (drawing).",
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT.json", help="To write.")],
) -> None:
    """Measured holes of the plate -> where each arm stands, for `palpate data plan`.

    palpate data register holes.csv registration.json
    """
    from palpate_training.experiment.registration import read_holes, register, write_registrations

    found = {}
    for arm, measured in read_holes(holes).items():
        try:
            found[arm] = register(measured.robot, measured.sensor, names=measured.names)
        except ConfigError as error:
            raise ConfigError(
                f"{holes}: {arm} arm: {error.problem}", remedy=error.remedy
            ) from error
    write_registrations(out, found)
    table = new_table(str(holes), [f"wrote {out}"], ("arm", "hole"), ("residual [mm]",))
    for arm, item in found.items():
        for hole, residual in zip(item.holes, item.residual_m, strict=True):
            table.add_row(arm, hole, f"{residual * 1e3:.3f}")
    console.print(table)


def data_ingest(
    record: Annotated[Path, typer.Argument(metavar="RECORD.mcap", help="What was recorded.")],
    plan: Annotated[Path, typer.Argument(metavar="PLAN.jsonl", help="What was executed.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.h5", help="Trials to write.")],
    unit: Annotated[str, typer.Option(help="Name of the specimen, e.g. biotac-1.")],
    sensor: Annotated[str, typer.Option(help="Name of the sensor in the record.")],
    start_wall_ns: Annotated[
        int | None, typer.Option(help="Wall clock when the plan started [ns since 1970].")
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="TIME", help="The same as ISO 8601 with its zone.")
    ] = None,
    starts: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Instead: trajectory,start_wall_ns for each that was executed.",
        ),
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ARM=LOG.csv", help="An arm's joint angles instead of poses; repeatable."
        ),
    ] = None,
    urdf: UrdfOption = None,
    tip_frame: TipFrameOption = None,
    tool_mm: ToolOption = 0.0,
    licence: Annotated[
        str, typer.Option(help="What may be done with the trials; kept with them.")
    ] = "own record",
) -> None:
    """Record of an executed plan -> raw trials, for `palpate data process`.

    palpate data ingest r.mcap plan.jsonl t.h5 --unit biotac-1 --sensor finger --start-wall-ns 17
    """
    from palpate_training.experiment.executed_plan import JointLog, ingest_experiment

    when = _when(start_wall_ns, start, starts)
    logs = by_arm(joints or (), "--joints")
    arms = arms_of(by_arm(urdf or (), "--urdf"), tip_frame, tool_mm * 1e-3)
    if logs.keys() != arms.keys():
        raise ConfigError(
            f"--joints for {_named(logs)}, --urdf for {_named(arms)}",
            remedy="give a joint log and a URDF for the same arms",
        )
    with console.status(Text(f"reading {record.name}")):
        trials = ingest_experiment(
            record,
            plan,
            unit=unit,
            sensor=sensor,
            start_wall_ns=when,
            joint_logs={arm: JointLog(path, arms[arm]) for arm, path in logs.items()} or None,
        )
        write_trials(
            out,
            trials,
            Provenance(
                source=f"record {record.name} of {sensor}, plan {plan.name}",
                command=typed_command(),
                input_sha256=sha256_of(record),
                licence=licence,
                palpate_version=__version__,
                notes=f"input_sha256 is of the record; sha256 of the plan: {sha256_of(plan)}",
            ),
        )
    console.print(trials_table(read_contents(out), str(out)))


def by_arm(words: Sequence[str], flag: str) -> dict[str, Path]:
    """Files by arm, from words such as ``left=FILE``.

    Raises:
        ConfigError: A word is no such pair, names another arm, or an arm comes twice.
    """
    found: dict[str, Path] = {}
    for word in words:
        arm, given, file = word.partition("=")
        if arm not in ARMS or not given or not file:
            raise ConfigError(f"{flag} {word}", remedy=f"write {flag} left=FILE or right=FILE")
        if arm in found:
            raise ConfigError(f"{flag}: the {arm} arm comes twice", remedy="give each arm one file")
        found[arm] = Path(file)
    return found


def arms_of(
    urdf: Mapping[str, Path], tip_frame: str | None, tool_m: float
) -> dict[str, ArmKinematics]:
    """Kinematics of arms with their tool.

    Args:
        urdf: A URDF by arm; may be empty.
        tip_frame: Link or joint that carries the tool.
        tool_m: From there to the tip along that frame's z [m].

    Raises:
        ConfigError: No frame is named, or a URDF cannot be used.
    """
    if urdf and tip_frame is None:
        raise ConfigError(
            "--urdf without --tip-frame", remedy="name the frame of the URDF that carries the tool"
        )
    tool = Transform(np.eye(3), np.array([0.0, 0.0, tool_m]))
    return {arm: ArmKinematics.from_urdf(path, tip_frame or "", tool) for arm, path in urdf.items()}


def trials_table(found: TrialsContents, title: str) -> Table:
    """What a file of raw trials holds, trial by trial."""
    lines = [
        f"palpate.trials: {len(found.headers)} trials, {sum(found.samples)} samples",
        *(f"{key}: {value or '-'}" for key, value in asdict(found.provenance).items()),
        f"content sha256: {found.content_sha256}",
    ]
    table = new_table(title, lines, ("unit", "trajectory", "indenter", "arm"), ("samples",))
    for header, samples in zip(found.headers, found.samples, strict=True):
        table.add_row(header.unit, header.trajectory, header.indenter, header.arm, str(samples))
    return table


def trials_summary(found: TrialsContents) -> dict[str, Any]:
    """The same as plain values, for JSON."""
    return {
        "kind": "palpate.trials",
        "trials": [
            {**asdict(header), "samples": samples}
            for header, samples in zip(found.headers, found.samples, strict=True)
        ],
        "content_sha256": found.content_sha256,
        "provenance": asdict(found.provenance),
    }


def print_trials(path: Path, *, as_json: bool) -> None:
    """Show a file of raw trials, after reading all of it.

    Raises:
        DatasetError: It is damaged.
    """
    from palpate_training.datasets.trials import read_trials

    for _ in read_trials(path):  # checks every stream
        pass
    found = read_contents(path)
    show(as_json, lambda: trials_summary(found), lambda: trials_table(found, str(path)))


def _when(
    start_wall_ns: int | None, start: str | None, starts: Path | None
) -> int | Mapping[str, int]:
    """When the plan, or each of its trajectories, started [ns since 1970]."""
    given = [value for value in (start_wall_ns, start, starts) if value is not None]
    if len(given) != 1:
        raise ConfigError(
            f"{len(given)} of --start-wall-ns, --start and --starts are given",
            remedy="give exactly one of them",
        )
    if start_wall_ns is not None:
        return start_wall_ns
    return _instant(start) if start is not None else _times(starts or Path())


def _instant(word: str) -> int:
    try:
        found = datetime.fromisoformat(word)
    except ValueError as error:
        raise ConfigError(
            f"--start {word}: {error}", remedy="write e.g. 2026-03-01T14:05:00.25+01:00"
        ) from error
    if found.tzinfo is None:
        raise ConfigError(
            f"--start {word} has no time zone", remedy="add it: Z, or an offset such as +01:00"
        )
    # whole numbers: a float holds no nanoseconds of our days
    return (found - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def _times(path: Path) -> dict[str, int]:
    rows = [row for row in csv_rows(path, ConfigError) if row]
    if not rows or rows[0] != TIMES_COLUMNS:
        raise ConfigError(
            f"{path}: columns {', '.join(rows[0]) if rows else 'none'}",
            remedy=f"write the header {','.join(TIMES_COLUMNS)}, and a line for each trajectory",
        )
    found: dict[str, int] = {}
    for number, row in enumerate(rows[1:], 2):
        try:
            trajectory, time_ns = row[0], int(row[1])
        except (ValueError, IndexError) as error:
            raise ConfigError(
                f"{path}, line {number}: {error}", remedy="write a trajectory and whole nanoseconds"
            ) from error
        if trajectory in found:
            raise ConfigError(
                f"{path}, line {number}: {trajectory!r} comes twice",
                remedy="leave out the run that does not count",
            )
        found[trajectory] = time_ns
    return found


def _named(arms: Mapping[str, object]) -> str:
    return " and ".join(sorted(arms)) or "none"
