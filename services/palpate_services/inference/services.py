"""The three estimating services: features, field and synthesis."""

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
    FieldFrame,
    FieldRequest,
    SynthesisEstimate,
)
from palpate_services.config import FeaturesConfig, FieldConfig, SynthesisConfig
from palpate_services.inference.estimates import TaredFrames, estimate, estimate_field, synthesise
from palpate_services.inference.loop import Answer, Line, answered, serve
from palpate_services.inference.model import Runtime

_FEATURES_LINE: Line[ElectrodeFrame, FeatureEstimate] = Line(
    "features", ELECTRODES, FEATURES, "frames_received"
)


def run_features(
    config: FeaturesConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "features",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.inference.loop.serve`` for the errors.

    Args:
        config: How electrodes become features.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.
    """

    def make(
        session: Session, runtime: Runtime, health: Health
    ) -> Answer[ElectrodeFrame, FeatureEstimate]:
        return TaredFrames(session, config, runtime, estimate, health).answer

    serve(_FEATURES_LINE, config, link, station, stop, instance=instance, make=make)


_FIELD_LINE: Line[ElectrodeFrame, FieldEstimate] = Line(
    "field", ELECTRODES, FIELD, "frames_received"
)


def run_field(
    config: FieldConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "field",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.inference.loop.serve`` for the errors.

    Answers the endpoint ``estimate`` too: the field of the frame that it is asked with.

    Args:
        config: How electrodes become fields.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.
    """

    def make(
        session: Session, runtime: Runtime, health: Health
    ) -> Answer[ElectrodeFrame, FieldEstimate]:
        # Questions come in a thread of their own, and tares are looked up by one thread each.
        asked = TaredFrames(session, config, runtime, estimate_field, health, any_age=True)

        def handle(request: FieldRequest) -> FieldEstimate:
            return answered(asked.answer(request.sensor, request.frame), health)

        session.queryable(
            endpoints.ESTIMATE_FIELD, handle, service=_FIELD_LINE.service, instance=instance
        )
        return TaredFrames(session, config, runtime, estimate_field, health).answer

    serve(
        _FIELD_LINE,
        config,
        link,
        station,
        stop,
        instance=instance,
        make=make,
        rate_hz=config.rate_hz,
    )


SERVICE = "synthesis"

_OF_TRUTH: Line[FieldFrame, SynthesisEstimate] = Line(
    SERVICE, FIELD_TRUTH, SYNTHESIS, "fields_received"
)
_OF_ESTIMATE: Line[FieldEstimate, SynthesisEstimate] = Line(
    SERVICE, FIELD, SYNTHESIS, "fields_received"
)
LINES: dict[str, Line[Any, SynthesisEstimate]] = {"truth": _OF_TRUTH, "estimate": _OF_ESTIMATE}
"""What is answered, by ``SynthesisConfig.source``."""


def run_synthesis(
    config: SynthesisConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "synthesis",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.inference.loop.serve`` for the errors.

    Answers the endpoint ``synthesise`` too: the tared counts of the field that it is asked with.

    Args:
        config: How fields become electrodes.
        link: How to join the bus.
        station: The station to serve.
        stop: Set it to end.
        instance: Name of this process among several of its kind.
    """

    def make(session: Session, runtime: Runtime, health: Health) -> Answer[Any, SynthesisEstimate]:
        session.queryable(
            endpoints.SYNTHESISE,
            lambda field: answered(synthesise(field, runtime), health),
            service=SERVICE,
            instance=instance,
        )
        return lambda _, field: synthesise(field, runtime)

    serve(LINES[config.source], config, link, station, stop, instance=instance, make=make)
