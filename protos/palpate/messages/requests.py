"""Questions for one estimate, and answers that are more than an estimate. Comments: the .proto."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.messages.estimates import SynthesisEstimate
from palpate.messages.frames import ElectrodeFrame, FieldFrame, FloatArray
from palpate.messages.simulation import SimulationOutcome, SimulationRequest, SimulationStep


@dataclass(frozen=True, slots=True)
class FeatureRequest:
    """Ask a features service for the features of one frame.

    Attributes:
        sensor: Name of the sensor in the key of its streams; its gateway knows the frame's tare.
        frame: Raw counts of one sampling round.
    """

    sensor: str
    frame: ElectrodeFrame


@dataclass(frozen=True, slots=True)
class FieldRequest:
    """Ask a field service for the field of one frame.

    Attributes:
        sensor: Name of the sensor in the key of its streams; its gateway knows the frame's tare.
        frame: Raw counts of one sampling round.
        reduced: The reply has the coefficients of the field and not the field.
    """

    sensor: str
    frame: ElectrodeFrame
    reduced: bool = False


@dataclass(frozen=True, slots=True)
class ContactDescription:
    """A contact to be simulated: an indenter comes straight on to a depth or to a force.

    Attributes:
        indenter: Standard name, e.g. ``"sphere_3-5mm"``.
        location: Point of the untouched skin that its tip meets [m], sensor frame; the nearest
            point of the skin is taken.
        direction: In which it moves, any length; None = straight into the skin.
        depth_m: How far the tip goes beyond that point [m]; give this or ``force_n``.
        force_n: Net force on the BioTac at which it ends [N].
    """

    indenter: str
    location: tuple[float, float, float]
    direction: tuple[float, float, float] | None = None
    depth_m: float | None = None
    force_n: float | None = None


@dataclass(frozen=True, slots=True)
class SynthesisRequest:
    """Ask a synthesis service for the electrodes of a field, a contact or a simulation.

    Attributes:
        source: What to synthesise from.
        simulator: Name under which the finite-element service answers.
        deadline_s: How long the caller waits [s]; 0 = the service's own limit.
        every_step: Each converged step of a simulation gets a reply, not only the last.
        request_id: Names the token that the caller holds while it waits; empty = it holds none.
    """

    source: FieldFrame | ContactDescription | SimulationRequest
    simulator: str = "twin"
    deadline_s: float = 0.0
    every_step: bool = False
    request_id: str = ""


@dataclass(frozen=True, slots=True)
class SynthesisReply:
    """Part of the answer to a ``SynthesisRequest``.

    Attributes:
        estimate: None in a last message that only says how the simulation ended.
        step: The simulated step that it is of, without fields; None for a given field.
        step_number: Number of that step, from 0.
        outcome: How the simulation ended; UNSPECIFIED = not yet, or there was none.
        stopped_because: Why it ended before the end of its path, if it did.
        more: Another part follows, or an error.
    """

    estimate: SynthesisEstimate | None
    step: SimulationStep | None = None
    step_number: int = 0
    outcome: SimulationOutcome = SimulationOutcome.UNSPECIFIED
    stopped_because: str = ""
    more: bool = False


@dataclass(frozen=True, slots=True)
class BasisRequest:
    """Ask a field service for the basis of its coefficients; an empty digest = the served one."""

    basis_sha256: bytes = b""


@dataclass(frozen=True, slots=True)
class ModeBasis:
    """The basis of a bundle's coefficients, or a part of it: ``mean + coefficients @ modes``.

    Attributes:
        basis_sha256: Content hash of the whole basis, 32 bytes.
        mesh_sha256: Content hash of the mesh whose nodes move, 32 bytes.
        mean: Displacement of coefficients that are zero [m], shape ``(V, 3)``; None in a part that
            is not the first.
        modes: Dimensionless; the largest entry of each is 1, shape ``(K, V, 3)``.
        modes_total: Modes of all parts together.
        first_mode: Number of the first mode here, from 0.
        more: Another part follows, or an error.
    """

    basis_sha256: bytes
    mesh_sha256: bytes
    mean: FloatArray | None
    modes: FloatArray
    modes_total: int
    first_mode: int = 0
    more: bool = False

    def decode(self, coefficients: FloatArray) -> FloatArray:
        """Displacement [m], shape ``(V, 3)``, of coefficients [m], shape ``(K,)``.

        Raises:
            ValueError: This is not the whole basis, or has another number of modes.
        """
        if self.mean is None or len(self.modes) != self.modes_total:
            raise ValueError("this is a part of a basis, not all of it")
        if coefficients.shape != (self.modes_total,):
            raise ValueError(f"{coefficients.shape} coefficients of {self.modes_total} modes")
        flat = coefficients @ self.modes.reshape(self.modes_total, -1)
        field: FloatArray = self.mean + flat.reshape(self.mean.shape)
        return field
