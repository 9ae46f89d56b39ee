"""The three estimating services: features, field and synthesis.

Each ``run_*`` serves until ``stop`` is set. ``config`` is its table of the profile, ``link`` how it
joins the bus, ``station`` the station that it serves, ``instance`` its name among several processes
of its kind. The errors are those of ``palpate_services.inference.loop.serve``.
"""

from __future__ import annotations

import threading
from typing import Any

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, FIELD, FIELD_TRUTH, SYNTHESIS
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FieldEstimate,
    FieldRequest,
    SynthesisEstimate,
)
from palpate_services.config import (
    FeaturesServiceConfig,
    FieldServiceConfig,
    SynthesisServiceConfig,
)
from palpate_services.inference.estimates import (
    TaredEstimator,
    estimate,
    estimate_field,
    synthesise,
)
from palpate_services.inference.loop import EstimateFrom, ServiceRoute, reply, serve
from palpate_services.inference.model import Runtime

_FEATURES: ServiceRoute[ElectrodeFrame, FeatureEstimate] = ServiceRoute(
    "features", ELECTRODES, FEATURES, "frames_received"
)
_FIELD: ServiceRoute[ElectrodeFrame, FieldEstimate] = ServiceRoute(
    "field", ELECTRODES, FIELD, "frames_received"
)
_SYNTHESIS: dict[str, ServiceRoute[Any, SynthesisEstimate]] = {
    "truth": ServiceRoute("synthesis", FIELD_TRUTH, SYNTHESIS, "fields_received"),
    "estimate": ServiceRoute("synthesis", FIELD, SYNTHESIS, "fields_received"),
}  # by SynthesisServiceConfig.source


def run_features(
    config: FeaturesServiceConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "features",
) -> None:
    """Serve features: from electrodes to force and contact location."""

    def prepare(
        session: Session, runtime: Runtime, health: Health
    ) -> EstimateFrom[ElectrodeFrame, FeatureEstimate]:
        return TaredEstimator(session, config, runtime, estimate, health).estimate

    serve(_FEATURES, config, link, station, stop, instance=instance, prepare=prepare)


def run_field(
    config: FieldServiceConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "field",
) -> None:
    """Serve fields: from electrodes to the displacement of each skin node, at a limited rate.

    Its endpoint ``estimate`` replies with the field of the frame in the request.
    """

    def prepare(
        session: Session, runtime: Runtime, health: Health
    ) -> EstimateFrom[ElectrodeFrame, FieldEstimate]:
        # Requests come in a thread of their own, and an estimator belongs to one thread.
        requested = TaredEstimator(session, config, runtime, estimate_field, health, any_age=True)

        def handle(request: FieldRequest) -> FieldEstimate:
            return reply(requested.estimate(request.sensor, request.frame), health)

        session.queryable(endpoints.ESTIMATE_FIELD, handle, service="field", instance=instance)
        return TaredEstimator(session, config, runtime, estimate_field, health).estimate

    serve(
        _FIELD,
        config,
        link,
        station,
        stop,
        instance=instance,
        prepare=prepare,
        rate_hz=config.rate_hz,
    )


def run_synthesis(
    config: SynthesisServiceConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "synthesis",
) -> None:
    """Serve synthesis: from displacement fields to tared counts of the electrodes.

    Its endpoint ``synthesise`` replies with the tared counts of the field in the request.
    """

    def prepare(
        session: Session, runtime: Runtime, health: Health
    ) -> EstimateFrom[Any, SynthesisEstimate]:
        session.queryable(
            endpoints.SYNTHESISE,
            lambda field: reply(synthesise(field, runtime), health),
            service="synthesis",
            instance=instance,
        )
        return lambda _, field: synthesise(field, runtime)

    route = _SYNTHESIS[config.source]
    serve(route, config, link, station, stop, instance=instance, prepare=prepare)
