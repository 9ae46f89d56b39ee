"""Where an indentation may start: outside the finger, clear of the skin."""

from __future__ import annotations

from palpate.errors import ConfigError, SimulationError
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.result import Floats
from palpate_fem.store.content import StoredFingertip


def skin_of(fingertip: StoredFingertip) -> OuterSurface:
    """The outer surface of the pressurised, untouched skin."""
    return OuterSurface(fingertip.pressurised_nodes, fingertip.mesh.outer_faces)


def check_start(fingertip: StoredFingertip, indenter: str, pose: Floats) -> None:
    """Check that an indenter neither touches the skin nor is within the finger.

    Args:
        fingertip: The skin.
        indenter: Name of the indenter.
        pose: Its first pose, shape (7,), sensor frame.

    Raises:
        ConfigError: It does; says by how much.
    """
    try:
        check_clear(make_indenter(indenter), pose, skin_of(fingertip))
    except SimulationError as error:  # here it is the request that is wrong
        raise ConfigError(error.problem, remedy=error.remedy) from error
