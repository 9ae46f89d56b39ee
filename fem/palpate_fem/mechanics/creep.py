"""How strongly skin is held back when it creeps into an equilibrium that Newton cannot reach.

Pinched between a hard indenter and the core, skin may have an unstable direction: a node of its
inner surface that is let go moves *into* the core, and one that is held pulls. No order of touching
and letting go ends then. Real skin is viscous and moves to its next stable state; so does this one,
by implicit Euler steps of one Newton iteration each (pseudo-transient continuation; Kelley and
Keyes 1998): a drag, of the skin's own shear stiffness times a factor, is added to the tangent, and
not to the forces. What it converges to is an equilibrium without any drag.

It is raised until no direction is unstable, which the inertia of the factorised matrix tells, and
falls from iteration to iteration. (By what is unbalanced it cannot be steered: that grows while the
skin leaves an unstable state.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

START = 1.0
FALL, RISE = 0.3, 3.0
NONE, LEAST, MOST = 3e-3, 1e-2, 100.0
STALLED = 0.8
"""Unbalanced force over that two iterations ago from which it is taken not to fall."""


@dataclass(slots=True)
class Creep:
    """Drag from iteration to iteration.

    Attributes:
        drag: Its factor now.
    """

    drag: float = START
    _past: list[float] = field(default_factory=list)

    @property
    def may_rise(self) -> bool:
        """Whether more drag is worth trying."""
        return self.drag < MOST

    def rise(self) -> None:
        """A direction is unstable: hold back more."""
        self.drag = min(MOST, max(LEAST, RISE * self.drag))

    def after(self, residual: float) -> None:
        """An iteration has left this much of the force unbalanced."""
        stalled = len(self._past) >= 2 and residual > STALLED * self._past[-2]
        if stalled and self.drag == 0.0:
            self.drag = START
        else:
            self.drag = FALL * self.drag if FALL * self.drag > NONE else 0.0
        self._past.append(residual)
