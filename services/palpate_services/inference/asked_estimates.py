"""Questions for the estimate of one frame, with the timings of each answer.

A caller may ask about a frame of any age. Its answer says so (``STALE``) if the frame was too old
for the stream when the question came; all else in it is as pure as an estimate of the stream.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Generic, TypeVar

from palpate.bus import QueryAnswer, Session
from palpate.health import Health
from palpate.messages import (
    ElectrodeFrame,
    FeatureEstimate,
    FeatureRequest,
    FieldEstimate,
    FieldRequest,
    QualityFlag,
    StageTimings,
)
from palpate_services.config import ElectrodesConfig
from palpate_services.inference.estimates import AgeLimit, EstimateRefusal, Sample, TaredSamples
from palpate_services.inference.loop import arrival_age_s, refuse
from palpate_services.inference.model import Outputs, Runtime
from palpate_services.inference.served import ServedModels

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
