"""``palpate calibrate``: a finger's own features bundle, from presses against a force sensor.

The presses are recorded first, whole, and learned from afterwards. So nothing is lost where
something fails: ``--from`` takes the record again. Other fingers that were pressed before help, and
make a bundle for a finger before it is pressed at all.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from palpate.admin import read_token, token_file
from palpate.bus import Session
from palpate.client.models import ModelAdmin
from palpate.config import LinkConfig
from palpate.errors import BundleError, ConfigError
from palpate.files.bundle import read_bundle, write_bundle
from palpate.files.outputs import check_folder
from palpate.process import check_installed
from palpate_deploy.station.guided_presses import record_presses, untouched
from palpate_deploy.station.profile import Profile
from palpate_services.config import ModelsConfig
from palpate_services.inference.repository import Repository, available
from palpate_training import EXTRA_MODULES

if TYPE_CHECKING:
    from palpate_training.datasets.features import FeatureDataset
    from palpate_training.evaluation.transfer import Finger
    from palpate_training.learning.other_fingers import OtherFinger
    from palpate_training.tasks.finger import FingerReport

PRESSES_LEAST = 6
"""Fewer cannot be held out and chosen on at once; as ``tasks.finger`` says, which needs torch."""


PRESSES = 20
"""How many are recorded where nobody says."""

FOLDER = Path("runs/calibrate")
"""Where they are recorded to where nobody says."""


@dataclass(frozen=True, slots=True)
class CalibrationOrder:
    """What ``palpate calibrate`` is to do.

    Attributes:
        sensor: Name of the finger at the station, or in the file.
        presses: How many presses to record; 0 = the finger is not pressed, others tell of it; None
            = ``PRESSES``.
        out: Folder of the record; None = ``FOLDER``.
        source: A record or data set to learn from, instead of recording one.
        name: Of the bundle; empty = by the serial number.
        serve: Whether the station serves the bundle for this finger afterwards.
        others: Records and data sets with presses of other fingers.
    """

    sensor: str
    presses: int | None
    out: Path | None
    source: Path | None
    name: str
    serve: bool
    others: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        for option, given in (("--presses", self.presses), ("--out", self.out)):
            if given is not None and self.source is not None:
                raise ConfigError(
                    f"{option} and --from exclude each other: nothing is recorded, and all presses"
                    " of the file are learned from",
                    remedy="leave one of the two out",
                )
        if self.presses == 0 and not self.others:
            raise ConfigError(
                "without presses nothing is known of the finger",
                remedy="name presses of other fingers: --others FILE; or press this one",
            )
        if self.presses is not None and 0 < self.presses < PRESSES_LEAST:
            raise ConfigError(
                f"{self.presses} presses are too few to hold some of them out",
                remedy=f"--presses {PRESSES_LEAST} or more; 0 with --others",
            )
        same = {path.resolve() for path in self.others}
        if len(same) < len(self.others) or (self.source and self.source.resolve() in same):
            raise ConfigError(
                "a file is named twice", remedy="name each file once, the finger's own with --from"
            )


@dataclass(frozen=True, slots=True)
class _Others:
    """Other fingers.

    Attributes:
        fingers: Their presses.
        serials: The serial numbers that are known of them, and where each was found.
        rows: All their rows, and where each was found: the same ones may have another name.
    """

    fingers: list[OtherFinger]
    serials: dict[str, Path]
    rows: list[tuple[Path, Finger]]

    @classmethod
    def read(cls, paths: Sequence[Path]) -> _Others:
        """All fingers of records and data sets.

        Raises:
            RecordingError: A record is damaged.
            DatasetError: A file is no data set, or holds too few presses of a finger; or two hold
                the same presses.
        """
        from palpate_training.evaluation.transfer import fingers_of, refuse_same
        from palpate_training.tasks.other_fingers import fingers_in

        fingers: list[OtherFinger] = []
        serials: dict[str, Path] = {}
        rows: list[tuple[Path, Finger]] = []
        for path in paths:
            data, own = _rows(path)
            fingers += fingers_in(data)
            serials |= dict.fromkeys(own, path)
            rows += [(path, finger) for finger in fingers_of(data)]
        refuse_same([str(path) for path, _ in rows], [finger for _, finger in rows])
        return cls(fingers, serials, rows)

    def check_rows(self, data: FeatureDataset) -> None:
        """Refuse presses that are among the others.

        Raises:
            DatasetError: They are.
        """
        from palpate_training.evaluation.transfer import fingers_of, refuse_same

        own = [(f"{data.name}, the finger itself,", finger) for finger in fingers_of(data)]
        both = [*self.rows, *own]
        refuse_same([str(name) for name, _ in both], [finger for _, finger in both])

    def check(self, serial: str) -> None:
        """Refuse a finger that is among the others; an unknown serial number is none.

        Raises:
            ConfigError: It is.
        """
        if serial in self.serials:
            raise ConfigError(
                f"{self.serials[serial]} holds presses of {serial}, the finger itself",
                remedy="leave it out of --others; --from learns from it",
            )


def calibrate_finger(
    link: LinkConfig,
    station: str,
    order: CalibrationOrder,
    *,
    token: Path | None,
    profile: Profile | None,
    as_json: bool,
) -> None:
    """Record presses, learn from them, and serve what was learned.

    ``token`` None is that of the station, as the ``profile`` or the default says where.

    Raises:
        LinkError: There is no router, or no such finger, or no force sensor for it, or no service
            to serve the bundle.
        DatasetError: Too few presses, or presses of the finger are among the others.
        BundleError: The bundle cannot be written.
        ConfigError: The order contradicts itself or the files that it names, or its folder or that
            of the bundles cannot be written.
        RemoteError: The token is not the station's.
        KeyboardInterrupt: It was interrupted before there were presses enough.
        MissingExtraError: The training extra is not installed.
    """
    for module in EXTRA_MODULES:
        check_installed(module, extra="training")
    console = Console(stderr=as_json)
    kept = ModelsConfig() if profile is None else profile.models
    # Before the presses: nobody wants to press twenty times for a bundle that cannot be made, or
    # not be served.
    if order.name:
        _check_not_shipped(order.name)
    others = _Others.read(order.others)
    secret = b""
    presses = PRESSES if order.presses is None else order.presses
    out = FOLDER if order.out is None else order.out
    if presses and order.source is None:
        _check_writable(out)
    check_folder(kept.repository_folder, "[models] folder")
    if order.serve:
        secret = read_token(token_file(kept.memory_folder, station) if token is None else token)
        with Session.open(link, station=station) as session:
            ModelAdmin(session, secret).served("features")
    source = order.source
    if presses == 0:
        tare = untouched(link, station, order.sensor, console)
        others.check(tare.sensor_serial)
        serials = [tare.sensor_serial] if tare.sensor_serial else []
        name = _name_of(order, serials)
        rest = tare.electrodes.astype(np.float64)
        new, report = _written(
            lambda folder: _learn_unpressed(rest, others.fingers, folder, name, console),
            kept.repository_folder,
        )
    else:
        live = ""
        if source is None:
            source, live = record_presses(
                *(link, station, order.sensor, presses, out, console),
                least=PRESSES_LEAST,
                check=others.check,
            )
        data, serials = _rows(source, order.sensor)
        if live and serials != [live]:
            raise ConfigError(
                f"{source} is of {', '.join(serials) or 'no known finger'}, {order.sensor!r} was"
                f" {live} when it began",
                remedy="press it again, without changing the finger meanwhile",
            )
        for serial in serials:
            others.check(serial)
        others.check_rows(data)
        name = _name_of(order, serials)
        new, report = _written(
            lambda folder: _learn(data, serials, others.fingers, folder, name, console),
            kept.repository_folder,
        )
    label = f"{new.name}:{new.version}"
    if as_json:
        print(
            json.dumps(
                {
                    "bundle": label,
                    "folder": str(new.folder),
                    "source": None if source is None else str(source),
                    "serials": serials,
                    **asdict(report),
                    "digest": report.digest.hex(),
                },
                indent=2,
            )
        )
    else:
        _show(report, label, console)
    if order.serve:
        with Session.open(link, station=station) as session:
            ModelAdmin(session, secret).load("features", label, sensor=order.sensor)
        console.print(
            f"{label} serves {order.sensor}; back: palpate model rollback --service features "
            f"--sensor {order.sensor}",
            markup=False,
        )
    else:
        console.print(f"serve it: palpate model load {label} --sensor {order.sensor}", markup=False)


def _rows(source: Path, sensor: str | None = None) -> tuple[FeatureDataset, list[str]]:
    """Rows of a record or data set, of one finger or all; serial numbers where they are known."""
    from palpate_training.datasets.features import of_sensor, open_dataset
    from palpate_training.datasets.ingest import rows_of_streams
    from palpate_training.datasets.record_streams import read_streams, serials_of

    def check(held: Collection[str]) -> None:
        if sensor is not None and sensor not in held:
            raise ConfigError(
                f"{source} holds no sensor {sensor!r}",
                remedy=f"it holds: {', '.join(sorted(held)) or 'none'}",
            )

    if source.suffix == ".part":
        raise ConfigError(
            f"{source} is a record that was not finished", remedy=f"palpate recover {source}"
        )
    if source.suffix != ".mcap":
        data = open_dataset(source)
        check(data.sensor_names)
        return data if sensor is None else of_sensor(data, sensor), []
    streams = read_streams(source)
    check(streams)
    if sensor is not None:
        streams = {sensor: streams[sensor]}
    serials = {serial for each in streams.values() for serial in serials_of(each)}
    return rows_of_streams(source, streams), sorted(serials)


def _check_writable(folder: Path) -> None:
    """Make the folder of a record, and write to it.

    Raises:
        ConfigError: That is not possible.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(
            f"presses cannot be recorded to {folder}: {error.strerror}",
            remedy="give a folder that this user may write to: palpate calibrate --out FOLDER",
        ) from error


def _check_not_shipped(name: str) -> None:
    """Refuse the name of a bundle that ships: a station would take one finger's for newer.

    Raises:
        ConfigError: It is one.
    """
    if name in {label.partition(":")[0] for label in available()}:
        raise ConfigError(
            f"{name} is the name of a bundle that ships with palpate",
            remedy="give the finger's own another one: --name NAME",
        )


@dataclass(frozen=True, slots=True)
class _NewBundle:
    """Where a bundle goes: the next version of its name."""

    name: str
    version: int
    folder: Path

    @classmethod
    def of(cls, name: str, repository: Path) -> _NewBundle:
        """As the repository is now."""
        known = [label.partition(":") for label in Repository(repository).available()]
        version = 1 + max((int(number) for other, _, number in known if other == name), default=0)
        return cls(name, version, repository / name / str(version))


def _name_of(order: CalibrationOrder, serials: Sequence[str]) -> str:
    """Of the bundle of a finger with these serial numbers.

    Raises:
        ConfigError: It is that of a bundle that ships.
    """
    name = order.name or f"features-{_plain(serials[0] if serials else order.sensor)}"
    _check_not_shipped(name)
    return name


def _written(
    learn: Callable[[Path], FingerReport], repository: Path
) -> tuple[_NewBundle, FingerReport]:
    """Learn a bundle into a folder, and write it into the repository as the next version.

    Another of the same name may have been written meanwhile; so which one is the next is only
    asked when all is learned.

    Raises:
        BundleError: The repository cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="palpate-calibrate-") as temporary:
        report = learn(Path(temporary) / "bundle")
        made = read_bundle(Path(temporary) / "bundle")
    while True:
        new = _NewBundle.of(made.manifest.name, repository)
        try:
            digest = write_bundle(
                new.folder,
                model=made.model,
                golden=made.golden,
                manifest=replace(made.manifest, version=new.version),
                known_inputs=made.known_inputs,
            )
        except BundleError:
            if new == _NewBundle.of(made.manifest.name, repository):
                raise
        else:
            return new, replace(report, digest=digest)


def _learn(
    data: FeatureDataset,
    serials: Sequence[str],
    others: Sequence[OtherFinger],
    folder: Path,
    name: str,
    console: Console,
) -> FingerReport:
    from palpate_training.tasks.finger import STEPS, train_finger

    with Progress(
        TextColumn("learn, and hold presses out"), BarColumn(), console=console
    ) as progress:
        task = progress.add_task("", total=STEPS)
        return train_finger(
            data,
            folder,
            name=name,
            serials=serials,
            others=others,
            on_step=lambda: progress.advance(task),
        )


def _learn_unpressed(
    rest: npt.NDArray[np.float64],
    others: Sequence[OtherFinger],
    folder: Path,
    name: str,
    console: Console,
) -> FingerReport:
    from palpate_training.tasks.other_fingers import train_unpressed

    with console.status("learn from other fingers, each left out in its turn"):
        return train_unpressed(others, rest, folder, name=name)


def _show(report: FingerReport, label: str, console: Console) -> None:
    from palpate_training.tasks.finger import LIKE_OTHERS

    found = report.metrics
    table = Table(title=label, title_justify="left")
    # All that are in the record: the guide counts no short ones, and none before the tare.
    count = report.presses
    table.add_column(f"{count} presses recorded, each held out" if count else "on other fingers")
    table.add_column("magnitude [N]", justify="right")
    table.add_column(escape("angle [rad]"), justify="right")
    for words, prefix in (
        ("this bundle", ""),
        ("a line", "linear_"),
        ("other fingers alone", "others_"),
        ("always the mean", "constant_"),
    ):
        if f"{prefix}force_magnitude_median_n" in found:
            table.add_row(
                words,
                f"{found[f'{prefix}force_magnitude_median_n']:.3f}",
                f"{found[f'{prefix}force_angle_median_rad']:.3f}",
            )
    console.print(table)
    console.print(
        f"medians; 95 % of the magnitudes within {found['force_magnitude_p95_n']:.2f} N\n"
        f"90 % intervals hold {found['coverage_90']:.0%} of the errors\n"
        f"it holds: {report.estimator}",
        markup=False,
    )
    if report.presses == 0:
        console.print(
            "nobody knows how far this finger is like the others: its estimates are flagged"
            " UNCALIBRATED until it is pressed (palpate calibrate)",
            markup=False,
        )
    elif report.others is not None and report.others > LIKE_OTHERS:
        console.print(
            f"the other fingers were left out: alone they are off by {report.others:.2f} of the"
            f" force and 0.5 N, median, more than {LIKE_OTHERS:g}: this finger is not like them",
            markup=False,
        )


def _plain(serial: str) -> str:
    """A serial number as part of a bundle's name."""
    return re.sub(r"[^a-z0-9_-]+", "-", serial.lower()).strip("-")[:40] or "finger"
