"""From one message to one estimate, or to the reason why there is none.

The functions that estimate are pure: they know no clock and keep no state, so that a replayed
record gives the same bytes again. What depends on time (how old a message is, whether its tare can
be found) is in the classes below them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import StrEnum
from math import sqrt
from typing import Generic, TypeVar

import numpy as np

from palpate import clock
from palpate.bus import Session
from palpate.bus.tares import TareBook
from palpate.errors import ClockSkewError, ErrorCode, PalpateError, RemoteError
from palpate.health import Health
from palpate.messages import (
    COUNTS_MAX,
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    FloatArray,
    Origin,
    QualityFlag,
    Stamp,
    SynthesisEstimate,
    Tare,
    as_field_frame,
)
from palpate_services.config import ElectrodesConfig, EstimatingConfig
from palpate_services.inference.model import Outputs, Place, Runtime

M = TypeVar("M")
E = TypeVar("E")

REPLAY_WAIT_S = 2.0
"""How long a lossless replay waits for a tare that arrives later than its first frame [s]."""

_MISSES_KEPT = 256

TARE_TDC_COUNTS = 45
"""A tare whose TDC lies farther from the frame's may not hold any more [counts]: about 1 K by the
maker's formula at 30 to 35 degrees C, and with it about 20 counts of each electrode (the
conductivity of the fluid changes by 2 % a kelvin), twice what a gateway calls drift."""


class EstimateRefusal(StrEnum):
    """Why a message got no estimate; the value is the name of its counter."""

    UNTARED = "untared"
    """The frame was taken before any tare; or the given tare is not the one that it names."""

    WRONG_TARE = "wrong_tare"
    """The tare that the frame names is that of another finger: of another serial number, or with
    another number of electrodes."""

    TARE_UNKNOWN = "tare_unknown"
    """No gateway knows the tare that the frame names."""

    INVALID_CHANNELS = "invalid_channels"
    """At least one electrode is marked bad."""

    WRONG_SENSOR = "wrong_sensor"
    """The bundle was made for another type of sensor."""

    WRONG_MESH = "wrong_mesh"
    """The field belongs to another mesh than the bundle's."""

    NON_FINITE = "non_finite"
    """Input or output holds NaN or infinity, or a standard deviation is negative."""

    STALE = "stale"
    """The message is older than ``max_age_s``."""

    CLOCK_SKEW = "clock_skew"
    """The message was stamped in the future, so that its age is not known."""

    REPLAYED = "replayed_refused"
    """The message was replayed, and the service accepts only live and simulated ones."""

    NO_MODEL = "no_model"
    """The bundle of the sensor was unloaded, or could not be found again after a restart."""

    SKIPPED_RATE = "skipped_rate"
    """The estimate of this period was already published (``rate_hz``)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """What a model gets of a message, and what is known against it before the model runs.

    Attributes:
        values: The model's one input without batch axis.
        quality: Flags in ascending order.
    """

    values: FloatArray
    quality: tuple[QualityFlag, ...] = ()


def tared_counts(frame: ElectrodeFrame, tare: Tare) -> FloatArray:
    """Electrodes minus baseline [counts], float32, shape ``(19,)``."""
    return np.subtract(frame.electrodes, tare.electrodes, dtype=np.float32)


def estimate(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FeatureEstimate | EstimateRefusal:
    """Estimate the features of one frame, or say why there is no estimate; never from bad input.

    ``tare`` is the one that ``frame.tare_id`` names, None if it is not known; ``runtime`` is a
    bundle of the task ``features``.
    """
    return _completed(frame, sample_of_frame(frame, tare, runtime), runtime, features_of)


def estimate_field(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FieldEstimate | EstimateRefusal:
    """Estimate the displacement of each node of the bundle's mesh; as ``estimate`` otherwise."""
    return _completed(frame, sample_of_frame(frame, tare, runtime), runtime, field_of)


def synthesise(
    field: FieldFrame | FieldEstimate, runtime: Runtime
) -> SynthesisEstimate | EstimateRefusal:
    """Estimate the tared counts that belong to a displacement field on the mesh of the bundle.

    Returns the estimate, or why there is none; ``runtime`` is a bundle of the task ``synthesis``.
    """
    return _completed(field, sample_of_field(field, runtime), runtime, synthesis_of)


def _completed(
    message: M,
    sample: Sample | EstimateRefusal,
    runtime: Runtime,
    complete: Callable[[M, Sample, Outputs, Runtime], E],
) -> E | EstimateRefusal:
    if isinstance(sample, EstimateRefusal):
        return sample
    outputs = runtime.run(sample.values)
    return (
        EstimateRefusal.NON_FINITE
        if outputs is None
        else complete(message, sample, outputs, runtime)
    )


# An estimate is made in three parts, so that the middle one, the model, can run on the samples of
# several sensors at once: the sample of a message, the model's outputs, and the estimate.


def sample_of_frame(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> Sample | EstimateRefusal:
    """What the model of a bundle gets of a frame: tared counts; or why it gets nothing."""
    if frame.sensor_type is not runtime.sensor_type:
        return EstimateRefusal.WRONG_SENSOR
    if tare is None or frame.tare_id == NO_TARE or tare.tare_id != frame.tare_id:
        return EstimateRefusal.UNTARED
    if (
        tare.electrodes.shape != frame.electrodes.shape
        or tare.sensor_serial != frame.sensor_serial  # of a finger that was exchanged
    ):
        return EstimateRefusal.WRONG_TARE
    if not frame.electrodes_valid:
        return EstimateRefusal.INVALID_CHANNELS
    quality = quality_of_frame(frame, tare)
    if not runtime.made_for(frame.sensor_serial):
        quality = (*quality, QualityFlag.UNCALIBRATED)
    return Sample(tared_counts(frame, tare), quality)


def quality_of_frame(frame: ElectrodeFrame, tare: Tare) -> tuple[QualityFlag, ...]:
    """What is to be said against a frame and its tare, whatever the model."""
    flags: tuple[QualityFlag, ...] = ()
    counts = frame.electrodes.tolist()  # for so few numbers plain Python is faster than NumPy
    if 0 in counts or COUNTS_MAX in counts:
        flags = (QualityFlag.SATURATED,)
    if tare.tdc and abs(frame.tdc - tare.tdc) > TARE_TDC_COUNTS:  # 0 = unknown
        tdc_valid = frame.validity >> frame.sensor_type.layout.tdc_bit & 1
        flags = (*flags, QualityFlag.UNTARED) if tdc_valid else flags
    return flags


def sample_of_field(
    field: FieldFrame | FieldEstimate, runtime: Runtime
) -> Sample | EstimateRefusal:
    """What the model of a bundle gets of a field: its displacements; or why it gets nothing."""
    known = as_field_frame(field)
    sample = known.displacement.reshape(-1)
    if known.mesh_sha256 != runtime.mesh_sha256 or sample.shape != runtime.sample_shape:
        return EstimateRefusal.WRONG_MESH
    # The network may hide a NaN: a rectifier (max(x, 0)) turns it into 0 on some machines.
    if not np.isfinite(sample).all():
        return EstimateRefusal.NON_FINITE
    # A doubtful field makes doubtful electrodes.
    return Sample(sample, field.quality if isinstance(field, FieldEstimate) else ())


def _quality(
    sample: Sample,
    outputs: Outputs,
    runtime: Runtime,
    *,
    without: Collection[str] = (),
    place: Place | None = None,
) -> tuple[QualityFlag, ...]:
    """All flags of an estimate, in ascending order, each once."""
    found = runtime.range.flags(sample.values, outputs, without=without, place=place)
    if not sample.quality:
        return found
    return tuple(sorted({*sample.quality, *found}))


def features_of(
    frame: ElectrodeFrame, sample: Sample, outputs: Outputs, runtime: Runtime
) -> FeatureEstimate:
    """The features of a frame, from its sample and what the model made of it."""
    force = outputs["force"]
    normal = outputs.get("contact_normal")
    # In doubles and without NumPy: three values are faster so, and the threshold is a double.
    x, y, z = force.tolist()
    size = sqrt(x * x + y * y + z * z)
    in_contact = size >= runtime.contact_threshold_n
    place = runtime.range.place(sample.values)
    return FeatureEstimate(
        source=frame.stamp,
        sensor_serial=frame.sensor_serial,
        bundle_sha256=runtime.sha256,
        tare_id=frame.tare_id,
        in_contact=in_contact,
        force=force,
        force_sd=outputs["force_sd"],
        contact_location=outputs.get("contact_location") if in_contact else None,
        contact_location_sd=outputs.get("contact_location_sd") if in_contact else None,
        quality=_quality(
            sample, outputs, runtime, without=() if in_contact else _OF_CONTACT, place=place
        ),
        bundle_name=runtime.name,
        bundle_version=runtime.version,
        centre_of_pressure=outputs.get("centre_of_pressure") if in_contact else None,
        centre_of_pressure_sd=outputs.get("centre_of_pressure_sd") if in_contact else None,
        contact_normal=normal if in_contact else None,
        contact_normal_sd=float(outputs["contact_normal_sd"][0])
        if in_contact and normal is not None
        else None,
        bounds=runtime.bounds(
            size,
            place,
            others=QualityFlag.UNCALIBRATED in sample.quality,
            contact=in_contact and "contact_location" in outputs,
        ),
    )


_OF_CONTACT = (
    "contact_location",
    "contact_location_sd",
    "centre_of_pressure",
    "centre_of_pressure_sd",
    "contact_normal",
    "contact_normal_sd",
)
"""Outputs that mean nothing without a contact."""


def field_of(
    frame: ElectrodeFrame, sample: Sample, outputs: Outputs, runtime: Runtime
) -> FieldEstimate:
    """The field of a frame, from its sample and what the model made of it."""
    force = outputs.get("contact_force")
    place = runtime.range.place(sample.values)
    coefficients = outputs.get("coefficients")
    size_mm = 0.0 if coefficients is None else 1e3 * sqrt(float(coefficients @ coefficients))
    return FieldEstimate(
        source=frame.stamp,
        sensor_serial=frame.sensor_serial,
        bundle_sha256=runtime.sha256,
        tare_id=frame.tare_id,
        mesh_sha256=runtime.mesh_sha256,
        displacement=outputs["displacement"].reshape(-1, 3),
        displacement_sd=outputs.get("displacement_sd"),
        contact_force=None if force is None else force.reshape(-1, 3),
        quality=_quality(sample, outputs, runtime, place=place),
        bundle_name=runtime.name,
        bundle_version=runtime.version,
        coefficients=coefficients,
        basis_sha256=b"" if runtime.basis is None else runtime.basis.sha256,
        bounds=runtime.bounds(size_mm, place, others=QualityFlag.UNCALIBRATED in sample.quality),
    )


def synthesis_of(
    field: FieldFrame | FieldEstimate, sample: Sample, outputs: Outputs, runtime: Runtime
) -> SynthesisEstimate:
    """The electrodes of a field, from its sample and what the model made of it."""
    known = as_field_frame(field)
    return SynthesisEstimate(
        source=known.stamp,
        sensor_serial=known.sensor_serial,
        bundle_sha256=runtime.sha256,
        mesh_sha256=runtime.mesh_sha256,
        tared_counts=outputs["tared_counts"],
        tared_counts_sd=outputs["tared_counts_sd"],
        quality=_quality(sample, outputs, runtime),
        bundle_name=runtime.name,
        bundle_version=runtime.version,
    )


@dataclass(frozen=True, slots=True)
class Estimation(Generic[M, E]):
    """How a service makes estimates of its messages.

    Attributes:
        sample: From a sensor's name, one of its messages and the bundle to what the model gets, or
            to why there is no estimate.
        complete: From the message, its sample, what the model made of it, and the bundle to the
            estimate.
    """

    sample: Callable[[str, M, Runtime], Sample | EstimateRefusal]
    complete: Callable[[M, Sample, Outputs, Runtime], E]

    def one(self, sensor: str, message: M, runtime: Runtime | None) -> E | EstimateRefusal:
        """The estimate of one message, or why there is none; without a bundle there is none."""
        if runtime is None:
            return EstimateRefusal.NO_MODEL
        sample = self.sample(sensor, message, runtime)
        return _completed(message, sample, runtime, self.complete)


class AgeLimit:
    """Decides by ``max_age_s`` and ``accept_replayed`` whether a message may be answered.

    ``wall_clock_error_s`` is how far the wall clocks of other hosts may be from this host's [s].
    """

    def __init__(self, config: EstimatingConfig, wall_clock_error_s: float) -> None:
        self._limit_s = config.max_age_s
        self._wall_clock_error_s = wall_clock_error_s
        self._accept_replayed = config.accept_replayed

    def refusal(self, stamp: Stamp) -> EstimateRefusal | None:
        """Why a message with this stamp gets no estimate; None = it may get one."""
        # The age of a replayed message says nothing: its stamp is that of the recording.
        if stamp.origin is Origin.REPLAYED:
            return None if self._accept_replayed else EstimateRefusal.REPLAYED
        limit_s = self._limit_s
        if limit_s is None:
            return None
        try:
            age_s = clock.checked_age_s(stamp, wall_clock_error_s=self._wall_clock_error_s)
        except ClockSkewError:
            return EstimateRefusal.CLOCK_SKEW
        return EstimateRefusal.STALE if age_s > limit_s else None


class TareLookup:
    """Finds the tares that frames name in the station's ``book``. Use from one thread.

    A frame that names a tare for the first time waits for it for up to ``wait_s`` [s]. If that was
    in vain, later frames do not wait, because that would block the thread that serves all sensors;
    the book goes on asking for it. In a ``replay`` a frame may arrive before its tare. With
    ``again`` each frame waits: right for a request.
    """

    def __init__(
        self, book: TareBook, *, wait_s: float, replay: bool = False, again: bool = False
    ) -> None:
        self._book = book
        self._wait_s, self._replay, self._again = wait_s, replay, again
        self._in_vain: dict[tuple[str, int], None] = {}

    def find(self, sensor: str, tare_id: int) -> tuple[Tare | None, bool]:
        """The tare that a frame names by ``tare_id``, which is not ``NO_TARE``; None if unknown.

        The second value says whether the search may have taken time.
        """
        tare = self._book.find(sensor, tare_id)
        if tare is not None or (sensor, tare_id) in self._in_vain:
            return tare, False
        try:
            tare = self._book.baseline(
                sensor, tare_id, timeout_s=self._wait_s, patient=self._replay
            )
        except PalpateError:
            if not self._again:
                self._in_vain[sensor, tare_id] = None
                while len(self._in_vain) > _MISSES_KEPT:
                    self._in_vain.pop(next(iter(self._in_vain)))
        return tare, True


class TaredSamples:
    """The samples of electrode frames, each with the tare that it names. Use from one thread.

    ``health`` gets one error for each sensor whose type its bundle was not made for.

    With ``any_age`` also a frame that became too old during the search for its tare is taken:
    right for a request, whose sender wants this very frame.
    """

    def __init__(
        self,
        session: Session,
        config: ElectrodesConfig,
        health: Health,
        *,
        any_age: bool = False,
    ) -> None:
        replay = config.delivery == "every"
        wait_s = REPLAY_WAIT_S if replay else config.tare_timeout_s
        self._tares = TareLookup(TareBook(session), wait_s=wait_s, replay=replay, again=any_age)
        self._age_limit = None if any_age else AgeLimit(config, session.wall_clock_error_s)
        self._health = health
        self._wrong_sensors: set[tuple[str, bytes]] = set()

    def take(
        self, sensor: str, frame: ElectrodeFrame, runtime: Runtime
    ) -> Sample | EstimateRefusal:
        """The sample of a frame for the model of a bundle, or why there is no estimate."""
        if frame.sensor_type is not runtime.sensor_type:
            self._report_wrong_sensor(sensor, frame, runtime)
            return EstimateRefusal.WRONG_SENSOR
        tare = None
        if frame.tare_id != NO_TARE:
            tare, waited = self._tares.find(sensor, frame.tare_id)
            if tare is None:
                return EstimateRefusal.TARE_UNKNOWN
            if waited and self._age_limit is not None:
                refusal = self._age_limit.refusal(frame.stamp)
                if refusal is not None:
                    return refusal
        return sample_of_frame(frame, tare, runtime)

    def _report_wrong_sensor(self, sensor: str, frame: ElectrodeFrame, runtime: Runtime) -> None:
        """Report each such pair once; the counter ``wrong_sensor`` counts all frames."""
        pair = (sensor, runtime.sha256)
        if pair in self._wrong_sensors or len(self._wrong_sensors) >= _MISSES_KEPT:
            return
        self._wrong_sensors.add(pair)
        kind = frame.sensor_type
        error = RemoteError(
            f"sensor {sensor!r} is a {kind.name} with {kind.layout.electrodes} electrodes, the "
            f"bundle {runtime.label} is made for a {runtime.sensor_type.name}",
            remedy="no bundle is made for this type yet: name the sensors to serve in the table of "
            "this service, sensors = [...]",
            code=ErrorCode.INVALID_REQUEST,
        )
        # It degrades when nothing else has come of it for a second: InputReport.
        self._health.fail(error, degraded=False)
