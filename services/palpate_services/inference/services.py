"""The three estimating services: features, field and synthesis; streams, and questions.

A caller may ask about a frame of any age. Its answer says so (``STALE``) if the frame was too old
for the stream when the question came; all else in it is as pure as an estimate of the stream.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np

from palpate.bus import QueryAnswer, Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, FIELD_TRUTH, SYNTHESIS
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, RemoteError
from palpate.health import Health
from palpate.messages import (
    BasisRequest,
    ElectrodeFrame,
    FeatureEstimate,
    FeatureRequest,
    FieldEstimate,
    FieldRequest,
    ModeBasis,
    QualityFlag,
    StageTimings,
)
from palpate_services.config import (
    ElectrodesConfig,
    EstimatingConfig,
    FeaturesServiceConfig,
    FieldServiceConfig,
    ModelsConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.estimates import (
    AgeLimit,
    EstimateRefusal,
    Estimation,
    Sample,
    TaredSamples,
    features_of,
    field_of,
    sample_of_field,
    synthesis_of,
)
from palpate_services.inference.loop import ServiceRoute, arrival_age_s, refuse, reply, serve
from palpate_services.inference.model import Outputs, Runtime
from palpate_services.inference.served import ServedModels
from palpate_services.inference.synthesis_requests import SynthesisRequests

Q = TypeVar("Q", bound=FeatureRequest | FieldRequest)
E = TypeVar("E", bound=FeatureEstimate | FieldEstimate)


class AskedEstimates(Generic[Q, E]):
    """Answers questions about electrode frames. Use from one thread.

    ``complete`` makes the estimate of a request from its sample and what the model made of it.
    """

    def __init__(
        self,
        session: Session,
        config: ElectrodesConfig,
        models: ServedModels,
        health: Health,
        complete: Callable[[Q, Sample, Outputs, Runtime], E],
    ) -> None:
        # The stream's samples are taken in a thread of their own.
        self._samples = TaredSamples(session, config, health, any_age=True)
        self._age_limit = AgeLimit(config, session.wall_clock_error_s)
        self._models = models
        self._health = health
        self._complete = complete

    def handle(self, request: Q, answer: QueryAnswer[E]) -> None:
        """Answer a question, or raise the ``RemoteError`` that says why there is no estimate."""
        began_ns = time.monotonic_ns()
        frame: ElectrodeFrame = request.frame
        stale = self._age_limit.refusal(frame.stamp) is EstimateRefusal.STALE
        runtime = self._models.of(request.sensor)
        if runtime is None:
            refuse(EstimateRefusal.NO_MODEL, self._health)
        sample = self._samples.take(request.sensor, frame, runtime)
        if isinstance(sample, EstimateRefusal):
            refuse(sample, self._health)
        sampled_ns = time.monotonic_ns()
        outputs = runtime.run(sample.values)
        if outputs is None:
            refuse(EstimateRefusal.NON_FINITE, self._health)
        ran_ns = time.monotonic_ns()
        estimate = self._complete(request, sample, outputs, runtime)
        if stale:
            quality = tuple(sorted({*estimate.quality, QualityFlag.STALE}))
            estimate = replace(estimate, quality=quality)
        self._health.count("asked")
        timings = StageTimings(
            arrival_age_s(frame.stamp, answer.arrived_ns),
            max(0.0, (began_ns - answer.arrived_ns) * 1e-9 - answer.decode_s),
            answer.decode_s,
            (sampled_ns - began_ns) * 1e-9,
            (ran_ns - sampled_ns) * 1e-9,
            0.0,
        )
        answer.send(estimate, timings=timings)
        answer.end()


_FEATURES = ServiceRoute("features", ELECTRODES, FEATURES, "frames_received")
_FIELD = ServiceRoute("field", ELECTRODES, FIELD, "frames_received")
_SYNTHESIS: dict[str, ServiceRoute[Any, Any]] = {
    "truth": ServiceRoute("synthesis", FIELD_TRUTH, SYNTHESIS, "fields_received"),
    "estimate": ServiceRoute("synthesis", FIELD, SYNTHESIS, "fields_received"),
}  # by SynthesisServiceConfig.source


def run_estimating(
    config: EstimatingConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str | None = None,
    models: ModelsConfig | None = None,
) -> None:
    """Serve the service whose table of the profile ``config`` is, until ``stop`` is set.

    Features are estimated from electrodes, as are fields, at a limited rate; synthesis goes from
    fields to tared counts. The endpoint ``estimate`` of the first two replies with the estimate of
    the frame in a request, ``basis`` of the field service with what decodes coefficients;
    ``synthesise`` replies with the tared counts of the field in a request, and ``synthesise_from``
    with those of a field, a described contact or a simulation.
    ``instance`` names this process among several of its kind; None = like the service. ``models``
    says where the user's bundles are and what is remembered; None = packaged bundles only, which
    nobody can change.

    Raises:
        ConfigError: There is no such bundle.
        BundleError: The bundle breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
        LinkError: The bus cannot be joined.
    """
    run = partial(
        serve,
        config=config,
        link=link,
        station=station,
        stop=stop,
        instance=instance,
        kept=models,
    )
    if isinstance(config, FeaturesServiceConfig):
        run(_FEATURES, prepare=partial(_features, config))
    elif isinstance(config, FieldServiceConfig):
        run(_FIELD, prepare=partial(_field, config), rate_hz=config.rate_hz)
    elif isinstance(config, SynthesisServiceConfig):
        run(_SYNTHESIS[config.source], prepare=partial(_synthesis, config))


def _features(
    config: FeaturesServiceConfig, session: Session, models: ServedModels, health: Health
) -> Estimation[Any, Any]:
    asked = AskedEstimates[FeatureRequest, FeatureEstimate](
        session, config, models, health, lambda request, *made: features_of(request.frame, *made)
    )
    session.stream_queryable(
        endpoints.ESTIMATE_FEATURES, asked.handle, service="features", instance=health.instance
    )
    return Estimation(TaredSamples(session, config, health).take, features_of)


def _field(
    config: FieldServiceConfig, session: Session, models: ServedModels, health: Health
) -> Estimation[Any, Any]:
    asked = AskedEstimates[FieldRequest, FieldEstimate](
        session, config, models, health, _asked_field
    )
    name = health.instance
    session.stream_queryable(endpoints.ESTIMATE_FIELD, asked.handle, service="field", instance=name)
    session.stream_queryable(
        endpoints.BASIS, partial(_send_basis, models), service="field", instance=name
    )
    return Estimation(TaredSamples(session, config, health).take, field_of)


def _asked_field(
    request: FieldRequest, sample: Sample, outputs: Outputs, runtime: Runtime
) -> FieldEstimate:
    field = field_of(request.frame, sample, outputs, runtime)
    if not request.reduced:
        return field
    if field.coefficients is None:
        raise _no_basis(runtime)
    nothing = np.zeros((0, 3), np.float32)
    return replace(field, displacement=nothing, displacement_sd=None, contact_force=None)


def _send_basis(
    models: ServedModels, request: BasisRequest, answer: QueryAnswer[ModeBasis]
) -> None:
    served = models.all()
    wanted = request.basis_sha256
    found = [one for one in served if one.basis is not None and wanted in (b"", one.basis.sha256)]
    if not found:
        if served and not wanted:
            raise _no_basis(served[0])
        raise RemoteError(
            f"no served bundle has the basis {wanted.hex()[:12]}" if wanted else "no bundle serves",
            remedy="take the coefficients anew: the bundle was changed (palpate model list)",
            code=ErrorCode.NOT_FOUND,
        )
    assert found[0].basis is not None
    for part in found[0].basis.parts(found[0].mesh_sha256):
        answer.send(part)
    answer.end()


def _no_basis(runtime: Runtime) -> RemoteError:
    return RemoteError(
        f"the bundle {runtime.label} has no basis, so there is no reduced form of its fields",
        remedy="ask for the whole field, or serve a bundle of palpate train field",
        code=ErrorCode.INVALID_REQUEST,
    )


def _synthesis(
    config: SynthesisServiceConfig, session: Session, models: ServedModels, health: Health
) -> Estimation[Any, Any]:
    made = Estimation(lambda _, field, runtime: sample_of_field(field, runtime), synthesis_of)
    session.queryable(
        endpoints.SYNTHESISE,
        lambda field: reply(made.one("", field, models.of("")), health),
        service="synthesis",
        instance=health.instance,
    )
    requests = SynthesisRequests(session, config, models, health)
    session.watch_callers(requests.caller_gone)
    session.stream_queryable(
        endpoints.SYNTHESISE_FROM,
        requests.handle,
        service="synthesis",
        instance=health.instance,
        workers=config.simulations,
    )
    return made
