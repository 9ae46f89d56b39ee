"""Which bundle makes the estimates of which sensor, and changing that while frames come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.messages import ModelMetadata
from palpate_services.inference.model import Runtime


@dataclass(frozen=True, slots=True)
class Serving:
    """Bundles that serve at one moment; never changed, only replaced as a whole.

    Attributes:
        default: The bundle of sensors without one of their own; None = there is none.
        own: Bundles of sensors that have their own, by sensor.
    """

    default: Runtime | None
    own: Mapping[str, Runtime] = field(default_factory=dict)


class ServedModels:
    """The bundles of one service. Safe to use from several threads."""

    def __init__(self, serving: Serving) -> None:
        self._serving = serving

    def of(self, sensor: str) -> Runtime | None:
        """The bundle of a sensor; None = there is none."""
        serving = self._serving
        return serving.own.get(sensor, serving.default)

    def describe(self) -> str:
        """One line for people."""
        serving = self._serving
        default = "no bundle" if serving.default is None else serving.default.label
        own = [f"{sensor} {runtime.label}" for sensor, runtime in sorted(serving.own.items())]
        return "serving " + ", ".join([default, *own])

    def labels(self) -> tuple[str, ...]:
        """What is served, each bundle once as ``name:version``."""
        serving = self._serving
        return tuple(sorted({one.label for one in (serving.default, *serving.own.values()) if one}))

    def metadata(self) -> ModelMetadata:
        """Description of the default bundle for clients."""
        runtime = self._serving.default
        assert runtime is not None
        return runtime.metadata()
