"""An experiment on several fingertips: one on each, with presses and specimens of its own.

A simulation belongs to one fingertip, and so does what is made of it. So every fingertip has a
folder with an experiment; `palpate_training.datasets.features.joined` puts their rows together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from palpate.errors import ConfigError
from palpate_training.experiment.generate.simulator import ExperimentSpec, Specimen

_SEEDS = 1000  # of one experiment; presses are a function of the seed


@dataclass(frozen=True, slots=True)
class FingertipShare:
    """What one of the fingertips gets.

    Attributes:
        name: Of its folder.
        spec: Its experiment.
        specimens: Those whose skin it is.
    """

    name: str
    spec: ExperimentSpec
    specimens: tuple[Specimen, ...]


def share_out(
    spec: ExperimentSpec, fingertips: Sequence[Mapping[str, Any]], specimens: Sequence[Specimen]
) -> tuple[FingertipShare, ...]:
    """Deal presses and specimens evenly, the first specimens to the first fingertip.

    Args:
        spec: The experiment; its presses are divided.
        fingertips: Skin and fill of each, by the names of the settings of an experiment.
        specimens: Each gets one of the fingertips.

    Raises:
        ConfigError: A fingertip would have no press, or fewer specimens than execute each; or there
            are too many.
    """
    count, least = len(fingertips), max(1, spec.units_each)
    if not 0 < count <= min(_SEEDS, spec.presses, len(specimens) // least):
        raise ConfigError(
            f"{spec.presses} presses and {len(specimens)} specimens for {count} fingertips",
            remedy=f"give each of at most {_SEEDS} a press and {least} specimens",
        )
    shares = []
    for number, fingertip in enumerate(fingertips):
        (first, end), (one, other) = (
            [total * k // count for k in (number, number + 1)]
            for total in (spec.presses, len(specimens))
        )
        own = replace(spec, presses=end - first, seed=_SEEDS * spec.seed + number, **fingertip)
        shares.append(
            FingertipShare(f"fingertip-{number + 1:02d}", own, tuple(specimens[one:other]))
        )
    return tuple(shares)
