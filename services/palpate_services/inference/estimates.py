"""From a frame to its estimate: find the tare that it names, then ask the pure function."""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import StrEnum
from math import sqrt
from typing import Generic, TypeVar

import numpy as np

from palpate import clock
from palpate.bus import Session
from palpate.bus.tares import TareBook
from palpate.errors import ErrorCode, PalpateError, RemoteError
from palpate.health import Health
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldFrame,
    FloatArray,
    Origin,
    Stamp,
    SynthesisEstimate,
    Tare,
    as_field_frame,
)
from palpate_services.config import AnswererConfig, ElectrodesConfig
from palpate_services.inference.model import Runtime


class Refusal(StrEnum):
    """Why a message got no estimate; the value is the name it is counted by."""

    UNTARED = "untared"
    """The frame was taken before any tare, or the tare given is not the one it names or has another
    number of electrodes."""

    INVALID_CHANNELS = "invalid_channels"
    """At least one electrode is marked bad."""

    WRONG_SENSOR = "wrong_sensor"
    """The bundle was made for another type of sensor."""

    WRONG_MESH = "wrong_mesh"
    """The field is one of another mesh than the bundle's."""

    NON_FINITE = "non_finite"
    """The input holds NaN or infinity, or the model answered so, or with a negative deviation."""


def tared_counts(frame: ElectrodeFrame, tare: Tare) -> FloatArray:
    """Electrodes minus baseline [counts], float32, shape ``(19,)``."""
    return np.subtract(frame.electrodes, tare.electrodes, dtype=np.float32)


def estimate(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FeatureEstimate | Refusal:
    """Estimate the features of one frame.

    Args:
        frame: Raw counts of one sampling round.
        tare: The tare that ``frame.tare_id`` names; None where nobody knows it.
        runtime: A loaded bundle of the task ``features``.

    Returns:
        The estimate, or why there is none. Never an estimate from bad input.
    """
    outputs = _run_on_electrodes(frame, tare, runtime)
    if isinstance(outputs, Refusal):
        return outputs
    force = outputs["force"]
    x, y, z = force.tolist()
    in_contact = sqrt(x * x + y * y + z * z) >= runtime.contact_threshold_n
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
    )


def estimate_field(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> FieldEstimate | Refusal:
    """Estimate the displacement of each skin node from one frame.

    Args:
        frame: Raw counts of one sampling round.
        tare: The tare that ``frame.tare_id`` names; None where nobody knows it.
        runtime: A loaded bundle of the task ``field``.

    Returns:
        The estimate on the bundle's mesh, or why there is none.
    """
    outputs = _run_on_electrodes(frame, tare, runtime)
    if isinstance(outputs, Refusal):
        return outputs
    return FieldEstimate(
        source=frame.stamp,
        sensor_serial=frame.sensor_serial,
        bundle_sha256=runtime.sha256,
        tare_id=frame.tare_id,
        mesh_sha256=runtime.mesh_sha256,
        displacement=outputs["displacement"].reshape(-1, 3),
        displacement_sd=outputs.get("displacement_sd"),
    )


def synthesise(field: FieldFrame | FieldEstimate, runtime: Runtime) -> SynthesisEstimate | Refusal:
    """Estimate the tared counts that go with a displacement field.

    Args:
        field: Known or estimated, on the mesh of the bundle.
        runtime: A loaded bundle of the task ``synthesis``.

    Returns:
        The estimate, or why there is none.
    """
    known = as_field_frame(field)
    sample = known.displacement.reshape(-1)
    if known.mesh_sha256 != runtime.mesh_sha256 or sample.shape != runtime.sample_shape:
        return Refusal.WRONG_MESH
    # A network may hide it: a rectifier turns NaN into 0 on some machines.
    if not np.isfinite(sample).all():
        return Refusal.NON_FINITE
    outputs = runtime.run(sample)
    if outputs is None:
        return Refusal.NON_FINITE
    return SynthesisEstimate(
        source=known.stamp,
        sensor_serial=known.sensor_serial,
        bundle_sha256=runtime.sha256,
        mesh_sha256=runtime.mesh_sha256,
        tared_counts=outputs["tared_counts"],
        tared_counts_sd=outputs["tared_counts_sd"],
    )


def _run_on_electrodes(
    frame: ElectrodeFrame, tare: Tare | None, runtime: Runtime
) -> dict[str, FloatArray] | Refusal:
    """Outputs of a model for the tared counts of a frame, or why there are none."""
    if frame.sensor_type is not runtime.sensor_type:
        return Refusal.WRONG_SENSOR
    if tare is None or frame.tare_id == NO_TARE or tare.tare_id != frame.tare_id:
        return Refusal.UNTARED
    if tare.electrodes.shape != frame.electrodes.shape:  # of the finger that was there before
        return Refusal.UNTARED
    if not frame.electrodes_valid:
        return Refusal.INVALID_CHANNELS
    outputs = runtime.run(tared_counts(frame, tare))
    return Refusal.NON_FINITE if outputs is None else outputs


FIRST_RETRY_S = 0.5
"""After a first miss the same tare is asked for again no sooner than this."""

LAST_RETRY_S = 5.0
"""Longest time between two questions for the same tare; it doubles up to here."""

PATIENCE_S = 2.0
"""How long a lossless replay waits for a tare, which may overtake nothing but can be overtaken."""

_REMEMBERED = 256


class Baselines:
    """Looks tares up, and after a miss leaves the gateway alone for a while. One thread only.

    Args:
        book: The station's tares.
        patient: Wait for a tare instead of answering that nobody knows it (lossless replay).
    """

    def __init__(self, book: TareBook, *, patient: bool) -> None:
        self._book = book
        self._patient = patient
        self._misses: dict[tuple[str, int], tuple[float, float]] = {}

    def find(self, sensor: str, tare_id: int) -> tuple[Tare | None, bool]:
        """The tare a frame names.

        Args:
            sensor: Name of the sensor.
            tare_id: From the frame; not ``NO_TARE``.

        Returns:
            The tare, or None if nobody knows it; and whether looking for it may have taken time.
        """
        key = (sensor, tare_id)
        miss = self._misses.get(key) if self._misses else None
        if miss is not None and time.monotonic() < miss[0]:
            return None, False
        began_s = time.monotonic()
        while True:
            try:
                tare = self._book.baseline(sensor, tare_id)
            except PalpateError:
                if self._patient and miss is None and time.monotonic() - began_s < PATIENCE_S:
                    time.sleep(0.02)
                    continue
                self._remember_miss(key, FIRST_RETRY_S if miss is None else 2 * miss[1])
                return None, True
            if miss is not None:
                del self._misses[key]
            return tare, time.monotonic() - began_s > 1e-3

    def _remember_miss(self, key: tuple[str, int], wait_s: float) -> None:
        wait_s = min(wait_s, LAST_RETRY_S)
        self._misses[key] = (time.monotonic() + wait_s, wait_s)
        while len(self._misses) > _REMEMBERED:
            self._misses.pop(next(iter(self._misses)))


E = TypeVar("E")

TARE_UNKNOWN = "tare_unknown"


class Freshness:
    """Whether a message may still be acted on.

    Args:
        config: The oldest that may, and whether replayed ones may.
    """

    def __init__(self, config: AnswererConfig) -> None:
        self._limit_s = config.max_age_s
        self._accept_replayed = config.accept_replayed

    def refusal(self, stamp: Stamp) -> str | None:
        """Why a message of this stamp gets no estimate; None = it may get one."""
        if stamp.origin is Origin.REPLAYED:
            return None if self._accept_replayed else "replayed_refused"
        limit_s = self._limit_s
        return "stale" if limit_s is not None and clock.age_s(stamp) > limit_s else None


class TaredFrames(Generic[E]):
    """Answers frames, each with its own tare. Use from one thread.

    Args:
        session: Where tares are heard of and asked for.
        config: How long to wait for one.
        runtime: The loaded bundle.
        estimate: The pure function of frame, tare and bundle.
        health: Told once of each sensor that the bundle is not for.
        any_age: Answer a frame that has grown old while its tare was looked for: somebody asked
            for this very frame.
    """

    def __init__(
        self,
        session: Session,
        config: ElectrodesConfig,
        runtime: Runtime,
        estimate: Callable[[ElectrodeFrame, Tare | None, Runtime], E | Refusal],
        health: Health,
        *,
        any_age: bool = False,
    ) -> None:
        book = TareBook(session, query_timeout_s=config.tare_timeout_s)
        self._baselines = Baselines(book, patient=config.delivery == "every")
        self._freshness = None if any_age else Freshness(config)
        self._runtime = runtime
        self._estimate = estimate
        self._health = health
        self._others: set[str] = set()

    def answer(self, sensor: str, frame: ElectrodeFrame) -> E | str:
        """The estimate of a frame, or the reason why there is none.

        Args:
            sensor: Name of the sensor.
            frame: Raw counts of one sampling round.
        """
        if frame.sensor_type is not self._runtime.sensor_type:
            self._tell(sensor, frame)
            return Refusal.WRONG_SENSOR
        tare = None
        if frame.tare_id != NO_TARE:
            tare, waited = self._baselines.find(sensor, frame.tare_id)
            if tare is None:
                return TARE_UNKNOWN
            if waited and self._freshness is not None:
                reason = self._freshness.refusal(frame.stamp)
                if reason is not None:
                    return reason
        return self._estimate(frame, tare, self._runtime)

    def _tell(self, sensor: str, frame: ElectrodeFrame) -> None:
        """Say once that there will be no estimates of a sensor; all its frames are counted."""
        if sensor in self._others:
            return
        self._others.add(sensor)
        manifest, kind = self._runtime.manifest, frame.sensor_type
        error = RemoteError(
            f"sensor {sensor!r} is a {kind.name} with {kind.layout.electrodes} electrodes, the "
            f"bundle {manifest.name}:{manifest.version} is made for a {manifest.sensor_type}",
            remedy=f"name the other sensors in the option sensors, or serve a bundle for a "
            f"{kind.name}",
            code=ErrorCode.INVALID_REQUEST,
        )
        # The sensors it is for are served as before.
        self._health.fail(error, degraded=False)
