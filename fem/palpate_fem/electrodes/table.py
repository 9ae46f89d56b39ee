"""How the electrodes are wired and how large they are; ``protos.anatomy`` says where they sit."""

from __future__ import annotations

import numpy as np

SENSING = 19
EXCITATION = 4
TERMINALS = 1 + SENSING
"""Terminal 0 is the four excitation electrodes, terminal i is E_i."""

DISC_DIAMETER_M = 2.5e-3
"""Of every electrode [m]: photo and map (section 4.3; weakly identified by counts)."""

DISC_TERMINAL = np.array([*range(1, TERMINALS), 0, 0, 0, 0], np.int32)
"""Terminal of each of the 23 discs: E1..E19, then X1..X4; shape (23,)."""
