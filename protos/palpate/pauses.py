"""Pauses that Python brings into a service, and how one that is about to serve avoids them."""

from __future__ import annotations

import gc
import sys

_YOUNG_OBJECTS = 50_000
"""Collect after so many new container objects; frames and estimates hold no cycles."""

_SWITCH_S = 0.0005
"""How long a busy thread may keep another from the interpreter [s]; Python's default is 5 ms."""


def avoid_pauses() -> None:
    """Call once, when everything is imported and loaded and the first frame may come.

    A full garbage collection looks at every object of every imported module, which takes 10 ms and
    more: a frame's whole period. Those objects live as long as the process, so they are taken out
    of its sight.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG_OBJECTS, 20, 50)
    sys.setswitchinterval(_SWITCH_S)
