"""Options that several of the finite-element commands share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

MeshOption = Annotated[
    str, typer.Option("--mesh", metavar="biotac|FOLDER", help="Mesh, or folder of the public one.")
]
EdgeOption = Annotated[
    float | None, typer.Option("--edge-mm", help="Edge of the mesh's elements on the pad [mm].")
]
LayersOption = Annotated[int, typer.Option("--layers", min=1, help="Elements through the skin.")]
ParametersOption = Annotated[
    Path | None,
    typer.Option("--parameters", metavar="FIT.json", help="Fingertip as `calibrate` found it."),
]
ThicknessOption = Annotated[
    float | None, typer.Option("--skin-thickness-mm", help="Skin thickness [mm].")
]
ModulusOption = Annotated[
    float | None, typer.Option("--shear-modulus-kpa", help="Shear modulus of the skin [kPa].")
]
FrictionOption = Annotated[
    float | None, typer.Option("--friction", help="Friction coefficient of indenter and skin.")
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Processes that solve; 0 = one for each core.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
MeasuredArgument = Annotated[
    Path, typer.Argument(metavar="MEASURED.h5", help="Measured indentations.")
]


class Study(StrEnum):
    """What a study refines."""

    MESH = "mesh"
    STEPS = "steps"
