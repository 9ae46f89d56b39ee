"""What a pipeline publishes, as a list."""

from __future__ import annotations

from collections.abc import Iterable

from palpate_gateway.clock.stamps import DueMessage
from palpate_gateway.readings import Reading
from palpate_gateway.service.pipeline import Pipeline


def pushed(pipeline: Pipeline, readings: Iterable[Reading], arrival_ns: int) -> list[DueMessage]:
    """What becomes of readings."""
    out: list[DueMessage] = []
    pipeline.push(readings, arrival_ns, out.append)
    return out


def finished(pipeline: Pipeline) -> list[DueMessage]:
    """What goes out at the end of the source."""
    out: list[DueMessage] = []
    pipeline.finish(out.append)
    return out
