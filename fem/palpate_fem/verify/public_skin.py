"""The public BioTac skin filled with 430 mm^3: a regression against other programs.

The skin is held as `read_nvlabs` holds it; there is no core. Independent reference: the public
tetrahedra, quadratic with element pressure (P2-P0), and wedges of another program grown from the
same inner surface (the project's reference notes on finite elements, section 0.1).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from palpate_fem.mesh.nvlabs import SKIN, read_nvlabs
from palpate_fem.verify.bodies import TIGHT, VerificationBody
from palpate_fem.verify.check import Measurement, MissingDataError, check

FILLED_M3 = (60e-9, 150e-9, 250e-9, 350e-9, 430e-9)
QUADRATIC_KPA = 26.58  # P2-P0 on the public tetrahedra
WEDGES_KPA = {1: 26.6, 2: 26.8, 3: 26.8}  # by layers, kappa / mu = 1e3
# By kappa / mu, over that at 1e3, two layers.
SOFTER = {1e2: 26.58 / 26.82, 1e5: 26.86 / 26.82}
SETTINGS = replace(TIGHT, tolerance=1e-8, volume_tolerance=1e-8, largest_move_m=0.25e-3)


@cache
def filled(folder: Path, layers: int, bulk_ratio: float) -> tuple[float, float]:
    """Fluid pressure [kPa] and thickness [mm] at the last of `FILLED_M3`.

    Raises:
        MissingDataError: The public files are not there.
    """
    if not (folder / SKIN).is_file():
        raise MissingDataError(
            f"no public BioTac in {folder.name}; its files are not part of palpate"
        )
    mesh = read_nvlabs(folder, layers=layers).mesh
    body = VerificationBody(mesh, bulk_ratio=bulk_ratio, settings=SETTINGS)
    rest = body.system.balance(body.state, None).volume
    for more in FILLED_M3:
        body.solve(volume=rest + more)
    thickness = float(np.ptp(body.state.position[:, 2])) * 1e3
    return body.state.fluid_pressure * 1e-3, thickness


@check("skin/filled by 430 mm^3, {layers} layers", 1e-2, "kPa", slow=True, layers=(1, 3))
@check("skin/filled by 430 mm^3, {layers} layers", 1e-2, "kPa", layers=(2,))
def pressure(folder: Path, layers: int) -> Measurement:
    """Fluid pressure by layers, against wedges of another program."""
    found, thickness = filled(folder, layers, 1e3)
    return Measurement(found, WEDGES_KPA[layers], f"{thickness:.2f} mm thick")


@check("skin/against quadratic tetrahedra", 1e-2, "kPa")
def against_quadratic(folder: Path) -> Measurement:
    """Fluid pressure against quadratic tetrahedra, which do not lock, on the public mesh itself."""
    return Measurement(filled(folder, 2, 1e3)[0], QUADRATIC_KPA, "P2-P0")


@check("skin/layers agree", 8e-3, slow=True)
def layers_agree(folder: Path) -> Measurement:
    """Largest deviation of one or two layers from three."""
    found = [filled(folder, layers, 1e3)[0] for layers in WEDGES_KPA]
    note = ", ".join(f"{p:.2f}" for p in found) + " kPa"
    return Measurement(max(abs(p / found[-1] - 1) for p in found), 0.0, note)


@check("skin/kappa / mu = {ratio:g} over 1000", 1e-3, slow=True, ratio=tuple(SOFTER))
def bulk_modulus(folder: Path, ratio: float) -> Measurement:
    """Pressure at another kappa over that at 1e3 mu: an element that locks would show more."""
    found = filled(folder, 2, ratio)[0]
    return Measurement(found / filled(folder, 2, 1e3)[0], SOFTER[ratio], f"{found:.2f} kPa")
