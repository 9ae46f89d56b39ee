"""``palpate emulate``: the force/torque sensors.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from palpate_gateway.cli.emulate_options import (
    MULTICAST,
    DriftOption,
    EpochOption,
    FaultOption,
    FingerOption,
    HostOption,
    LinkOption,
    Play,
    PlayOption,
    PortOption,
    Product,
    SecondsOption,
    SeedOption,
    TrajectoryOption,
    playing,
)


def kms40(
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    serial: Annotated[int, typer.Option(min=0, help="Its serial number.")] = 310042,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    finger: FingerOption = 1,
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Weiss KMS 40 over TCP; its client sets the rate."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch).wrench(finger - 1)
    device = emulated.kms40(source, host=host, port=port, serial=serial, drift_ppm=drift_ppm)
    emulate_command(device, fault or [], seconds)


def rdt(
    product: Annotated[Product, typer.Option(help="Which of them.")] = Product.NET_FT,
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    http_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of its web page; 0 = any free one.")
    ] = 0,
    rate_hz: Annotated[
        float, typer.Option(min=0, max=8000, help="Records each second; 0 = 1000, of a HEX 100.")
    ] = 0,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    finger: FingerOption = 1,
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """An ATI Net F/T or Axia, a Schunk FTN or an OnRobot HEX over UDP."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch).wrench(finger - 1)
    device = emulated.rdt(
        source,
        product.value,
        host=host,
        port=port,
        http_port=http_port,
        rate_hz=rate_hz,
        drift_ppm=drift_ppm,
    )
    emulate_command(device, fault or [], seconds)


def robotous(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(help="Speed of the serial line [bit/s].")] = 115200,
    interface: Annotated[
        str, typer.Option(help="python-can's kind of bus; on a serial line without it.")
    ] = "",
    channel: Annotated[str, typer.Option(help="Which bus.")] = MULTICAST,
    model: Annotated[str, typer.Option(help="What it says that it is.")] = "RFT64-SB01",
    serial: Annotated[str, typer.Option(help="Its serial number.")] = "RFT-1",
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    finger: FingerOption = 1,
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Robotous RFT on a serial line or on CAN; its client sets the rate."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch).wrench(finger - 1)
    options: dict[str, Any] = {"model": model, "serial": serial, "drift_ppm": drift_ppm}
    if interface:
        device = emulated.robotous_can(source, interface, channel, **options)
    else:
        device = emulated.robotous_serial(source, link, baud, **options)
    emulate_command(device, fault or [], seconds)


def bota(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(help="Its speed [bit/s].")] = 460800,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    finger: FingerOption = 1,
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A Bota SensONE or Rokubi on a serial line; its client sets the rate."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch).wrench(finger - 1)
    device = emulated.bota(source, link, baud, drift_ppm=drift_ppm)
    emulate_command(device, fault or [], seconds)
