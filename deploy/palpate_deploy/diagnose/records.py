"""Records and stores of simulations: ``palpate record``, ``info``, ``review`` and ``recover``."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import threading
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from palpate.bus import Session
from palpate.bus.query import LONGEST_S
from palpate.bus.topics import parse_key
from palpate.config import LinkConfig, check_duration, parse_config
from palpate.errors import ConfigError, LinkError, RecordingError, printable
from palpate.files.outputs import check_output
from palpate.files.record import RecordSummary, check_readable, recover, summarise
from palpate.health import Health
from palpate.process import stop_on_signals
from palpate_deploy.station.host import check_room
from palpate_deploy.station.logs import cell
from palpate_deploy.station.status import duration_text

if TYPE_CHECKING:  # palpate info and record do not need what draws
    from palpate_services.viewer.touch_errors import RecordErrors

_LOSSES = ("overflow", "lost_at_stop", "lost_disk_full")
"""Counters of a recorder: messages that came faster than they were written, and so on."""


def viewer_command(view: Path) -> str:
    """``rerun FILE``, with the folder of ``rerun`` where it is not on the path."""
    rerun = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") is None and rerun.exists():
        near = os.path.relpath(rerun)
        program = str(rerun) if near.startswith("..") else near
        return shlex.join((program, str(view)))
    return shlex.join(("rerun", str(view)))


def record_station(
    link: LinkConfig, station: str, settings: Mapping[str, Any], *, duration_s: float
) -> None:
    """Record until ``duration_s`` have passed (0 = Ctrl-C), then print what was recorded.

    Raises:
        LinkError: There is no router, or nothing came of the station or of the sensor that is
            named; the record is there, though.
        ConfigError: An unknown topic, or no duration.
        RecordingError: The disk has no room or the folder cannot be made; a record was removed or
            moved meanwhile; or messages are not in it, whether they had arrived or not.
    """
    from palpate_services.config import EVERYTHING, RecorderConfig

    if duration_s:
        check_duration(duration_s, "--duration-s", most=LONGEST_S)
    from palpate_services.recorder.service import SERVICE, run_recorder
    from palpate_services.recorder.writer import RECOVERED, leftovers

    config = parse_config(RecorderConfig, {**EVERYTHING, **settings}, where="command line")
    check_room(config.out, config.min_free_bytes)
    Session.open(link, station=station).close()  # raises at once if there is no router
    stop = stop_on_signals()
    if duration_s:
        timer = threading.Timer(duration_s, stop.set)
        timer.daemon = True
        timer.start()
    until = f"for {duration_s:g} s" if duration_s else "until Ctrl-C"
    print(f"recording station {station} to {config.out}/ {until}", flush=True)
    instance = f"record-{os.getpid()}"
    own = f"{SERVICE}/{instance}"
    health = Health(SERVICE, instance)
    # Who waits for an end of his own choosing gets all; after a signal there is little time.
    opened = run_recorder(
        config, link, station, stop, instance=instance, health=health, write_all=duration_s > 0
    )
    # One that the disk cut off may have been recovered.
    written = [one for path in opened for one in (path, path.with_suffix(RECOVERED))]
    summaries = [print_contents(path) for path in written if path.exists()]
    for part in leftovers(config.out):  # the disk refused its end, and no later one recovered it
        command = shlex.join(("palpate", "recover", str(part)))
        print(f"{printable(str(part))} is cut off; its whole messages: {printable(command)}")
    keys = [parse_key(key) for summary in summaries for key in summary.counts]
    if health.counters.get("records_gone"):
        raise RecordingError(
            "the record is not whole: its file was removed or moved while it was written, "
            f"{health.counters.get('lost_with_record', 0):,} messages are lost",
            remedy="record again, and leave the folder alone until it ends",
        )
    if lost := {name: n for name in _LOSSES if (n := health.counters.get(name))}:
        raise RecordingError(
            f"the record is not whole: {sum(lost.values()):,} messages that had arrived are not "
            f"in it ({', '.join(lost)})",
            remedy=(
                "free some space, or record to a folder on another disk: --out"
                if "lost_disk_full" in lost
                else "relieve disk and host; record fewer topics: --topic; or no view: --no-rrd"
            ),
        )
    if missing := sum(sum(summary.lost.values()) for summary in summaries):
        raise RecordingError(
            f"the record is not whole: {missing:,} messages that were published never came to it "
            "(column lost)",
            remedy="relieve host and network, and see that nothing stops this command meanwhile; "
            "then record again",
        )
    if config.sensor != "*" and not any(key.sensor == config.sensor for key in keys):
        raise LinkError(
            f"nothing came of sensor {config.sensor!r}",
            remedy="see which sensors there are: palpate status",
        )
    if all(key.sensor == own for key in keys):  # its status
        raise LinkError(
            f"nothing came of station {station!r}", remedy="see what runs: palpate status"
        )


def show_info(path: Path, *, as_json: bool) -> None:
    """Print the contents of a record.

    Raises:
        RecordingError: It is damaged or not palpate's.
    """
    if not as_json:
        print_contents(path)
        return
    summary = _summary(path)
    print(
        json.dumps(
            {
                "file": str(path),
                "bytes": path.stat().st_size,
                "complete": summary.complete,
                "start_wall_ns": summary.start_wall_ns,
                "end_wall_ns": summary.end_wall_ns,
                "counts": dict(summary.counts),
                "durations_s": dict(summary.durations_s),
                "rates_hz": dict(summary.rates_hz),
                "lost": dict(summary.lost),
                "wall_step_s": summary.wall_step_s,
                "metadata": dict(summary.metadata),
            },
            indent=2,
        )
    )


def _summary(path: Path) -> RecordSummary:
    """Contents of a record; of a finished one its index is checked, too."""
    summary = summarise(path)
    if summary.complete:
        check_readable(path)
    return summary


def print_contents(path: Path) -> RecordSummary:
    """Print one row for each stream of a record.

    Raises:
        RecordingError: It is damaged or not palpate's.
    """
    summary = _summary(path)
    began = datetime.fromtimestamp(summary.start_wall_ns * 1e-9, UTC)
    table = Table(title=cell(str(path)), title_justify="left")
    table.add_column("stream", overflow="fold")
    table.add_column("messages", justify="right")
    table.add_column("Hz", justify="right")
    table.add_column("length", justify="right")
    table.add_column("lost", justify="right")
    for key, count in sorted(summary.counts.items()):
        rate, seconds = summary.rates_hz.get(key), summary.durations_s.get(key)
        table.add_row(
            cell(key),
            f"{count:,}",
            "-" if rate is None else f"{rate:.2f}",
            "-" if seconds is None else duration_text(seconds),
            f"{summary.lost[key]:,}" if key in summary.lost else "-",
        )
    table.caption = f"{path.stat().st_size / 1e6:.2f} MB, from {began:%Y-%m-%d %H:%M:%S} UTC" + (
        "" if summary.complete else ", cut off: palpate recover"
    )
    console = Console()
    console.print(table)
    if summary.wall_step_s:
        console.print(
            f"the wall clock was set by {summary.wall_step_s:+.1f} s in this record: times of day "
            "before and after do not compare; rates and lengths are by the monotonic clock",
            style="yellow",
            soft_wrap=True,
        )
    return summary


def review_path(
    path: Path,
    view: Path | None,
    picture: Path | None,
    *,
    trajectories: Sequence[str] = (),
    most: int = 8,
    bundles: Sequence[str] = (),
) -> None:
    """Write the Rerun view of a record or of a store of simulations, and on request the picture.

    ``trajectories`` and ``most`` are for stores only, ``bundles`` for records: see the command.

    Raises:
        ConfigError: There is no such path or bundle, or a file cannot be written under its name.
        RecordingError: The record is damaged or not palpate's.
        DatasetError: The store is damaged, or has none of these trajectories.
        MissingExtraError: Rerun, h5py or matplotlib is not installed.
    """
    if not path.exists():
        raise ConfigError(f"{path} does not exist", remedy="check the path")
    check_output(view, "--out", ".rrd", path)
    check_output(picture, "--png", ".png", path)
    from palpate.files.simulation_store import is_simulation_store

    if is_simulation_store(path):
        _review_store(path, view, picture, trajectories, most)
    elif trajectories:
        raise ConfigError(
            f"{path} is a record, which has no trajectories", remedy="leave out --trajectory"
        )
    else:
        from palpate_services.viewer.record_view import review

        written = review(path, view, bundles=bundles)
        print(f"{printable(str(written))}  ({written.stat().st_size / 1e6:.1f} MB)")
        if picture is not None:
            from palpate_services.viewer.plot import plot_record

            for line in error_lines(plot_record(path, picture, bundles=bundles)):
                print(line)
            print(printable(str(picture)))
        print(f"look at it: {viewer_command(written)}")


def write_foxglove(record: Path, out: Path, *, bundles: Sequence[str] = ()) -> None:
    """Write a record for Foxglove, and print what is in its scenes.

    Raises:
        ConfigError: It would replace a record, or there is no such bundle.
        RecordingError: The record is damaged or not palpate's.
        DatasetError: The disk refused.
        MissingExtraError: Foxglove's messages are not installed.
    """
    from palpate_services.viewer.foxglove import export_foxglove

    counts = export_foxglove(record, out, bundles=bundles)
    print(f"{printable(str(out))}  ({out.stat().st_size / 1e6:.1f} MB)")
    for topic, count in sorted(counts.items()):
        print(f"  {printable(topic)}: {count:,}")
    print("open it in Foxglove, add a 3D panel, and follow the frame of a sensor")


def error_lines(errors: RecordErrors) -> list[str]:
    """Errors by force as lines of text, those of touched frames first; or that there are none."""
    if not errors.all_frames.frames:
        return [
            f"{errors.estimates:,} estimates; no force was measured beside them, so that how good "
            "they are is unknown"
        ]
    touched = errors.touched
    lines = [
        f"touched (true force {touched.name}): {touched.frames:,} of {errors.estimates:,} "
        f"estimates; median error: force {_with_unit(touched.force_median_n, 'N')}, "
        f"location {_with_unit(touched.location_median_m, 'mm')}",
        "  true force      frames   force error [N]        location error [mm]",
        "                           median  90 % below     median  90 % below",
    ]
    if touched.held_share is not None:
        lines.insert(1, f"the force is within its bound in {touched.held_share:.1%} of them")
    for each in errors.bins:
        cells = [
            _digits(each.force_median_n, "N"),
            _digits(each.force_p90_n, "N"),
            _digits(each.location_median_m, "mm"),
            _digits(each.location_p90_m, "mm"),
        ]
        lines.append(
            f"  {each.name:14} {each.frames:7,}   {cells[0]:>6}  {cells[1]:>10}"
            f"     {cells[2]:>6}  {cells[3]:>10}"
        )
    return lines


def _with_unit(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{_digits(value, unit)} {unit}"


def _digits(value: float | None, unit: str) -> str:
    """A force [N] with three decimals, a length [m] in millimetres with two; ``-`` for None."""
    if value is None:
        return "-"
    return f"{value:.3f}" if unit == "N" else f"{1e3 * value:.2f}"


def _review_store(
    path: Path, view: Path | None, picture: Path | None, trajectories: Sequence[str], most: int
) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from palpate_services.viewer.simulation import review_simulations

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    console = Console(stderr=True)
    silent = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=silent) as bar:
        task = bar.add_task("drawing", total=None)
        written = review_simulations(
            path,
            view,
            trajectories=trajectories,
            most=most,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{printable(str(written))}  ({written.stat().st_size / 1e6:.1f} MB)")
    if picture is not None:
        _draw_store(path, picture, trajectories)
        print(printable(str(picture)))
    print(f"look at it: {viewer_command(written)}")


def _draw_store(path: Path, picture: Path, trajectories: Sequence[str]) -> None:
    """An overview of a store, or the last step of the one trajectory that is named."""
    from palpate.files.simulation_store import choose_trajectories
    from palpate_fem.plot.step import plot_step
    from palpate_fem.plot.trajectories import plot_overview
    from palpate_fem.store.read import SimulationStore

    store = SimulationStore.open(path)
    names = store.ids()
    if trajectories:
        names = choose_trajectories(names, trajectories, len(names))
    if trajectories and len(names) == 1:
        (name,) = names
        press, outline = store.trajectory(name), store.outline(name)
        plot_step(store.fingertip(), press, picture, indenter=outline, title=name)
        return
    outcomes = plot_overview([store.summary(name) for name in names], picture, title=path.name)
    for outcome, count in sorted(outcomes.items()):
        print(f"  {outcome.value:24} {count}")


def recover_record(part: Path) -> None:
    """Write ``NAME.recovered.mcap``, and print what it holds and what was left out.

    Raises:
        RecordingError: It is whole or being written, nothing in it can be read, the disk refuses
            the new record, or a file of its name is there.
    """
    found = recover(part)
    print_contents(found.path)
    print(printable(str(found)))
