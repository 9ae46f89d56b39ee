"""The field service: electrodes in, displacement of each skin node out, at a limited rate."""

from __future__ import annotations

import threading

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES, FIELD
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import ElectrodeFrame, FieldEstimate, FieldRequest
from palpate_services.answering import Answer, Line
from palpate_services.asking import answered
from palpate_services.config import FieldConfig
from palpate_services.estimator import estimate_field
from palpate_services.runtime import Runtime
from palpate_services.serving import serve
from palpate_services.tared import TaredFrames

LINE: Line[ElectrodeFrame, FieldEstimate] = Line("field", ELECTRODES, FIELD, "frames_received")


def run(
    config: FieldConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "field",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.serving.serve`` for the errors.

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

        session.queryable(endpoints.ESTIMATE_FIELD, handle, service=LINE.service, instance=instance)
        return TaredFrames(session, config, runtime, estimate_field, health).answer

    serve(LINE, config, link, station, stop, instance=instance, make=make, rate_hz=config.rate_hz)
