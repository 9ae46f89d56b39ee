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
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate import __version__
from palpate.alignment import linear, times_of
from palpate.errors import DatasetError
from palpate.messages import NO_TARE
from palpate_training.datasets.container import Provenance, read_archive, sha256_of
from palpate_training.datasets.features import (
    ELECTRODES,
    FeatureDataset,
    check_counts,
    check_forces,
    cut_into_blocks,
)
from palpate_training.datasets.record_streams import (
    OVERLOAD,
    SensorStreams,
    check_streams,
    force_at,
    middles,
    read_streams,
    serials_of,
)

_log = logging.getLogger(__name__)

TOUCH_N = 0.2
"""Without a pose that knows contact, a force above this is contact [N]; it is above the noise of a
6-axis sensor."""

MANY_LEFT_OUT = 0.01
"""A larger share of frames that are left out is told as a warning."""

PRESS_N = 0.5
"""What does not reach this force is no press [N]."""


def ingest_record(
    path: Path,
    *,
    sensors: Collection[str] = (),
    command: str = "",
    licence: str = "own record",
) -> FeatureDataset:
    """Read an MCAP record.

    A row is a valid, tared electrode frame in whose middle there is a wrench (and a pose, where the
    record has poses of that sensor): between two readings that are at most three periods apart, and
    in neither of which the force/torque sensor was overloaded. A group is a press: it ends halfway
    between two contacts.
    Where the source of the poses cannot know whether it touches, a force above ``TOUCH_N`` counts
    as contact, and as a press of its own only what reaches ``PRESS_N``.

    Args:
        path: ``NAME.mcap``.
        sensors: Names of the fingers to read; none = all.
        command: The command line, for provenance.
        licence: What may be done with the rows.

    Raises:
        RecordingError: Not a whole record.
        DatasetError: The record lacks a finger or a stream, no row could be aligned, a sensor is no
            BioTac with 19 electrodes, was exchanged for another, or its clock goes back; or there
            is a force where the pose says that nothing touches.
    """
    streams = read_streams(path)
    for name in sensors:
        if name not in streams:
            raise DatasetError(
                f"{path} holds no sensor {name!r}",
                remedy=f"it holds: {', '.join(sorted(streams)) or 'none'}",
            )
    if sensors:
        streams = {name: streams[name] for name in sensors}
    return rows_of_streams(path, streams, command=command, licence=licence)


def rows_of_streams(
    path: Path,
    sensors: Mapping[str, SensorStreams],
    *,
    command: str = "",
    licence: str = "own record",
) -> FeatureDataset:
    """As ``ingest_record``, of streams that were read already, or of some of them."""
    parts: list[dict[str, npt.NDArray[Any]]] = []
    notes = ["wrench and pose at the middle of each frame; group = press"]
    fingers = {name: streams for name, streams in sorted(sensors.items()) if streams.frames}
    names = list(fingers)
    for name, streams in fingers.items():
        try:
            part = _align(path, name, streams, notes)
        except DatasetError as error:
            rest = [f"--sensor {one}" for one in names if one != name and fingers[one].wrenches]
            if not rest:
                raise
            raise DatasetError(
                error.problem,
                remedy=f"{error.remedy}; or read the others alone: palpate data ingest-record "
                + " ".join(rest),
            ) from error
        part["sensor"] = np.full(len(part["group"]), len(parts), dtype=np.int32)
        if parts:
            part["group"] = part["group"] + np.int32(parts[-1]["group"].max() + 1)
        parts.append(part)
    if not parts:
        raise DatasetError(
            f"{path}: no electrode frames", remedy="record the stream electrodes of a sensor"
        )
    without = [
        name for name, part in zip(names, parts, strict=True) if "contact_location" not in part
    ]
    if without:
        if len(without) < len(parts):
            notes.append(f"no contact locations, because {', '.join(without)} has no pose")
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
            notes="; ".join(notes),
        ),
        name=str(path),
    )


def _align(
    path: Path, name: str, streams: SensorStreams, notes: list[str]
) -> dict[str, npt.NDArray[Any]]:
    """Columns of one finger; what a reader of the rows must know goes to ``notes``."""
    check_streams(path, name, streams)
    notes.extend(f"serial number of {name}: {serial}" for serial in serials_of(streams))
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

    force, kept, overloaded = force_at(path, name, at, streams, clock)
    if overloaded:
        notes.append(f"{overloaded} rows of {name} left out: {OVERLOAD}")
    location = None
    strength = np.linalg.norm(force, axis=1)
    touching, pressing = strength > TOUCH_N, strength >= PRESS_N
    told = np.zeros(len(at), dtype=np.bool_)
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
            f"{path}: no frame of {name!r} has a wrench (and pose) within three periods"
            + (f", but {overloaded} in which {OVERLOAD}" if overloaded else ""),
            remedy="press more gently"
            if overloaded
            else "check that all streams were stamped by the same clock",
        )
    _check_zero(path, name, strength[kept & told & ~touching])
    by_force = strength[kept & ~told]
    if by_force.size and (least := by_force.min()) > TOUCH_N:
        never = f"the force on {name} is never below {least:.2f} N, so all counts as one press"
        notes.append(never)
        _log.warning(
            "%s: %s; if nothing touched at times, the force/torque sensor was not zeroed, and every"
            " force is wrong by as much",
            path,
            never,
        )
    unusable = len(streams.frames) - len(frames)
    apart = len(frames) - int(kept.sum()) - overloaded  # these are told already
    if unusable or apart:
        pair = "force and pose" if streams.poses else "force"
        left_out = (
            f"{unusable + apart} of {len(streams.frames)} frames of {name} left out: {unusable} not"
            f" valid or with no tare in the record, {apart} with no {pair} within three periods"
        )
        notes.append(left_out)
        # A frame or two before the first force is no news.
        many = unusable + apart > MANY_LEFT_OUT * len(streams.frames)
        _log.log(logging.WARNING if many else logging.INFO, "%s: %s", path, left_out)

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


def _check_zero(path: Path, name: str, untouched_n: npt.NDArray[np.float64]) -> None:
    """Refuse a finger with a force where its pose says that nothing touches.

    Raises:
        DatasetError: The median of these magnitudes [N] is a touch.
    """
    if untouched_n.size and (usual := np.median(untouched_n)) > TOUCH_N:
        raise DatasetError(
            f"{path}: the median force on {name!r} is {usual:.2f} N in the {untouched_n.size}"
            " frames in which its pose says that nothing touches",
            remedy="zero the force/torque sensor before recording, while nothing touches: palpate"
            " tare NAME; or correct in_contact where the poses are made",
        )


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
