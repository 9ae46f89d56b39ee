"""``palpate fem``: signatures and help only; each command's work is in its own module.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_fem.cli.group import FemGroup
from palpate_fem.cli.options import (
    EdgeOption,
    FrictionOption,
    JsonOption,
    LayersOption,
    MeasuredArgument,
    MeshOption,
    ModulusOption,
    ParametersOption,
    Study,
    ThicknessOption,
    WorkersOption,
)
from palpate_fem.cli.units_app import units_app

fem_app = typer.Typer(
    cls=FemGroup,
    help="The fingertip in finite elements: simulate, verify, calibrate, serve (palpate[fem]).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
fem_app.add_typer(units_app, name="units")


def _example(*lines: str) -> str:
    return "Example: " + "  or  ".join(lines)


@fem_app.command(
    epilog=_example(
        "palpate fem run --indenter sphere_7mm --depth-mm 2 --png press.png",
        "palpate fem run --sweep --points 2 --store runs/paper.sim",
    )
)
def run(
    indenter: Annotated[
        list[str] | None, typer.Option("--indenter", help="Indenter; --sweep: may be repeated.")
    ] = None,
    depth_mm: Annotated[float, typer.Option(help="Travel from first contact on [mm].")] = 3.0,
    at_mm: Annotated[
        tuple[float, float], typer.Option(metavar="X Y", help="Point of the pad it aims at [mm].")
    ] = (-4.0, 0.0),
    angle_deg: Annotated[float, typer.Option(help="Angle to the inward normal [degrees].")] = 0.0,
    azimuth_deg: Annotated[
        float, typer.Option(help="Where an angled one goes: 0 distal, 90 +y [degrees].")
    ] = 0.0,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a path.")] = 20,
    path: Annotated[
        Path | None,
        typer.Option(metavar="POSES.csv", help="Poses x_m,y_m,z_m,qw,qx,qy,qz instead of a press."),
    ] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="The paper's set of indentations.")
    ] = False,
    points: Annotated[int, typer.Option(min=1, help="--sweep: points for each indenter.")] = 10,
    angled: Annotated[int, typer.Option(min=0, max=4, help="--sweep: angled ones a point.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="--sweep: seed of the points.")] = 0,
    store: Annotated[
        Path | None,
        typer.Option(metavar="NAME.sim", help="Store; what it holds already is not run again."),
    ] = None,
    stress: Annotated[bool, typer.Option("--stress", help="Keep stress in the store.")] = False,
    png: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the result.")] = None,
    limit_s: Annotated[
        float, typer.Option(min=1, help="Longest time for one trajectory [s].")
    ] = 600.0,
    workers: WorkersOption = 0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
    skin_thickness_mm: ThicknessOption = None,
    shear_modulus_kpa: ModulusOption = None,
    friction: FrictionOption = None,
    json_: JsonOption = False,
) -> None:
    """Simulate one indentation, or the paper's set of them; Ctrl-C keeps what has ended."""
    from palpate_fem.cli.model import model_of
    from palpate_fem.cli.run import Wanted, run_command

    raise typer.Exit(
        run_command(
            Wanted(
                indenters=tuple(indenter or ()),
                depth_m=depth_mm * 1e-3,
                at_m=(at_mm[0] * 1e-3, at_mm[1] * 1e-3),
                angle_deg=angle_deg,
                azimuth_deg=azimuth_deg,
                steps=steps,
                path=path,
                sweep=sweep,
                points=points,
                angled=angled,
                seed=seed,
            ),
            model_of(
                mesh=mesh,
                edge_mm=edge_mm,
                layers=layers,
                fit=parameters,
                skin_thickness_mm=skin_thickness_mm,
                shear_modulus_kpa=shear_modulus_kpa,
                friction=friction,
            ),
            workers=workers,
            limit_s=limit_s,
            store=store,
            stress=stress,
            png=png,
            as_json=json_,
        )
    )


@fem_app.command(epilog=_example("palpate fem export runs/paper.sim paper.h5"))
def export(
    store: Annotated[Path, typer.Argument(metavar="NAME.sim", help="A store of simulations.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.h5", help="The file; never replaced.")],
) -> None:
    """Copy a store into one HDF5 file, to hand on; every reader takes it like the store."""
    from palpate_fem.cli.export import export_command

    raise typer.Exit(export_command(store, out))


@fem_app.command(epilog=_example("palpate fem verify", "palpate fem verify --only hertz --json"))
def verify(
    only: Annotated[
        str | None, typer.Option("--only", metavar="WORD", help="Tests whose name has this word.")
    ] = None,
    slow: Annotated[bool, typer.Option("--slow", help="Also tests that take minutes.")] = False,
    shared_data: Annotated[
        Path | None,
        typer.Option(
            "--public-data", metavar="FOLDER", help="Folder that holds nvlabs_biotac_mesh."
        ),
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Check the solver against closed forms and itself; a line each with value and tolerance."""
    from palpate_fem.cli.check import verify_command

    raise typer.Exit(verify_command(only=only, slow=slow, shared_data=shared_data, as_json=json_))


@fem_app.command(epilog=_example("palpate fem bench --json"))
def bench(
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    json_: JsonOption = False,
) -> None:
    """Seconds for a trajectory of 20 steps, with GFlop/s beside the machine's peak."""
    from palpate_fem.cli.check import bench_command

    raise typer.Exit(bench_command(edge_mm=edge_mm, layers=layers, as_json=json_))


@fem_app.command(epilog=_example("palpate fem study mesh --png mesh.png"))
def study(
    what: Annotated[Study, typer.Argument(metavar="mesh|steps", help="What is refined.")],
    png: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw it.")] = None,
    json_: JsonOption = False,
) -> None:
    """What finer meshes or smaller steps change: sphere, cube on its edge and ring, 3 mm deep."""
    from palpate_fem.cli.study import study_command

    raise typer.Exit(study_command(what.value, png=png, as_json=json_))


@fem_app.command(epilog=_example("palpate fem calibrate measured.h5 --out fit.json"))
def calibrate(
    measured: MeasuredArgument,
    out: Annotated[
        Path, typer.Option(metavar="FIT.json", help="Result; `run --parameters` takes it.")
    ] = Path("fit.json"),
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Use trajectories that begin so; repeatable.")
    ] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the fit.")] = None,
    workers: WorkersOption = 0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
) -> None:
    """Find skin thickness, modulus, friction and fluid volume from measured forces."""
    from palpate_fem.cli.calibrate import calibrate_command
    from palpate_fem.cli.model import model_of

    model = model_of(mesh=mesh, edge_mm=edge_mm, layers=layers)
    raise typer.Exit(calibrate_command(measured, out, only or [], model, png=png, workers=workers))


@fem_app.command(epilog=_example("palpate fem recover", "palpate fem recover --edge-mm 0.9"))
def recover(
    noise_n: Annotated[
        float, typer.Option("--noise-n", min=0.0, help="Noise of each force axis [N].")
    ] = 0.02,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    workers: WorkersOption = 0,
    edge_mm: EdgeOption = None,
    json_: JsonOption = False,
) -> None:
    """Plant parameters, simulate noisy forces with them, and see whether calibration finds them."""
    from palpate_fem.cli.model import model_of
    from palpate_fem.cli.recover import recover_command

    model = model_of(mesh="biotac", edge_mm=edge_mm, layers=2)
    raise typer.Exit(
        recover_command(
            model, edge_mm=edge_mm, noise_n=noise_n, seed=seed, workers=workers, as_json=json_
        )
    )


@fem_app.command(
    epilog=_example("palpate fem validate measured.h5 --parameters fit.json --out runs/validation")
)
def validate(
    measured: MeasuredArgument,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of table and plots.")] = Path(
        "runs/validation"
    ),
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Use trajectories that begin so; repeatable.")
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(metavar="NAME.sim", help="Take simulations from this store; run none."),
    ] = None,
    workers: WorkersOption = 0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
) -> None:
    """Compare simulated with measured forces: the paper's table by indenter, and its plots."""
    from palpate_fem.cli.calibrate import validate_command
    from palpate_fem.cli.model import model_of

    model = model_of(mesh=mesh, edge_mm=edge_mm, layers=layers, fit=parameters)
    raise typer.Exit(
        validate_command(measured, out, only or [], model, store=store, workers=workers)
    )


@fem_app.command(epilog=_example("palpate fem serve --workers 2"))
def serve(
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="The station's router.")
    ] = "tcp/127.0.0.1:7447",
    station: Annotated[str, typer.Option("--station", help="Name of the station.")] = "lab",
    sensor: Annotated[str, typer.Option("--sensor", help="Name to answer under.")] = "twin",
    workers: WorkersOption = 0,
    waiting: Annotated[int, typer.Option(min=0, help="Requests that may wait.")] = 8,
    max_deadline_s: Annotated[
        float, typer.Option(min=1, help="Longest time for a request [s].")
    ] = 600.0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
    skin_thickness_mm: ThicknessOption = None,
    shear_modulus_kpa: ModulusOption = None,
    friction: FrictionOption = None,
) -> None:
    """Answer simulation requests of a running station until Ctrl-C."""
    from palpate_fem.cli.model import model_of
    from palpate_fem.cli.serve import serve_command

    model = model_of(
        mesh=mesh,
        edge_mm=edge_mm,
        layers=layers,
        fit=parameters,
        skin_thickness_mm=skin_thickness_mm,
        shear_modulus_kpa=shear_modulus_kpa,
        friction=friction,
    )
    serve_command(
        model,
        connect=connect,
        station=station,
        sensor=sensor,
        workers=workers,
        waiting=waiting,
        max_deadline_s=max_deadline_s,
    )
