"""How counts change with a specimen's own parameters: exact, by the film's self-adjoint problem.

The gradient of the impedances by the film's thickness costs no further solve (`FilmSolution`). All
parameters but the conductivity and the circuit's act through the thickness, so each adds one
product of that gradient with a closed derivative of the thickness.
"""

from __future__ import annotations

import numpy as np

from palpate_fem.arrays import Floats
from palpate_fem.electrodes.electronics import counts_slope
from palpate_fem.electrodes.gap import gap_profiles, thickness
from palpate_fem.electrodes.model import ElectrodeModel, ElectrodeResponse

AXES = ("core_x_m", "core_y_m", "core_z_m")
"""Components of `SpecimenParameters.core_offset_m`."""
FILM = (
    "side_closing_m",
    "clamp_closing",
    *AXES,
    "asperity_m",
    "floor_m",
    "squeeze_pa",
    "squeeze_exponent",
)
SCALARS = ("sigma_s_m", "series_ohm", *FILM)
"""Parameters by which counts are derived; `asymmetry` has one value for each electrode besides."""


def counts_by_parameters(model: ElectrodeModel, response: ElectrodeResponse) -> dict[str, Floats]:
    """Derivatives of the counts by each of `SCALARS`, and by ``asymmetry``.

    Args:
        model: The specimen.
        response: Of that model, to one state of the skin.

    Returns:
        d counts / d parameter [counts over the parameter's unit], each of shape (19,). Of the
        asymmetry it is that of each electrode's counts by its own value: others do not move.
    """
    specimen = model.specimen
    asymmetry = np.array(specimen.asymmetry)
    slope = counts_slope(response.impedance, specimen)
    found = {
        "sigma_s_m": counts_by_log_sigma(model, response) / specimen.sigma_s_m,
        "series_ohm": slope / asymmetry,
        "asymmetry": slope * response.impedance / asymmetry,
    }
    by_film = slope[:, None] * response.conduction.gradient_film()
    film = by_film @ film_by_parameters(model, response)
    return found | dict(zip(FILM, film.T, strict=True))


def film_by_parameters(model: ElectrodeModel, response: ElectrodeResponse) -> Floats:
    """Derivatives of the film's thickness by each of `FILM`, shape (N, 9)."""
    specimen, film, gap = model.specimen, model.film, response.gap
    behind, sides = gap_profiles(film.nodes)
    share = 1 - specimen.clamp_closing * behind
    shift = film.normals @ np.array(specimen.core_offset_m)
    squeezed = 1 + gap.pressure / specimen.squeeze_pa
    kept = squeezed**-specimen.squeeze_exponent
    left = (specimen.asperity_m - specimen.floor_m) * kept
    adjusted = share * (gap.gap - shift) - specimen.side_closing_m * sides
    _, by_gap, _ = thickness(adjusted, gap.pressure, specimen)
    columns = [
        -by_gap * sides,
        -by_gap * behind * (gap.gap - shift),
        *(-by_gap * share * film.normals[:, axis] for axis in range(len(AXES))),
        kept,
        1 - kept,
        specimen.squeeze_exponent * left * (gap.pressure / squeezed) / specimen.squeeze_pa**2,
        -left * np.log(squeezed),
    ]
    return np.stack(columns, axis=1)


def counts_by_log_sigma(model: ElectrodeModel, response: ElectrodeResponse) -> Floats:
    """Derivative of the counts by ln of the conductivity, as warmth changes it, shape (19,)."""
    slope = counts_slope(response.impedance, model.specimen)
    return np.asarray(slope * response.conduction.gradient_log_sigma())
