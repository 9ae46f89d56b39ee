"""Ingest of a record: electrodes, wrench and indenter pose of each sensor, aligned by time.

Ingest of the LASA force calibration: real BioTacs pressed and sheared on a force sensor.

The file's authors publish the rows without a licence: measure, do not redistribute.

Axes. The authors' own table of electrodes (MiaoLi/syntouchcontact, ``SynTouchContact.cpp``) puts
E1 at (-7.5, 20.4, 0) mm, the tip E7 at y = 25.6 mm and the ventral E17 at z = +7.5 mm, so theirs is
x lateral, y distal, z ventral; ours is x distal, y lateral, z dorsal. Hence ``(x, y, z)_ours =
(y, x, -z)_theirs``, a proper rotation. Stored is the reaction on the BioTac: Fz < 0 there, Fz > 0
here, when the ventral side is pressed. That the force is stored in these same axes is not written
anywhere; the data agree (section "Axes" of training/LOG.md). No metric depends on it: a rotation
changes neither magnitudes nor angles.
"""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.alignment import AlignmentClock, Stamped, common_clock, linear, times_of
from palpate.bus import topics
from palpate.errors import DatasetError, WireError
from palpate.files.record import read_record
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    IndenterPoseFrame,
    SensorType,
    Tare,
    WrenchFrame,
)
from palpate.sampling import sample_offsets
from palpate_training.datasets.container import Provenance, read_archive, sha256_of
from palpate_training.datasets.features import (
    ELECTRODES,
    FeatureDataset,
    check_counts,
    check_forces,
    cut_into_blocks,
)

_log = logging.getLogger(__name__)

TOUCH_N = 0.2
"""Without a pose that knows contact, a force above this is contact [N]; it is above the noise of a
6-axis sensor."""

PRESS_N = 0.5
"""What does not reach this force is no press [N]."""

_STREAMS: Mapping[str, topics.Topic[Any]] = {
    topic.name: topic for topic in (topics.ELECTRODES, topics.WRENCH, topics.POSE, topics.TARE)
}

Times = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(slots=True)
class SensorStreams:
    """What a record holds of one sensor."""

    frames: list[ElectrodeFrame] = field(default_factory=list)
    wrenches: list[WrenchFrame] = field(default_factory=list)
    poses: list[IndenterPoseFrame] = field(default_factory=list)
    tares: dict[int, Tare] = field(default_factory=dict)

    @property
    def clock(self) -> AlignmentClock:
        """By which all its messages can be compared."""
        return common_clock(self.frames, self.wrenches, self.poses)


def ingest_record(path: Path, *, command: str = "", licence: str = "own record") -> FeatureDataset:
    """Read an MCAP record.

    A row is a valid, tared electrode frame in whose middle there is a wrench (and a pose, where the
    record has poses of that sensor): between two readings that are at most three periods apart. A
    group is a press: it ends halfway between two contacts.
    Where the source of the poses cannot know whether it touches, a force above ``TOUCH_N`` counts
    as contact, and as a press of its own only what reaches ``PRESS_N``.

    Args:
        path: ``NAME.mcap``.
        command: The command line, for provenance.
        licence: What may be done with the rows.

    Raises:
        RecordingError: Not a whole record.
        DatasetError: The record lacks a stream, no row could be aligned, a sensor is no BioTac with
            19 electrodes, or its clock goes back.
    """
    return rows_of_streams(path, read_streams(path), command=command, licence=licence)


def rows_of_streams(
    path: Path,
    sensors: Mapping[str, SensorStreams],
    *,
    command: str = "",
    licence: str = "own record",
) -> FeatureDataset:
    """As ``ingest_record``, of streams that were read already, or of some of them."""
    parts: list[dict[str, npt.NDArray[Any]]] = []
    names: list[str] = []
    for name, streams in sorted(sensors.items()):
        if not streams.frames:
            continue
        part = _align(path, name, streams)
        part["sensor"] = np.full(len(part["group"]), len(names), dtype=np.int32)
        if parts:
            part["group"] = part["group"] + np.int32(parts[-1]["group"].max() + 1)
        parts.append(part)
        names.append(name)
    if not parts:
        raise DatasetError(
            f"{path}: no electrode frames", remedy="record the stream electrodes of a sensor"
        )
    notes = "wrench and pose at the middle of each frame; group = press"
    without = [
        name for name, part in zip(names, parts, strict=True) if "contact_location" not in part
    ]
    if without:
        if len(without) < len(parts):
            notes += f"; no contact locations, because {', '.join(without)} has no pose"
            _log.warning("%s: contact locations are left out: %s has no pose", path, without)
        for part in parts:
            part.pop("contact_location", None)
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return FeatureDataset(
        **columns,
        block=columns["group"].copy(),
        sensor_names=tuple(names),
        provenance=Provenance(
            source=f"record of {', '.join(names)}",
            command=command,
            input_sha256=sha256_of(path),
            licence=licence,
            palpate_version=__version__,
            notes=notes,
        ),
        name=str(path),
    )


def read_streams(path: Path) -> dict[str, SensorStreams]:
    """Streams of every sensor of a record, by name, in order of writing.

    Messages that break the contract, which the recorder keeps, are left out, and the log tells it.

    Raises:
        RecordingError: Not a whole record.
    """
    sensors: dict[str, SensorStreams] = {}
    rejected = 0
    for item in read_record(path):
        topic = _STREAMS.get(item.address.topic)
        if topic is None:
            continue
        streams = sensors.setdefault(item.address.sensor, SensorStreams())
        try:
            message = topic.codec.decode(item.payload)
        except WireError:
            rejected += 1
            continue
        if isinstance(message, ElectrodeFrame):
            streams.frames.append(message)
        elif isinstance(message, WrenchFrame):
            streams.wrenches.append(message)
        elif isinstance(message, IndenterPoseFrame):
            streams.poses.append(message)
        else:
            streams.tares[message.tare_id] = message
    if rejected:
        _log.warning("%s: %d messages break the contract and are left out", path, rejected)
    return sensors


def _align(path: Path, name: str, streams: SensorStreams) -> dict[str, npt.NDArray[Any]]:
    check_streams(path, name, streams)
    frames = [
        frame
        for frame in streams.frames
        if frame.electrodes_valid
        and frame.tare_id != NO_TARE
        and frame.tare_id in streams.tares
        and streams.tares[frame.tare_id].electrodes.shape == frame.electrodes.shape
    ]
    if not frames:
        raise DatasetError(
            f"{path}: none of {len(streams.frames)} frames of {name!r} is a valid, tared BioTac"
            " frame",
            remedy="tare before recording, and record the stream tare",
        )
    clock = streams.clock
    times = times_of(frames, clock)
    order = np.argsort(times, kind="stable")
    frames, times = [frames[i] for i in order], times[order]
    at = times + middles(frames)

    force, kept = force_at(at, streams, clock)
    location = None
    strength = np.linalg.norm(force, axis=1)
    touching, pressing = strength > TOUCH_N, strength >= PRESS_N
    if streams.poses:
        positions = np.array([p.position for p in streams.poses], dtype=np.float64)
        # NaN = not known, and so is what lies between a known and an unknown one
        contact = np.array([[p.in_contact] for p in streams.poses], dtype=np.float64)
        both, has_pose = linear(at, times_of(streams.poses, clock), np.hstack([positions, contact]))
        location = both[:, :3]
        told = ~np.isnan(both[:, 3])
        touching = np.where(told, both[:, 3] >= 0.5, touching)
        pressing = np.where(told, touching, pressing)
        kept = kept & has_pose
    if not kept.any():
        raise DatasetError(
            f"{path}: no frame of {name!r} has a wrench (and pose) within three periods",
            remedy="check that all streams were stamped by the same clock",
        )
    _log.info("%s: %d of %d frames of %s kept", path, kept.sum(), len(streams.frames), name)

    baseline = np.array([streams.tares[frame.tare_id].electrodes for frame in frames])
    columns: dict[str, npt.NDArray[Any]] = {
        "electrodes": np.array([frame.electrodes for frame in frames], dtype=np.uint16)[kept],
        "baseline": baseline.astype(np.float32)[kept],
        "force": force.astype(np.float32)[kept],
        "group": number_presses(touching[kept], pressing[kept]),
        "in_contact": touching[kept],
        "time_ns": times[kept],
    }
    if location is not None:
        seen = np.where(touching[:, None], location, np.nan).astype(np.float32)
        columns["contact_location"] = seen[kept]
    return columns


def check_streams(path: Path, name: str, streams: SensorStreams) -> None:
    """Refuse a sensor without a wrench, with other electrodes than a data set has, or times twice.

    Raises:
        DatasetError: It is such; no frame is left out in silence.
    """
    if not streams.wrenches:
        raise DatasetError(
            f"{path}: sensor {name!r} has no wrench stream",
            remedy="record the force/torque sensor in the finger's keys: of = NAME in its table",
        )
    others = [f.sensor_type for f in streams.frames if f.sensor_type is not SensorType.BIOTAC]
    if others:
        raise DatasetError(
            f"{path}: {len(others)} of {len(streams.frames)} frames of {name!r} are of a "
            f"{others[0].name} with {others[0].layout.electrodes} electrodes; a data set has "
            f"{SensorType.BIOTAC.layout.electrodes}",
            remedy="record BioTacs with 19 electrodes alone; models are trained for no other",
        )
    clock = streams.clock
    _check_times(path, name, streams.frames, clock, "electrodes")
    _check_times(path, name, streams.wrenches, clock, "wrench")
    _check_times(path, name, streams.poses, clock, "pose")


def _check_times(
    path: Path, name: str, stream: Sequence[Stamped], clock: AlignmentClock, what: str
) -> None:
    """Refuse a stream whose clock went back, so that some of its times come twice."""
    stamps = [message.stamp for message in stream]
    times = times_of(stream, clock)
    pairs = zip(itertools.pairwise(stamps), np.diff(times) < 0, strict=True)
    # What was overtaken on the bus, or is played again, goes back in its sequence as well.
    set_back = [
        earlier and not (new.session_id == old.session_id and new.sequence < old.sequence)
        for (old, new), earlier in pairs
    ]
    parts = np.cumsum([False, *set_back])
    in_time = parts[np.argsort(times, kind="stable")]
    if np.count_nonzero(np.diff(in_time)) > parts[-1]:
        at = set_back.index(True)
        back_s = (times[at] - times[at + 1]) * 1e-9
        raise DatasetError(
            f"{path}: the {clock.value} clock of the {what} of {name!r} goes back by {back_s:.2f} "
            "s: some times come twice, and what belongs together is unknown",
            remedy="record again, and leave the clocks alone meanwhile (docs/time.md)",
        )


def force_at(
    times: Times, streams: SensorStreams, clock: AlignmentClock
) -> tuple[Values, npt.NDArray[np.bool_]]:
    """Force at times of a clock [N], shape (T, 3), and where it is known."""
    forces = np.array([w.force for w in streams.wrenches], dtype=np.float64)
    return linear(times, times_of(streams.wrenches, clock), forces)


def middles(frames: Sequence[ElectrodeFrame]) -> Times:
    """From each frame's stamp to the mean instant of its electrodes [ns]: 4 ms, live."""
    return np.array([sample_offsets(frame).middle_ns for frame in frames], dtype=np.int64)


def number_presses(
    touching: npt.NDArray[np.bool_], pressing: npt.NDArray[np.bool_]
) -> npt.NDArray[np.int32]:
    """Press of every row, from 0; a press ends halfway between two contacts.

    A contact in which nothing presses, such as noise of the force sensor while the force rises
    through the threshold of a touch, belongs to the press that is nearer.

    Args:
        touching: Whether the indenter touches, shape ``(N,)``, in order of time.
        pressing: Rows of which one makes a contact a press, shape ``(N,)``.
    """
    edges = np.diff(touching.astype(np.int8), prepend=0, append=0)
    contacts = np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1)
    pressed = np.array([pressing[start:end].any() for start, end in contacts], dtype=np.bool_)
    press = np.zeros(len(touching), dtype=np.int32)
    for (_, end), (start, _) in itertools.pairwise(contacts[pressed]):
        half = (end + start) // 2
        for first, last in contacts[(contacts[:, 0] < half) & (half < contacts[:, 1])]:
            half = last if first - end < start - last else first
        press[half:] += 1
    return press


BLOCKS_PER_RECORDING = 20
"""About 9 s each; the force's autocorrelation is below 0.3 after 5 s, below 0.1 after 4-11 s."""

ELECTRODE_LAG_ROWS = 2
"""The archive has no time stamps, and its electrodes come later than its force: a quadratic fit
explains the force 2-3 rows (20-30 ms) before a row of electrodes best, on both fingers. Pairing so
lowers the error on validation blocks (training/LOG.md); 0 takes the rows as stored."""

_LASA_ARRAYS = ("electrodes_raw", "baseline_mean", "force_N")

_LASA_KEY = re.compile(rf"finger(0|[1-9][0-9]*)_({'|'.join(_LASA_ARRAYS)})")
_LASA_KEY_ZEROS = re.compile(rf"finger(0[0-9]+)_({'|'.join(_LASA_ARRAYS)})")

_NOTES = (
    "force rotated from the authors' axes (x lateral, y distal, z ventral) to the sensor frame:"
    " (x, y, z) = (y, x, -z)"
)


def ingest_lasa(
    path: Path,
    *,
    fingers: Sequence[int] = (),
    command: str = "",
    blocks_per_recording: int = BLOCKS_PER_RECORDING,
    lag_rows: int = ELECTRODE_LAG_ROWS,
    rate_hz: float | None = None,
) -> FeatureDataset:
    """Read ``force_calibration.npz``: one recording (group) of each finger, in order of time.

    Rows with a force above ``TOUCH_N`` are in contact.

    Args:
        path: The archive: ``fingerN_electrodes_raw`` [counts], ``fingerN_baseline_mean`` [counts]
            and ``fingerN_force_N`` [N] of any number of fingers N.
        fingers: Which of them; none = all.
        command: The command line, for provenance.
        blocks_per_recording: Contiguous pieces each recording is cut into.
        lag_rows: Electrodes of a row are paired with the force so many rows before.
        rate_hz: Rows a second, of which ``time_ns`` is made; None = no times, so what reads the
            rows takes them for 100 Hz, as LASA's are.

    Raises:
        DatasetError: The archive is missing, damaged, or not this one; it lacks a finger or one of
            its arrays, or has one of a number with zeros in front; a finger's arrays do not fit
            together, or hold what is no raw count or no fingertip's force in newtons; a finger is
            named twice.
    """
    if len(set(fingers)) < len(fingers):
        raise DatasetError(
            f"a finger is named twice: {', '.join(map(str, fingers))}", remedy="name each once"
        )
    remedy = "give the archive force_calibration.npz of the LASA force calibration"
    held: list[str] = []

    def names(there: Sequence[str]) -> list[str]:
        held.extend(there)
        return [
            name
            for name in there
            if (match := _LASA_KEY.fullmatch(name)) and (not fingers or int(match[1]) in fingers)
        ]

    arrays = read_archive(path, names, remedy=remedy)
    chosen = _fingers_held(path, held, fingers)
    parts = []
    for finger in chosen:
        own = [arrays[f"finger{finger}_{what}"] for what in _LASA_ARRAYS]
        electrodes, baseline, theirs = own
        rows_of_finger = len(electrodes) if electrodes.ndim else 0
        wanted = (rows_of_finger, ELECTRODES), (ELECTRODES,), (rows_of_finger, 3)
        if (shapes := tuple(array.shape for array in own)) != wanted:
            raise DatasetError(
                f"{path}: arrays of finger {finger} have shapes {shapes}, not (N, 19), (19,),"
                " (N, 3)",
                remedy=remedy,
            )
        if rows_of_finger <= lag_rows + blocks_per_recording:
            raise DatasetError(
                f"{path}: finger {finger} has {rows_of_finger} rows, too few for {lag_rows} rows of"
                f" lag and {blocks_per_recording} blocks",
                remedy="cut it into fewer blocks",
            )
        _check_finger(f"{path}: finger {finger}", electrodes, baseline, theirs)
        parts.append((electrodes[lag_rows:], baseline, theirs[: rows_of_finger - lag_rows]))
    rows = [len(electrodes) for electrodes, _, _ in parts]
    force = np.concatenate([theirs for _, _, theirs in parts]).astype(np.float32)
    touching = np.linalg.norm(force, axis=1) > TOUCH_N
    contact = f"in contact above {TOUCH_N:g} N: {touching.sum()} of {len(force)} rows"
    notes = (
        _NOTES,
        "always in contact" if touching.all() else contact,
        "no time stamps, about 100 Hz" if rate_hz is None else f"{rate_hz:g} Hz as told",
        f"electrodes paired with the force {lag_rows} rows before",
    )
    row = np.concatenate([np.arange(n) for n in rows])
    return FeatureDataset(
        electrodes=np.rint(np.concatenate([electrodes for electrodes, _, _ in parts])).astype(
            np.uint16
        ),
        baseline=np.concatenate(
            [np.tile(baseline, (n, 1)) for n, (_, baseline, _) in zip(rows, parts, strict=True)]
        ).astype(np.float32),
        force=force[:, [1, 0, 2]] * np.array([1, 1, -1], dtype=np.float32),
        group=np.repeat(np.arange(len(rows), dtype=np.int32), rows),
        block=np.concatenate(
            [
                cut_into_blocks(n, blocks_per_recording) + np.int32(i * blocks_per_recording)
                for i, n in enumerate(rows)
            ]
        ).astype(np.int32),
        sensor=np.repeat(np.arange(len(rows), dtype=np.int32), rows),
        sensor_names=tuple(f"lasa-finger{finger}" for finger in chosen),
        in_contact=touching,
        time_ns=None if rate_hz is None else np.rint(row * (1e9 / rate_hz)).astype(np.int64),
        provenance=Provenance(
            source=f"LASA force calibration (MiaoLi/syntouchcontact), {len(chosen)} real BioTac(s)",
            command=command,
            input_sha256=sha256_of(path),
            licence="none stated by the authors: measure, do not redistribute",
            palpate_version=__version__,
            notes="; ".join(notes),
        ),
        name=str(path),
    )


def _fingers_held(path: Path, names: Sequence[str], fingers: Sequence[int]) -> list[int]:
    """The fingers to read: those asked for, or all of which an archive with these names has any.

    Raises:
        DatasetError: It lacks one of them, or one of its arrays, or names one with zeros in front.
    """
    if zeros := [
        name
        for name in names
        if (match := _LASA_KEY_ZEROS.fullmatch(name)) and (not fingers or int(match[1]) in fingers)
    ]:
        raise DatasetError(
            f"{path} has {', '.join(zeros)}: numbers with zeros in front",
            remedy="name the arrays without them, as finger1_electrodes_raw",
        )
    held: dict[int, set[str]] = {}
    for name in names:
        if match := _LASA_KEY.fullmatch(name):
            held.setdefault(int(match[1]), set()).add(name)
    if not held:
        raise DatasetError(
            f"{path} holds no finger; it has: {', '.join(names[:12]) or 'nothing'}",
            remedy="give arrays finger1_electrodes_raw, finger1_baseline_mean and finger1_force_N,"
            " or of another number",
        )
    chosen = list(fingers) or sorted(held)
    for finger in chosen:
        if finger not in held:
            raise DatasetError(
                f"{path} has no finger {finger}; it has {', '.join(map(str, sorted(held)))}",
                remedy="name one that it has: --finger",
            )
    lacking = {
        finger: [
            name for what in _LASA_ARRAYS if (name := f"finger{finger}_{what}") not in held[finger]
        ]
        for finger in chosen
    }
    for finger, missing in lacking.items():
        if missing:
            rest = " ".join(f"--finger {one}" for one in chosen if not lacking[one])
            raise DatasetError(
                f"{path}: finger {finger} lacks {', '.join(missing)}",
                remedy="add it to the archive" + (f"; {rest} reads the rest" if rest else ""),
            )
    return chosen


def _check_finger(
    name: str,
    electrodes: npt.NDArray[Any],
    baseline: npt.NDArray[Any],
    force: npt.NDArray[Any],
) -> None:
    """Refuse arrays of a finger that no BioTac and no force sensor in newtons send.

    Raises:
        DatasetError: It says which, and the row of the archive.
    """
    for what, array in zip(_LASA_ARRAYS, (electrodes, baseline, force), strict=True):
        if array.dtype.kind not in "uif":
            raise DatasetError(
                f"{name}: {what} holds {array.dtype}, not real numbers",
                remedy="save whole counts, and forces in newtons",
            )
    rows = np.arange(len(electrodes))
    check_counts(electrodes, rows, name)
    if not np.isfinite(baseline).all():
        raise DatasetError(
            f"{name}: baseline_mean of E{np.isfinite(baseline).argmin() + 1} is not finite",
            remedy="give the mean of untouched rows",
        )
    unknown = np.flatnonzero(~np.isfinite(force).all(axis=1))
    if unknown.size:
        raise DatasetError(
            f"{name}: force_N is not finite in row {unknown[0]} ({unknown.size} rows in all)",
            remedy="drop these rows where the archive is made",
        )
    check_forces(force, rows, name)
    if (most := np.linalg.norm(force.astype(np.float64), axis=1).max()) <= TOUCH_N:
        raise DatasetError(
            f"{name}: no force is above {TOUCH_N:g} N, the largest is {most:.3g} N",
            remedy="give newtons, and presses",
        )
    mean = force.mean(axis=0, dtype=np.float64)
    if mean[2] > TOUCH_N and mean[2] >= np.abs(mean).max():
        _log.warning(
            "%s: the mean force along z is %.3g N, that of a finger pressed on its nail; if its pad"
            " was pressed, turn the sign of force_N round",
            name,
            -mean[2],
        )
