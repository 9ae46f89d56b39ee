"""The three estimating services: features, field and synthesis."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, FIELD_TRUTH, SYNTHESIS
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import FieldEstimate, FieldRequest
from palpate_services.config import (
    EstimatingConfig,
    FeaturesServiceConfig,
    FieldServiceConfig,
    ModelsConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.estimates import (
    Estimation,
    TaredSamples,
    features_of,
    field_of,
    sample_of_field,
    synthesis_of,
)
from palpate_services.inference.loop import ServiceRoute, reply, serve
from palpate_services.inference.served import ServedModels

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
    fields to tared counts. The endpoint ``estimate`` of the field service replies with the field of
    the frame in a request; ``synthesise`` with the tared counts of the field in a request.
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
        run(_SYNTHESIS[config.source], prepare=_synthesis)


def _features(
    config: FeaturesServiceConfig, session: Session, models: ServedModels, health: Health
) -> Estimation[Any, Any]:
    return Estimation(TaredSamples(session, config, health).take, features_of)


def _field(
    config: FieldServiceConfig, session: Session, models: ServedModels, health: Health
) -> Estimation[Any, Any]:
    # Requests come in a thread of their own, and samples are taken in one thread.
    requested = Estimation(TaredSamples(session, config, health, any_age=True).take, field_of)

    def handle(request: FieldRequest) -> FieldEstimate:
        runtime = models.of(request.sensor)
        return reply(requested.one(request.sensor, request.frame, runtime), health)

    session.queryable(endpoints.ESTIMATE_FIELD, handle, service="field", instance=health.instance)
    return Estimation(TaredSamples(session, config, health).take, field_of)


def _synthesis(session: Session, models: ServedModels, health: Health) -> Estimation[Any, Any]:
    made = Estimation(lambda _, field, runtime: sample_of_field(field, runtime), synthesis_of)
    session.queryable(
        endpoints.SYNTHESISE,
        lambda field: reply(made.one("", field, models.of("")), health),
        service="synthesis",
        instance=health.instance,
    )
    return made
