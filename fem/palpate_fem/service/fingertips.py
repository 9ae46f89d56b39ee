"""Pressurised fingertips for those who run many trajectories: built once, kept, and indented."""

from __future__ import annotations

import importlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, cast

from palpate.errors import ConfigError
from palpate_fem.config import FingertipParameters
from palpate_fem.result import Floats, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import StoredFingertip

OnFraction = Callable[[float], None]
"""Called with the fraction of the pressurisation that is done; what it raises ends it."""


class Tip(Protocol):
    """A pressurised fingertip."""

    def describe(self) -> StoredFingertip:
        """Mesh, pressurised state and settings."""
        ...

    def indent(
        self,
        indenter: str,
        path: Floats,
        *,
        friction_coefficient: float,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
    ) -> IndentationResult:
        """Follow a path of poses, shape (K, 7); see ``Fingertip.indent``."""
        ...


class Build(Protocol):
    """Builds a pressurised fingertip."""

    def __call__(self, parameters: FingertipParameters, on_fraction: OnFraction) -> Tip:
        """Build and pressurise."""
        ...


class Fingertips:
    """The last few pressurised fingertips.

    Friction plays no part before contact, so fingertips that differ in it only are one.

    Args:
        build: Builds one.
        keep: How many are kept.
    """

    def __init__(self, build: Build, keep: int) -> None:
        self._build = build
        self._keep = keep
        self._tips: OrderedDict[FingertipParameters, Tip] = OrderedDict()

    def get(self, parameters: FingertipParameters, on_fraction: OnFraction) -> Tip:
        """A fingertip with these parameters, built if it is not there.

        Raises:
            PalpateError: It cannot be built.
        """
        key = without_friction(parameters)
        tip = self._tips.pop(key, None)
        if tip is None:
            while len(self._tips) >= self._keep:  # before building: memory is what is short
                self._tips.popitem(last=False)
            tip = self._build(key, on_fraction)
        self._tips[key] = tip
        return tip

    def describe(self, parameters: FingertipParameters) -> StoredFingertip:
        """What a store keeps of a fingertip that is there, with this friction."""
        tip = self._tips[without_friction(parameters)]
        return replace(tip.describe(), parameters=parameters)


def without_friction(parameters: FingertipParameters) -> FingertipParameters:
    """The parameters on which the untouched fingertip depends."""
    return replace(parameters, friction_coefficient=0.0)


def load_factory(name: str) -> Callable[..., Build]:
    """The function that a dotted name stands for.

    Args:
        name: ``module:function``; the function takes options and returns a ``Build``.

    Raises:
        ConfigError: There is no such function.
    """
    module, _, function = name.partition(":")
    try:
        return cast("Callable[..., Build]", getattr(importlib.import_module(module), function))
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"fingertip factory {name!r} cannot be loaded: {error}",
            remedy="give module:function, e.g. palpate_fem.service.biotac:biotac, and install "
            '"palpate[fem]"',
        ) from error
