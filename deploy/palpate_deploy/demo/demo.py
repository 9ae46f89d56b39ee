"""``palpate demo``: a virtual finger is touched; estimates are compared with the truth, live."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from palpate import Client
from palpate.errors import LinkError, PalpateError, StreamTimeout
from palpate.files.atomic import written_whole
from palpate.process import stop_on_signals
from palpate_deploy.demo.comparison import (
    FieldComparison,
    FieldMedians,
    TouchComparison,
    TouchMoment,
)
from palpate_deploy.diagnose.records import error_lines, viewer_command
from palpate_deploy.station.host import check_room, private_profile
from palpate_deploy.station.logs import FAILED
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.supervision import Supervisor
from palpate_services.viewer.touch_errors import TOUCHED_N, read_touches

_SENSOR = "finger"
_REFRESH_S = 0.1
_LINE_S = 1.0
_JOIN_S = 60.0
_FIRST_S = 60.0
"""A cold host may take this long to import, load, tare and give the first estimates [s]."""


def run_demo(seconds: float, out: Path) -> int:
    """Run the demo until ``seconds`` after the first estimates; the exit code.

    It is 1 if no estimate came, or no record was written.

    Raises:
        RecordingError: ``out`` has no room for a record.
        PalpateError: The demo cannot start.
    """
    from palpate_services.inference.repository import resolve

    console = Console(highlight=False)
    profile = private_profile("demo", recorder={"out": str(out)})
    for bundle in (profile.features.bundle, profile.field.bundle, profile.synthesis.bundle):
        resolve(bundle)  # a missing one is an error before anything starts
    check_room(out, profile.recorder.min_free_bytes)
    before = set(out.glob("*.mcap"))
    stop = stop_on_signals()
    console.print(
        "virtual finger -> features, fields, synthesis -> recorder, for "
        f"{seconds:g} s after the first estimates",
    )
    comparison, fields = TouchComparison(), FieldComparison()
    with Supervisor(profile, "demo") as supervisor:
        try:
            _watch(console, profile, comparison, fields, seconds, stop)
        except LinkError as error:
            raise LinkError(
                f"{error.problem}; the router's log: {supervisor.log_tail('router') or 'empty'}",
                remedy=f"see {supervisor.logs}",
            ) from error
        if not comparison.count:
            for service in profile.processes:
                if tail := supervisor.log_tail(service):
                    console.print(f"--- {service}\n{tail}", markup=False)
    records = sorted(set(out.glob("*.mcap")) - before)
    if comparison.count and not records:
        console.print(f"--- recorder\n{supervisor.log_tail('recorder')}", markup=False)
    return _report(console, comparison, fields.medians(), records)


def _watch(
    console: Console,
    profile: Profile,
    comparison: TouchComparison,
    fields: FieldComparison,
    seconds: float,
    stop: threading.Event,
) -> None:
    """Compare estimates with truth until ``seconds`` after the first of every kind.

    A kind that does not come is not waited for longer than ``_FIRST_S``.
    """
    with (
        Client(profile.link.connect[0], station=profile.station, timeout_s=_JOIN_S) as robot,
        Live(console=console, auto_refresh=False, transient=False) as live,
    ):
        comparison.subscribe(robot.session, _SENSOR)
        field_streams = fields.subscribe(robot.session, _SENSOR)
        end = time.monotonic() + _FIRST_S
        redraw = 0.0
        started = False
        while not stop.is_set():
            now = time.monotonic()
            all_came = comparison.count and fields.complete
            if not started and (all_came or (comparison.count and now >= end)):
                started, end = True, now + seconds
            if now >= end:
                break
            try:
                comparison.take(timeout_s=0.05)
            except StreamTimeout:
                continue
            finally:
                fields.take(field_streams)
            if comparison.newest is None or now < redraw:
                continue
            if console.is_terminal:
                live.update(_table(comparison, fields.medians(), end - now), refresh=True)
                redraw = now + _REFRESH_S
            else:
                console.print(_line(comparison.newest), soft_wrap=True)
                redraw = now + _LINE_S


def _table(comparison: TouchComparison, fields: FieldMedians, left_s: float) -> Table:
    moment = comparison.newest
    assert moment is not None
    table = Table(title="touch of the virtual finger", title_justify="left")
    table.add_column("")
    for column in ("truth", "estimate", "error", f"median, >= {TOUCHED_N:g} N"):
        table.add_column(column, justify="right", min_width=9)
    medians = comparison.medians()
    for what, scale, truth, estimate, errors in (
        ("force {} [N]", 1.0, moment.true_force, moment.force, medians.force_axes_n),
        ("location {} [mm]", 1e3, moment.true_location, moment.location, medians.location_axes_m),
    ):
        error = None if truth is None or estimate is None else estimate - truth
        for axis, name in enumerate("xyz"):
            cells = (
                "-" if vector is None else f"{vector[axis] * scale:+.2f}"
                for vector in (truth, estimate, error)
            )
            median = f"{errors[axis] * scale:.{3 if scale == 1.0 else 2}f}"
            table.add_row(escape(what.format(name)), *cells, median, end_section=axis == 2)
    table.add_row(
        escape("skin, mean of all nodes [mm]"),
        f"{fields.moved_m * 1e3:.3f}",
        "",
        "",
        f"{fields.field_m * 1e3:.3f}",
    )
    counts = f"{fields.counts:.0f}"
    table.add_row(escape("electrodes from the field [counts]"), "", "", "", counts)
    if moment.bound is not None and medians.held_share is not None:
        off_n = float(((moment.force - moment.true_force) ** 2).sum() ** 0.5)
        table.add_row(
            escape("force, may be off by [N]"),
            "",
            f"{moment.bound:.2f}",
            f"{off_n:.2f}",
            f"held {medians.held_share:.0%}",
        )
    touched = "[green]touched[/]" if moment.in_contact else "[dim]untouched[/]"
    table.caption = (
        f"{touched}   {comparison.count:,} estimates   age {moment.age_s * 1e3:.1f} ms"
        f"   {max(0.0, left_s):.0f} s left"
    )
    return table


def _line(moment: TouchMoment) -> str:
    truth, force = moment.true_force, moment.force
    line = (
        f"force [N] truth {truth[0]:+.2f} {truth[1]:+.2f} {truth[2]:+.2f}"
        f"  estimate {force[0]:+.2f} {force[1]:+.2f} {force[2]:+.2f}"
    )
    if moment.bound is not None:
        line += f" +- {moment.bound:.2f}"
    if moment.location is not None and moment.true_location is not None:
        away_mm = float(((moment.location - moment.true_location) ** 2).sum() ** 0.5) * 1e3
        line += f"  location off by {away_mm:.2f} mm"
    return line + ("" if moment.in_contact else "  (untouched)")


def _report(
    console: Console, comparison: TouchComparison, fields: FieldMedians, records: list[Path]
) -> int:
    """Print errors by force and the paths of the files; write the numbers and the picture."""
    if not comparison.count:
        console.print("no estimate came; see the logs above and try: palpate doctor")
        return FAILED
    if not records:
        console.print("estimates came, but no record was written; see the recorder's log above")
        return FAILED
    record = records[-1]
    errors = read_touches(record, sensor=_SENSOR).errors()
    for line in error_lines(errors):
        console.print(line, soft_wrap=True, markup=False)  # [mm] is a unit
    age_s = comparison.medians().age_s
    console.print(
        f"{comparison.count:,} estimates; median age at the client {age_s * 1e3:.1f} ms",
        soft_wrap=True,
    )
    console.print(
        f"{fields.fields:,} fields; median error of a node {fields.field_m * 1e3:.3f} mm where "
        f"nodes move {fields.moved_m * 1e3:.3f} mm; {fields.syntheses:,} syntheses of the "
        f"electrodes, median error {fields.counts:.0f} counts r.m.s.",
        soft_wrap=True,
    )
    print(f"record   {record}")
    numbers = record.with_suffix(".json")
    summary = {"touches": errors.as_json(), "age_median_s": age_s, "fields": fields.as_json()}
    with written_whole(numbers) as partial:
        partial.write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n")
    print(f"numbers  {numbers}")
    picture = record.with_suffix(".png")
    try:
        from palpate_services.viewer.plot import plot_record

        plot_record(record, picture, sensor=_SENSOR)
        print(f"picture  {picture}")
    except PalpateError as error:  # the record exists; a picture can be made later
        print(f"picture  none: {error}")
    view = record.with_suffix(".rrd")
    if view.is_file():
        print(f"view     {view}")
        print(f"look at it: {viewer_command(view)}")
    else:
        print(f"view     none; make one: palpate review {record}")
    return 0
