"""One specimen: how its electrodes are wired and what makes one BioTac differ from another.

``palpate.anatomy`` says where the electrodes sit. The parameters here are nominal values, their
limits, and how they vary across specimens (learning notes, section 4.5).
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from palpate.errors import ConfigError

SENSING = 19
TERMINALS = 1 + SENSING
"""Terminal 0 is the four excitation electrodes, terminal i is E_i."""

DISC_DIAMETER_M = 2.5e-3
"""Of every electrode [m]: from a photo and the electrode map (section 4.3); counts alone say little
about it."""

DISC_TERMINAL = np.array([*range(1, TERMINALS), 0, 0, 0, 0], np.int32)
"""Terminal of each of the 23 discs: E1..E19, then X1..X4; shape (23,)."""


# The range that the model is made for. A value outside is most likely in the wrong unit.
LIMITS = {
    "sigma_s_m": (0.01, 10.0),
    "reference_c": (0.0, 60.0),
    "temperature_coefficient": (0.0, 0.1),
    "disc_diameter_m": (2.0e-3, 2.6e-3),
    "recess_m": (-0.1e-3, 0.3e-3),
    "clamp_closing": (0.0, 1.0),
    "side_closing_m": (0.0, 1.5e-3),
    "core_offset_m": (-1.5e-3, 1.5e-3),
    "asperity_m": (1e-6, 300e-6),
    "floor_m": (0.5e-6, 50e-6),
    "squeeze_pa": (1e2, 1e7),
    "squeeze_exponent": (0.2, 3.0),
    "contact_ohm_m2": (0.0, 5e-3),
    "series_ohm": (0.0, 2e3),
    "load_ohm": (5e3, 20e3),
    "asymmetry": (0.5, 2.0),
    "gain": (-0.1, 0.1),
    "offset": (-200.0, 200.0),
    "noise_counts": (0.0, 50.0),
    "heating_k": (0.0, 40.0),
    "heating_tau_s": (10.0, 1e4),
    "gradient_sd": (0.0, 0.1),
    "creep_share": (0.0, 0.5),
    "creep_tau_s": (0.1, 300.0),
    "pdc_offset": (0.0, 4095.0),
    "pdc_strain_pa_n": (-500.0, 500.0),
    "pdc_warmth_pa_k": (-500.0, 500.0),
    "cooling_share": (0.0, 1.0),
    "cooling_tau_s": (0.1, 60.0),
    "pac_offset": (0.0, 4095.0),
    "tac_offset": (0.0, 4095.0),
}

# Standard deviations across specimens (section 4.5): of the logarithm, or of the value itself.
LOG_SD = {
    "sigma_s_m": 0.25,
    "asperity_m": 0.5,
    "floor_m": 0.5,
    "squeeze_pa": 0.5,
    "load_ohm": 0.01,
    "disc_diameter_m": 0.04,
    "asymmetry": 0.03,
}
SD = {"gain": 0.005 / 2, "offset": 5.0 / 2}  # the data sheet gives ranges: two standard deviations
UNIFORM = {
    "temperature_coefficient": (0.02, 0.03),
    "squeeze_exponent": (0.5, 1.0),
    "contact_ohm_m2": (0.0, 500e-6),
    "series_ohm": (0.0, 300.0),
    # At 100 Hz after warm-up: 0.3-0.6 in the learning notes, but 1.7-6.2 on the idle sensors of the
    # force logs, which also warm up with time constants of 210-260 s.
    "noise_counts": (0.3, 6.0),
    "heating_tau_s": (200.0, 1200.0),
    "side_closing_m": (0.0, 0.8e-3),
    "pdc_strain_pa_n": (-30.0, 30.0),
    "pdc_warmth_pa_k": (-40.0, 40.0),
    "creep_tau_s": (5.0, 30.0),
    "cooling_tau_s": (1.0, 3.0),
    "pdc_offset": (1100.0, 2437.0),
    "pac_offset": (2020.0, 2035.0),
}
PER_ELECTRODE = ("asymmetry", "gain", "offset")
LENGTHS = {"core_offset_m": 3} | dict.fromkeys(PER_ELECTRODE, SENSING)
"""Number of values of those parameters that have several."""

_REMEDY = "give it in SI units and within these limits"
_ZERO_EACH = (0.0,) * SENSING


@dataclass(frozen=True, slots=True)
class SpecimenParameters:
    """Electrical parameters of one specimen; the defaults are section 4.5's nominal ones.

    What shapes the gap of all specimens alike (fill, skin) belongs to the mechanics, not here.

    Attributes:
        sigma_s_m: Conductivity of the fluid at the reference temperature [S/m].
        reference_c: That temperature [degrees C].
        temperature_coefficient: d ln sigma / d T [1/K].
        disc_diameter_m: Of the electrodes [m].
        recess_m: Depth of the film's floor under the core's surface [m]; see `film_mesh`.
        clamp_closing: Share of the gap that the clamp closes behind its edge; see `gap_adjustment`.
        side_closing_m: How much nearer to the core the skin stands at the sides [m]; see
            `gap_adjustment`.
        core_offset_m: Displacement of the core in the skin [m], sensor frame, x distal; see
            `gap_adjustment`.
        asperity_m: Residual film of an unloaded contact [m]: the fluid between the asperities.
        floor_m: Residual film at infinite pressure [m].
        squeeze_pa: Pressure scale of the residual film [Pa].
        squeeze_exponent: Its exponent.
        contact_ohm_m2: Impedance of the electrodes' interface z_c [Ohm m^2].
        series_ohm: Coupling capacitors and leads Z_s [Ohm].
        load_ohm: Load R_L [Ohm].
        asymmetry: Factor on each film impedance (gap and area of one electrode), 19 values.
        gain: Relative error of the converter's gain, 19 values.
        offset: Offset of the converter [counts], 19 values.
        noise_counts: Standard deviation of an electrode's noise [counts].
        heating_k: Final rise of the core's temperature by its own electronics [K].
        heating_tau_s: Time constant of that rise [s].
        gradient_sd: Standard deviation of two smooth spatial modes of ln sigma.
        creep_share: Share of an electrode's change that follows slowly, when loaded and unloaded.
        creep_tau_s: Time constant of that slow response [s].
        pdc_offset: Reading at ambient pressure [counts].
        pdc_strain_pa_n: Error of PDC for each newton, as the core bends [Pa/N].
        pdc_warmth_pa_k: Error of PDC for each kelvin above the reference temperature [Pa/K].
        cooling_share: Final cooling of the thermistor by an indenter, divided by the difference of
            temperature and by the share of the pad that it touches [1].
        cooling_tau_s: Time constant of that cooling [s].
        pac_offset: Reading at constant pressure [counts].
        tac_offset: Reading at constant temperature [counts].
        name: Label, e.g. ``biotac-1``.

    Raises:
        ConfigError: A value is not finite or out of range; names it and its limits.
    """

    sigma_s_m: float = 0.23
    reference_c: float = 40.0
    temperature_coefficient: float = 0.025
    disc_diameter_m: float = DISC_DIAMETER_M
    recess_m: float = 0.0
    clamp_closing: float = 1.0
    side_closing_m: float = 0.0
    core_offset_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    asperity_m: float = 80e-6
    floor_m: float = 5e-6
    squeeze_pa: float = 30e3
    squeeze_exponent: float = 1.0
    contact_ohm_m2: float = 0.0
    series_ohm: float = 0.0
    load_ohm: float = 10e3
    asymmetry: tuple[float, ...] = (1.0,) * SENSING
    gain: tuple[float, ...] = _ZERO_EACH
    offset: tuple[float, ...] = _ZERO_EACH
    noise_counts: float = 0.45
    heating_k: float = 10.0
    heating_tau_s: float = 900.0
    gradient_sd: float = 0.005
    creep_share: float = 0.02
    creep_tau_s: float = 15.0
    pdc_offset: float = 2420.0
    pdc_strain_pa_n: float = 0.0
    pdc_warmth_pa_k: float = 0.0
    cooling_share: float = 0.2
    cooling_tau_s: float = 2.0
    pac_offset: float = 2028.0
    tac_offset: float = 2048.0
    name: str = ""

    def __post_init__(self) -> None:
        for key, (low, high) in LIMITS.items():
            value = getattr(self, key)
            many = LENGTHS.get(key)
            if many and not (isinstance(value, tuple) and len(value) == many):
                raise ConfigError(
                    f"{key} is not a tuple of {many} values",
                    remedy="give one for each electrode, or x, y and z",
                )
            for one in value if many else (value,):
                if (
                    isinstance(one, bool)
                    or not isinstance(one, int | float)
                    or not (math.isfinite(one) and low <= one <= high)
                ):
                    raise ConfigError(
                        f"{key} = {one} is not within [{low:g}, {high:g}]", remedy=_REMEDY
                    )
        if not isinstance(self.name, str):
            raise ConfigError(f"name = {self.name} is not a string", remedy="give a string")
        if self.floor_m > self.asperity_m:
            raise ConfigError(
                f"floor_m = {self.floor_m} exceeds asperity_m = {self.asperity_m}",
                remedy="give a smaller floor_m: a pressed contact has the thinner film",
            )

    def to_json(self) -> str:
        """JSON text; `from_json` restores every value to the last bit."""
        return json.dumps(asdict(self), indent=2)

    @classmethod
    def from_json(cls, text: str) -> SpecimenParameters:
        """Parameters from the text of `to_json`.

        Raises:
            ConfigError: Not a JSON object, an unknown key, or a value out of range.
        """
        try:
            values: Any = json.loads(text)
        except json.JSONDecodeError as error:
            raise ConfigError(f"the specimen is not JSON: {error}", remedy="use to_json") from error
        if not isinstance(values, dict):
            raise ConfigError("the specimen is not a JSON object", remedy="use to_json")
        known = {field.name for field in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ConfigError(
                f"unknown key {unknown[0]!r} of a specimen",
                remedy=f"known are {', '.join(sorted(known))}",
            )
        typed: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
        }
        return cls(**typed)

    def drawn(self, rng: np.random.Generator) -> SpecimenParameters:
        """A specimen drawn from the priors around this one; values are clipped to `LIMITS`."""
        values: dict[str, Any] = {}
        for key, sd in (*LOG_SD.items(), *SD.items()):
            here = np.asarray(getattr(self, key))
            step = sd * rng.standard_normal(here.shape)
            values[key] = here * np.exp(step) if key in LOG_SD else here + step
        for key, (low, high) in UNIFORM.items():
            values[key] = np.asarray(rng.uniform(low, high))
        for key, value in values.items():
            values[key] = np.clip(value, *LIMITS[key])
        values["floor_m"] = np.minimum(values["floor_m"], values["asperity_m"])
        plain: dict[str, Any] = {
            key: tuple(value.tolist()) if value.ndim else float(value)
            for key, value in values.items()
        }
        return replace(self, **plain)
