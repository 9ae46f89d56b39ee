"""The features service: electrodes in, force and contact location out. The newest frame wins."""

from __future__ import annotations

import threading

from palpate.bus import Session
from palpate.bus.topics import ELECTRODES, FEATURES
from palpate.config import LinkConfig
from palpate.health import Health
from palpate.messages import ElectrodeFrame, FeatureEstimate
from palpate_services.answering import Answer, Line
from palpate_services.config import FeaturesConfig
from palpate_services.estimator import estimate
from palpate_services.runtime import Runtime
from palpate_services.serving import serve
from palpate_services.tared import TaredFrames

LINE: Line[ElectrodeFrame, FeatureEstimate] = Line(
    "features", ELECTRODES, FEATURES, "frames_received"
)


def run(
    config: FeaturesConfig,
    link: LinkConfig,
    station: str,
    stop: threading.Event,
    *,
    instance: str = "features",
) -> None:
    """Serve until ``stop`` is set; see ``palpate_services.serving.serve`` for the errors.

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

    serve(LINE, config, link, station, stop, instance=instance, make=make)
