"""Where a trajectory meets the mount: nail and clamp, which a finger is held by."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_fem.result import IndentationResult

MOUNT_SHARE = 0.05
"""Share of the nodal forces that what is held may bear."""


def clear_steps(trajectory: IndentationResult, held: NDArray[np.integer[Any]]) -> int:
    """Steps before the indenter bears on what nail and clamp hold.

    Such trajectories collide with the mount: the paper leaves them out ("Experimental testing
    procedure").

    Args:
        trajectory: As simulated.
        held: Ids of the nodes that are held.
    """
    for k, step in enumerate(trajectory.steps):
        force = np.linalg.norm(step.indenter_force, axis=1)
        if force[held].sum() > MOUNT_SHARE * force.sum():
            return k
    return len(trajectory.steps)
