"""``palpate fem``: signatures and help only; each command's work is in another module.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from palpate.errors import ConfigError, MissingExtraError

EXTRA_MODULES = ("scipy", "warp", "pymetis", "threadpoolctl", "h5py", "matplotlib")
"""Packages that ``palpate[fem]`` installs and a bare palpate does not."""


class FemGroup(typer.core.TyperGroup):
    """A group of commands that name the missing extra when a package is not installed."""

    def invoke(self, ctx: typer.Context) -> object:  # type: ignore[override]
        """Run the command of the command line."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing in EXTRA_MODULES:
                raise MissingExtraError(missing, extra="fem") from error
            raise


MeshOption = Annotated[
    str, typer.Option("--mesh", metavar="biotac|FOLDER", help="Mesh, or folder of the public mesh.")
]
EdgeOption = Annotated[
    float | None, typer.Option("--edge-mm", help="Edge of the mesh's elements on the pad [mm].")
]
LayersOption = Annotated[int, typer.Option("--layers", min=1, help="Elements through the skin.")]
ParametersOption = Annotated[
    Path | None,
    typer.Option("--parameters", metavar="FIT.json", help="Parameters that `calibrate` found."),
]
ThicknessOption = Annotated[
    float | None, typer.Option("--skin-thickness-mm", help="Skin thickness [mm].")
]
ModulusOption = Annotated[
    float | None, typer.Option("--shear-modulus-kpa", help="Shear modulus of the skin [kPa].")
]
StiffeningOption = Annotated[
    float | None,
    typer.Option(
        "--strain-stiffening",
        help="Yeoh's 3 C3 / C1 of the skin, as silicone has it: 0.004 and more; none = neo-Hooke.",
    ),
]
FrictionOption = Annotated[
    float | None, typer.Option("--friction", help="Friction coefficient of indenter and skin.")
]
FillOption = Annotated[
    float | None,
    typer.Option(
        "--fill-ml",
        help="Fluid under the skin [ml]; none = as the parameters say, or until 15.1 mm thick.",
    ),
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Solver processes; 0 = one for each core.")
]
DeviceOption = Annotated[
    list[str] | None,
    typer.Option(
        "--device",
        metavar="NAME",
        help="--sweep: solve many trajectories at once on this device (cuda:0, ..., or cpu); "
        "repeatable. With --ray: cuda = on each GPU of the cluster. --workers are then the "
        "processes that make files.",
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="--sweep: on the machines of a Ray cluster: HOST:PORT, auto or local.",
    ),
]
SlotsOption = Annotated[
    int | None,
    typer.Option(
        "--slots",
        min=1,
        help="--device: trajectories at once [default: 128], 0.22 GB each.",
    ),
]
SlopesOption = Annotated[
    bool,
    typer.Option(
        "--slopes",
        help="Derive each run by the parameters, so that fewer will do. Parametric mesh only.",
    ),
]
OnlyOption = Annotated[
    list[str] | None, typer.Option("--only", help="Only names with this prefix; repeatable.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
MeasuredArgument = Annotated[
    Path, typer.Argument(metavar="MEASURED.h5", help="Measured indentations.")
]


class StudyKind(StrEnum):
    """What a study is of."""

    MESH = "mesh"
    STEPS = "steps"
    PATHS = "paths"


fem_app = typer.Typer(
    cls=FemGroup,
    help="The fingertip in finite elements: simulate, verify, calibrate, serve (palpate[fem]).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


units_app = typer.Typer(
    cls=FemGroup,
    help="Specimens (individual BioTacs) on the simulated finger: fit, draw, show them.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
fem_app.add_typer(units_app, name="units")


def _example(*lines: str) -> str:
    return "Example: " + "  or  ".join(lines)


@fem_app.command(
    epilog=_example(
        "palpate fem run --indenter sphere_7mm --depth-mm 2 --png press.png",
        'palpate fem run --path "press 2 mm, slide 1.5 mm towards +y, twist 20 deg, unload"',
        "palpate fem run --sweep --points 2 --store runs/paper.sim",
        "palpate fem run --sweep --store runs/paper.sim --device cuda:0 --device cuda:1",
        "palpate fem run --sweep --store runs/paper.sim --ray head:6379 --device cuda",
    )
)
def run(
    context: typer.Context,
    indenter: Annotated[
        list[str] | None, typer.Option("--indenter", help="Indenter; with --sweep repeatable.")
    ] = None,
    depth_mm: Annotated[float, typer.Option(help="Travel from first contact on [mm].")] = 3.0,
    at_mm: Annotated[
        tuple[float, float], typer.Option(metavar="X Y", help="Target on the pad [mm].")
    ] = (-4.0, 0.0),
    angle_deg: Annotated[float, typer.Option(help="Angle to the inward normal [degrees].")] = 0.0,
    azimuth_deg: Annotated[
        float, typer.Option(help="Direction of an angled path: 0 distal, 90 +y [degrees].")
    ] = 0.0,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a press.")] = 20,
    path: Annotated[
        str | None,
        typer.Option(
            metavar="SEGMENTS",
            help="Instead of a press: 'press 2 mm [at 30 deg towards distal], slide 1 mm towards "
            "+y, twist 20 deg, roll 10 deg towards 45 deg, unload [1 mm]', in any order after a "
            "press.",
        ),
    ] = None,
    step_mm: Annotated[
        float, typer.Option(help="--path: longest step [mm]; 2.5 degrees count as 0.15 mm.")
    ] = 0.15,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead of a press: poses from a .csv, .json or .npz file with the columns "
            "x_m,y_m,z_m,qw,qx,qy,qz.",
        ),
    ] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="The paper's set of indentations.")
    ] = False,
    points: Annotated[int, typer.Option(min=1, help="--sweep: points for each indenter.")] = 10,
    angled: Annotated[
        int, typer.Option(min=0, max=4, help="--sweep: angled paths for each point.")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="--sweep: seed of the points.")] = 0,
    store: Annotated[
        Path | None,
        typer.Option(metavar="NAME.sim", help="Store to write or continue."),
    ] = None,
    stress: Annotated[bool, typer.Option("--stress", help="Keep stress in the store.")] = False,
    png: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the result.")] = None,
    limit_s: Annotated[
        float,
        typer.Option(
            min=1,
            help="Time limit for one trajectory [s]; --device: for one that the CPU has to solve.",
        ),
    ] = 600.0,
    workers: WorkersOption = 0,
    device: DeviceOption = None,
    slots: SlotsOption = None,
    ray: RayOption = None,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
    skin_thickness_mm: ThicknessOption = None,
    shear_modulus_kpa: ModulusOption = None,
    strain_stiffening: StiffeningOption = None,
    friction: FrictionOption = None,
    fill_ml: FillOption = None,
    json_: JsonOption = False,
) -> None:
    """Simulate one indentation, or the paper's set; Ctrl-C keeps completed trajectories."""
    from palpate_fem.cli.model import model_of
    from palpate_fem.cli.run import RunOptions, run_command

    raise typer.Exit(
        run_command(
            RunOptions(
                indenters=tuple(indenter or ()),
                depth_m=depth_mm * 1e-3,
                at_m=(at_mm[0] * 1e-3, at_mm[1] * 1e-3),
                angle_deg=angle_deg,
                azimuth_deg=azimuth_deg,
                steps=steps,
                path=path,
                step_m=step_mm * 1e-3,
                poses=poses,
                sweep=sweep,
                points=points,
                angled=angled,
                seed=seed,
                store=store,
                stress=stress,
                png=png,
                limit_s=limit_s,
                as_json=json_,
                devices=tuple(device or ()),
                slots=slots,
                ray=ray,
                given=_given(context),
            ),
            model_of(
                mesh=mesh,
                edge_mm=edge_mm,
                layers=layers,
                fit=parameters,
                skin_thickness_mm=skin_thickness_mm,
                shear_modulus_kpa=shear_modulus_kpa,
                strain_stiffening=strain_stiffening,
                friction=friction,
                fill_ml=fill_ml,
            ),
            workers=workers,
        )
    )


def _given(context: typer.Context) -> frozenset[str]:
    """Parameters of a command that were given, not left at their defaults."""
    source = context.get_parameter_source
    return frozenset(
        name
        for name in context.params
        if (found := source(name)) is not None and found.name != "DEFAULT"
    )


def _refuse_given(context: typer.Context, names: set[str], why: str) -> None:
    """Refuse parameters that were given although they have no effect; ``why`` ends the sentence.

    Raises:
        ConfigError: One was; names it.
    """
    for name in sorted(names & _given(context)):
        raise ConfigError(f"--{name.replace('_', '-')} has no effect {why}", remedy="leave it out")


@fem_app.command(epilog=_example("palpate fem export runs/paper.sim paper.h5"))
def export(
    store: Annotated[Path, typer.Argument(metavar="NAME.sim", help="A store of simulations.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.h5", help="The file; never replaced.")],
) -> None:
    """Copy a store into one HDF5 file to pass on; all commands read it like the store."""
    from palpate_fem.cli.run import export_command

    export_command(store, out)


@fem_app.command(epilog=_example("palpate fem verify", "palpate fem verify --only hertz --json"))
def verify(
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="WORD", help="Only checks with this word in the name."),
    ] = None,
    slow: Annotated[bool, typer.Option("--slow", help="Also checks that take minutes.")] = False,
    shared_data: Annotated[
        Path | None,
        typer.Option(
            "--public-data", metavar="FOLDER", help="Folder that holds nvlabs_biotac_mesh."
        ),
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Check the solver against closed forms and itself; one line for each check."""
    from palpate_fem.cli.check import verify_command

    raise typer.Exit(verify_command(only=only, slow=slow, shared_data=shared_data, as_json=json_))


@fem_app.command(epilog=_example("palpate fem bench --json"))
def bench(
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    json_: JsonOption = False,
) -> None:
    """Time a trajectory of 20 steps; compare its GFlop/s with the peak of the machine."""
    from palpate_fem.cli.check import bench_command

    bench_command(edge_mm=edge_mm, layers=layers, as_json=json_)


@fem_app.command(
    epilog=_example("palpate fem study mesh --png mesh.png", "palpate fem study paths --json")
)
def study(
    context: typer.Context,
    what: Annotated[
        StudyKind, typer.Argument(metavar="mesh|steps|paths", help="What to refine, or paths.")
    ],
    png: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="mesh, steps: draw it.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="paths: number.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="paths: seed.")] = 0,
    edge_mm: Annotated[float, typer.Option(help="paths: edge of the mesh [mm].")] = 0.47,
    fill_ml: FillOption = None,
    json_: JsonOption = False,
) -> None:
    """Refine mesh or steps and compare, or check random paths.

    Mesh and steps: sphere, cube on its edge and ring, 3 mm deep. Paths: presses that slide, twist,
    roll and go back; do they complete, does friction only take work, is the skin as it was?
    """
    from palpate_fem.cli.check import path_study_command, study_command

    of_paths = {"count", "seed", "edge_mm", "fill_ml"} & _given(context)
    if what is not StudyKind.PATHS and of_paths:
        raise typer.BadParameter(f"--{min(of_paths).replace('_', '-')} is for paths only")
    if what is StudyKind.PATHS:
        if png is not None:
            raise typer.BadParameter("--png draws mesh and steps only")
        code = path_study_command(
            count=count,
            seed=seed,
            edge_m=edge_mm * 1e-3,
            fluid_volume_m3=None if fill_ml is None else fill_ml * 1e-6,
            as_json=json_,
        )
    else:
        code = study_command(what.value, png=png, as_json=json_)
    raise typer.Exit(code)


@fem_app.command(epilog=_example("palpate fem calibrate measured.h5 --out fit.json"))
def calibrate(
    measured: MeasuredArgument,
    out: Annotated[
        Path, typer.Option(metavar="FIT.json", help="Result, for `run --parameters`.")
    ] = Path("fit.json"),
    only: OnlyOption = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the fit.")] = None,
    workers: WorkersOption = 0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    slopes: SlopesOption = False,
    total_thickness_mm: Annotated[
        float,
        typer.Option(
            "--total-thickness-mm",
            help="Filled finger from nail to pad, by caliper [mm]; sets the fluid volume.",
        ),
    ] = 15.1,
) -> None:
    """Find skin thickness, modulus and friction from measured forces.

    The fluid volume follows from the total thickness, which the presses do not tell.
    """
    from palpate_fem.cli.identify import calibrate_command
    from palpate_fem.cli.model import model_of

    model = model_of(mesh=mesh, edge_mm=edge_mm, layers=layers)
    raise typer.Exit(
        calibrate_command(
            measured,
            out,
            only or [],
            model,
            png=png,
            workers=workers,
            slopes=slopes,
            total_thickness_m=total_thickness_mm * 1e-3,
        )
    )


@fem_app.command(epilog=_example("palpate fem recover", "palpate fem recover --edge-mm 0.9"))
def recover(
    noise_n: Annotated[
        float, typer.Option("--noise-n", min=0.0, help="Noise of each force axis [N].")
    ] = 0.02,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    workers: WorkersOption = 0,
    edge_mm: EdgeOption = None,
    slopes: SlopesOption = False,
    json_: JsonOption = False,
) -> None:
    """Simulate noisy forces with known parameters, and check that calibration finds them."""
    from palpate_fem.cli.identify import recover_command
    from palpate_fem.cli.model import model_of

    model = model_of(mesh="biotac", edge_mm=edge_mm, layers=2)
    raise typer.Exit(
        recover_command(
            model,
            edge_mm=edge_mm,
            noise_n=noise_n,
            seed=seed,
            workers=workers,
            slopes=slopes,
            as_json=json_,
        )
    )


@fem_app.command(
    epilog=_example("palpate fem validate measured.h5 --parameters fit.json --out runs/validation")
)
def validate(
    context: typer.Context,
    measured: MeasuredArgument,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for table and plots.")] = Path(
        "runs/validation"
    ),
    only: OnlyOption = None,
    store: Annotated[
        Path | None,
        typer.Option(metavar="NAME.sim", help="Use simulations of this store; run none."),
    ] = None,
    workers: WorkersOption = 0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
) -> None:
    """Compare simulated with measured forces: the paper's table by indenter and its plots."""
    from palpate_fem.cli.identify import validate_command
    from palpate_fem.cli.model import model_of

    if store is not None:
        of_model = {"mesh", "edge_mm", "layers", "parameters"}
        _refuse_given(context, of_model, "with --store, whose simulations are compared")
    model = model_of(mesh=mesh, edge_mm=edge_mm, layers=layers, fit=parameters)
    raise typer.Exit(
        validate_command(measured, out, only or [], model, store=store, workers=workers)
    )


@fem_app.command(
    epilog=_example("palpate fem serve --workers 2", "palpate fem serve --device cuda:0 --slots 16")
)
def serve(
    connect: Annotated[
        str,
        typer.Option(
            "--connect", metavar="ENDPOINT", envvar="PALPATE_CONNECT", help="The station's router."
        ),
    ] = "tcp/127.0.0.1:7447",
    tls: Annotated[
        Path | None,
        typer.Option(
            "--tls",
            metavar="FOLDER",
            envvar="PALPATE_TLS",
            help="Certificates for a router tls/HOST:PORT: ca.pem, cert.pem, key.pem.",
        ),
    ] = None,
    station: Annotated[
        str, typer.Option("--station", envvar="PALPATE_STATION", help="Name of the station.")
    ] = "lab",
    sensor: Annotated[str, typer.Option("--sensor", help="Sensor name of the service.")] = "twin",
    workers: Annotated[
        int,
        typer.Option("--workers", min=0, help="Solver processes; 0 = one for each core, to 64."),
    ] = 0,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|auto",
            help="Solve requests with the parameters of this command and one of the nine indenters "
            "together on a GPU (cuda:0, ...); auto = the first one, if there is one. --workers do "
            "all else.",
        ),
    ] = None,
    slots: Annotated[
        int | None,
        typer.Option(min=1, help="--device: requests at once [default: 16], 0.22 GB each."),
    ] = None,
    waiting: Annotated[int, typer.Option(min=0, help="Most requests that wait.")] = 8,
    max_deadline_s: Annotated[
        float, typer.Option(min=1, help="Time limit for a request [s].")
    ] = 600.0,
    mesh: MeshOption = "biotac",
    edge_mm: EdgeOption = None,
    layers: LayersOption = 2,
    parameters: ParametersOption = None,
    skin_thickness_mm: ThicknessOption = None,
    shear_modulus_kpa: ModulusOption = None,
    strain_stiffening: StiffeningOption = None,
    friction: FrictionOption = None,
    fill_ml: FillOption = None,
) -> None:
    """Answer simulation requests of a running station until Ctrl-C."""
    from palpate_fem.cli.model import model_of
    from palpate_fem.cli.run import serve_command

    model = model_of(
        mesh=mesh,
        edge_mm=edge_mm,
        layers=layers,
        fit=parameters,
        skin_thickness_mm=skin_thickness_mm,
        shear_modulus_kpa=shear_modulus_kpa,
        strain_stiffening=strain_stiffening,
        friction=friction,
        fill_ml=fill_ml,
    )
    serve_command(
        model,
        connect=connect,
        tls=tls,
        station=station,
        sensor=sensor,
        workers=workers,
        device=device,
        slots=slots,
        waiting=waiting,
        max_deadline_s=max_deadline_s,
    )


@units_app.command(
    epilog=_example(
        "palpate fem units fit runs/twin/mechanics.sim --out three.json",
        "palpate fem units fit plate.sim --recording real.h5 --touches 12 --out mine.json",
    )
)
def fit(
    context: typer.Context,
    store: Annotated[Path, typer.Argument(metavar="STORE", help="Simulated trajectories.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.json", help="Where to write.")],
    overtravel_mm: Annotated[
        float | None,
        typer.Option(
            help="How much deeper than the paper's a specimen may have been pressed [mm].",
            show_default="as the paths of STORE",
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.h5",
            help="One real sensor's counts with forces, from `palpate data ingest-...`: fit to it.",
        ),
    ] = None,
    sensor: Annotated[
        str, typer.Option(metavar="NAME", help="--recording: which of its sensors.")
    ] = "",
    touches: Annotated[
        int | None,
        typer.Option(
            help="--recording: the first so many held touches; 0 = the rest alone; none = all."
        ),
    ] = None,
    held_rows: Annotated[
        int, typer.Option(min=1, help="--recording: rows for which a touch is held at least.")
    ] = 50,
) -> None:
    """Fit three specimens to the ranges and forces that the paper publishes, or one to a sensor.

    With --recording, STORE holds presses like the sensor's, anywhere on the pad: which of them a
    touch was is found with the specimen.
    """
    if recording is None:
        _refuse_given(context, {"sensor", "touches", "held_rows"}, "without --recording")
        from palpate_fem.cli.identify import fit_units_command

        overtravel_m = None if overtravel_mm is None else overtravel_mm * 1e-3
        raise typer.Exit(fit_units_command(store, out, overtravel_m=overtravel_m))
    _refuse_given(context, {"overtravel_mm"}, "with --recording")
    from palpate_fem.cli.identify import fit_sensor_command

    raise typer.Exit(
        fit_sensor_command(
            store, out, recording, sensor=sensor, touches=touches, held_rows=held_rows
        )
    )


@units_app.command(epilog="Example: palpate fem units draw 20 --seed 1 --out drawn.json")
def draw(
    count: Annotated[int, typer.Argument(metavar="N", help="Number of specimens.")],
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same specimens.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="Where to write them.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Draw specimens from priors that bracket real sensors."""
    from palpate_fem.cli.identify import draw_units_command

    draw_units_command(count, seed, out, as_json=as_json)


@units_app.command(epilog="Example: palpate fem units show")
def show(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[FILE.json]", help="Population; default: the one of palpate."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show the parameters of the specimens, and what they were fitted to."""
    from palpate_fem.cli.identify import show_units_command

    show_units_command(file, as_json=as_json)
