"""What holds without a closed form: balance, energy, symmetry, scaling, work, sealed volume."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate.fem.system import Balance
from palpate.fem.verify.body import MU, Body
from palpate.fem.verify.check import Case, Measured
from palpate.fem.verify.element import order_of
from palpate.fem.verify.finger import Finger, biotac_finger, round_finger

Floats = NDArray[np.float64]

FRICTION = 0.186
