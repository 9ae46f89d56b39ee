"""The synthesis service: displacement fields in, tared counts of the electrodes out."""

from __future__ import annotations

import threading
from typing import Any

from palpate.bus import Session, endpoints
from palpate.bus.topics import FIELD, FIELD_TRUTH, SYNTHESIS
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import FieldEstimate, FieldFrame, SynthesisEstimate
from palpate_services.answering import Answer, Line
from palpate_services.asking import answered
from palpate_services.config import SynthesisConfig
from palpate_services.estimator import synthesise
from palpate_services.runtime import Runtime
from palpate_services.serving import serve

SERVICE = "synthesis"

_OF_TRUTH: Line[FieldFrame, SynthesisEstimate] = Line(
    SERVICE, FIELD_TRUTH, SYNTHESIS, "fields_received"
)
_OF_ESTIMATE: Line[FieldEstimate, SynthesisEstimate] = Line(
    SERVICE, FIELD, SYNTHESIS, "fields_received"
)
LINES: dict[str, Line[Any, SynthesisEstimate]] = {"truth": _OF_TRUTH, "estimate": _OF_ESTIMATE}
"""What is answered, by ``SynthesisConfig.source``."""


def run(
    config: SynthesisConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "synthesis",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.serving.serve`` for the errors.

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
