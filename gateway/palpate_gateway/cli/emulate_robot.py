"""``palpate emulate``: a robot that tells where its flange is.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from palpate_gateway.cli.emulate_options import (
    DriftOption,
    EpochOption,
    FaultOption,
    FingerOption,
    Play,
    PlayOption,
    PortOption,
    SecondsOption,
    SeedOption,
    TrajectoryOption,
)

if TYPE_CHECKING:
    from palpate_gateway.cli.emulated import Emulated
    from palpate_gateway.emulators.robot import RobotEmulator, TipSource


def robot(
    name: Annotated[str, typer.Option("--robot", help="Its name on the bus.")] = "arm",
    connect: Annotated[
        str, typer.Option(help="Endpoint of a router, e.g. tcp/127.0.0.1:7447; else it is one.")
    ] = "",
    port: PortOption = 0,
    station: Annotated[str, typer.Option(help="On which it publishes.")] = "lab",
    rate_hz: Annotated[float, typer.Option(min=1, max=2000, help="Poses each second.")] = 250,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    finger: FingerOption = 1,
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A robot that carries an indenter and tells its flange over Zenoh."""
    from palpate.config import endpoint_host_port
    from palpate.errors import ConfigError
    from palpate.names import check_name
    from palpate_gateway.cli.emulate import emulate_command
    from palpate_gateway.emulators.robot import RobotEmulator

    for text, what in ((name, "robot"), (station, "station")):
        check_name(text, what)
    if connect:
        try:
            endpoint_host_port(connect)
        except ValueError as error:
            raise ConfigError(
                f"--connect: {error}", remedy="name the router as palpate status shows it"
            ) from error
    tip, indenter = _played(play, finger - 1, trajectory or (), seed, epoch)
    emulator = RobotEmulator(
        tip,
        robot=name,
        rate_hz=rate_hz,
        connect=connect,
        port=port,
        station=station,
        drift_ppm=drift_ppm,
    )
    emulate_command(_emulated(emulator, indenter), fault or [], seconds)


def _played(
    play: Play, finger: int, trajectories: list[str] | tuple[()], seed: int, epoch_s: float
) -> tuple[TipSource, str]:
    """Where the tip is, and the name of what presses first."""
    from palpate_gateway.emulators.robot import above_the_pad, slow_approach

    if play is not Play.TWIN:
        return (above_the_pad if play is Play.IDLE else slow_approach), "sphere_7mm"
    from palpate_gateway.emulators.twin import loop_options
    from palpate_gateway.emulators.twin_tip import TwinTip, tip_loop

    typer.echo("the twin is computed ...", err=True)
    loop = tip_loop(loop_options(finger, trajectories=tuple(trajectories), seed=seed))
    return TwinTip(loop, epoch_s), loop.indenters[0]


def _emulated(emulator: RobotEmulator, indenter: str) -> Emulated:
    from palpate_gateway.cli.emulated import Emulated, Options
    from palpate_gateway.emulators.robot import BASE_SENSOR, FLANGE_INDENTER

    def sensors() -> list[tuple[str, Options]]:
        options: Options = {
            "robot": emulator.robot,
            "connect": emulator.address,
            "station": emulator.station,
            "rate_hz": emulator.rate_hz,
            "indenter": indenter,
        }
        for key, pose in (("base_sensor", BASE_SENSOR), ("flange_indenter", FLANGE_INDENTER)):
            options[key] = {"position_m": pose.position, "orientation_wxyz": pose.orientation}
        return [("robot", options)]

    return Emulated("robot", emulator, "pose_zenoh", sensors)
