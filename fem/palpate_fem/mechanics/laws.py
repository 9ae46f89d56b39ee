"""Constants of contact, and an indenter at a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from palpate_fem.device import scalars
from palpate_fem.indenter.pose import rotation_matrix
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.contact_laws import Law

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Numbers of the contact laws, per unpressurised area.

    Attributes:
        stiffness: Of the normal law [Pa/m]; 1 MPa, a hard pinch, is 0.5 um deep.
        tangential_stiffness: Of a sticking point [Pa/m]; 0.1 MPa moves it by 2 um.
        complement: c that decides between sticking and sliding [Pa/m]; it does not touch the
            answer. At most the skin's own stiffness (mu over an element): with more, a point whose
            way changes sign from iteration to iteration slides for ever.
        margin_m: Points farther from a surface are not looked at [m].
    """

    stiffness: float = 2e12
    tangential_stiffness: float = 5e10
    complement: float = 3e8
    margin_m: float = 0.5e-3

    def scaled(self, factor: float) -> ContactSettings:
        """The same relative to a skin that is stiffer by a factor."""
        return replace(
            self,
            stiffness=factor * self.stiffness,
            tangential_stiffness=factor * self.tangential_stiffness,
            complement=factor * self.complement,
        )

    def law(self, friction: float) -> Law:
        """The same for the kernels."""
        law = Law()
        law.stiffness = wp.float64(self.stiffness)
        law.friction = wp.float64(friction)
        law.tangential_stiffness = wp.float64(self.tangential_stiffness)
        law.complement = wp.float64(self.complement)
        return law


class Press:
    """An indenter at a pose (7,): position [m] and quaternion w x y z, sensor frame."""

    def __init__(self, indenter: Indenter, pose: Floats, friction: float) -> None:
        self.indenter, self.friction = indenter, friction
        self.primitives = scalars(indenter.packed())
        self.tip = np.asarray(pose[:3], np.float64)
        self.rotation = rotation_matrix(pose[3:])

    def at(self, pose: Floats) -> Press:
        """The same at another pose."""
        other = object.__new__(Press)
        other.indenter, other.friction, other.primitives = (
            self.indenter,
            self.friction,
            self.primitives,
        )
        other.tip, other.rotation = np.asarray(pose[:3], np.float64), rotation_matrix(pose[3:])
        return other

    def to_local(self, points: Floats) -> Floats:
        """Points of the sensor frame in the indenter's."""
        return np.asarray((points - self.tip) @ self.rotation)
