"""Pressurised fingertips for many trajectories: built once, kept, and indented.

The solver behind them is a protocol, so that the service and its tests do not depend on it;
``service.biotac`` implements it.
"""

from __future__ import annotations

import importlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, cast, runtime_checkable

from palpate.errors import ConfigError, SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import StoredFingertip

if TYPE_CHECKING:  # workers on the CPU do without it
    from palpate_fem.batched.fingertip import BatchedPress, UnsolvedPress

OnFraction = Callable[[float], None]
"""Called with the completed fraction of the pressurisation; an exception from it ends that."""


class PressurisedTip(Protocol):
    """A pressurised fingertip that can be indented."""

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


class SlottedSolver(Protocol):
    """Solves many trajectories of one fingertip at once, in slots."""

    def solve(
        self,
        presses: Iterator[BatchedPress],
        *,
        on_sweep: Callable[[int], None] | None = None,
        on_step: Callable[[int, IndentationStep], None] | None = None,
        should_stop: Callable[[int], IndentationOutcome | None] | None = None,
    ) -> Iterator[tuple[int, IndentationResult | UnsolvedPress]]:
        """Solve presses, in whatever order they end; see ``BatchedFingertip.solve``."""
        ...


@runtime_checkable
class SlottedTip(PressurisedTip, Protocol):
    """A pressurised fingertip that can be put on a device many times."""

    def on_device(
        self, indenters: Sequence[str], *, slots: int, device: str, friction_coefficient: float
    ) -> SlottedSolver:
        """Make room on a device.

        Args:
            indenters: Names of all that presses may have, by number.
            slots: Trajectories at once.
            device: A Warp device, for example ``cuda:0``.
            friction_coefficient: Of indenters and skin.
        """
        ...


BuildTip = Callable[[FingertipParameters, OnFraction], PressurisedTip]
"""Builds a fingertip and pressurises it."""


class FingertipCache:
    """The most recently used pressurised fingertips.

    Friction has no effect before contact, so fingertips that differ only in it share one entry.

    Args:
        build: Builds one.
        keep: Number of fingertips that are kept.
    """

    def __init__(self, build: BuildTip, keep: int) -> None:
        self._build = build
        self._keep = keep
        self._tips: OrderedDict[FingertipParameters, PressurisedTip] = OrderedDict()

    def get(self, parameters: FingertipParameters, on_fraction: OnFraction) -> PressurisedTip:
        """The fingertip with these parameters, which is built if it is not kept.

        Raises:
            PalpateError: It cannot be built.
        """
        key = without_friction(parameters)
        tip = self._tips.pop(key, None)
        if tip is None:
            # Dropped before building: two fingertips at once may not fit into memory.
            while len(self._tips) >= self._keep:
                self._tips.popitem(last=False)
            tip = self._build(key, on_fraction)
        self._tips[key] = tip
        return tip

    def describe(self, parameters: FingertipParameters) -> StoredFingertip:
        """Description of a kept fingertip for a store, with this friction."""
        tip = self._tips[without_friction(parameters)]
        return replace(tip.describe(), parameters=parameters)


def without_friction(parameters: FingertipParameters) -> FingertipParameters:
    """The parameters on which the untouched fingertip depends."""
    return replace(parameters, friction_coefficient=0.0)


def load_factory(name: str) -> Callable[..., BuildTip]:
    """Import the factory of fingertips with a dotted name.

    Args:
        name: ``module:function``; the function takes options and returns a ``BuildTip``.

    Raises:
        ConfigError: There is no such function.
    """
    module, _, function = name.partition(":")
    try:
        return cast("Callable[..., BuildTip]", getattr(importlib.import_module(module), function))
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"fingertip factory {name!r} cannot be loaded: {error}",
            remedy="give module:function, e.g. palpate_fem.service.biotac:biotac, and install "
            '"palpate[fem]"',
        ) from error


def skin_of(fingertip: StoredFingertip) -> OuterSurface:
    """The outer surface of the pressurised, untouched skin."""
    return OuterSurface(fingertip.pressurised_nodes, fingertip.mesh.outer_faces)


def check_start(fingertip: StoredFingertip, indenter: str, pose: Floats) -> None:
    """Check that an indentation starts outside of the finger, clear of the skin.

    Args:
        fingertip: The skin.
        indenter: Name of the indenter.
        pose: Its first pose, shape (7,), sensor frame.

    Raises:
        ConfigError: It starts in the skin or in the finger; says how far.
    """
    try:
        check_clear(make_indenter(indenter), pose, skin_of(fingertip))
    except SimulationError as error:  # here it is the request that is wrong, not the solver
        raise ConfigError(error.problem, remedy=error.remedy) from error
