"""The features service: electrodes in, force and contact location out. The newest frame wins."""

from __future__ import annotations

import threading

from palpate.protos.config import LinkConfig
from palpate.protos.health import Health
from palpate.protos.messages import ElectrodeFrame, FeatureEstimate
from palpate.protos.session import Session
from palpate.protos.topics import ELECTRODES, FEATURES
from palpate.services.answering import Answer, Line
from palpate.services.config import FeaturesConfig
from palpate.services.estimator import estimate
from palpate.services.runtime import Runtime
from palpate.services.serving import serve
from palpate.services.tared import TaredFrames

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
    """Serve until ``stop`` is set; see ``palpate.services.serving.serve`` for the errors.

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
