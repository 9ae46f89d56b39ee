"""``palpate emulate``: BioTacs.

Nothing heavy is imported before a command runs: ``palpate --help`` must not wait for NumPy.
"""

from __future__ import annotations

from typing import Annotated

import typer

from palpate_gateway.cli.emulate_options import (
    MULTICAST,
    DriftOption,
    Electrodes,
    ElectrodesOption,
    EpochOption,
    FaultOption,
    LinkOption,
    PacFirstOption,
    Play,
    PlayOption,
    SecondsOption,
    SeedOption,
    SlotRateOption,
    TrajectoryOption,
    UnitOption,
    playing,
)


def biotac_can(
    interface: Annotated[
        str, typer.Option(help="python-can's kind of bus; udp_multicast needs no hardware.")
    ] = "udp_multicast",
    channel: Annotated[str, typer.Option(help="Which bus.")] = MULTICAST,
    bus: Annotated[
        list[str] | None,
        typer.Option("--bus", metavar="KEY=VALUE", help="More of python-can's; repeatable."),
    ] = None,
    fingers: Annotated[int, typer.Option(min=1, max=3, help="BioTacs on the bus.")] = 3,
    can_id: Annotated[int, typer.Option(min=0, max=0x7FF, help="Identifier of frames.")] = 1,
    slot_rate_hz: SlotRateOption = 4400,
    pac_first: PacFirstOption = False,
    electrodes: ElectrodesOption = Electrodes.BIOTAC,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    unit: UnitOption = "",
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """BioTacs at SynTouch's CAN interface: one CAN frame for each sampled channel."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch, unit).counts(fingers)
    device = emulated.biotac_can(
        source,
        interface,
        channel,
        bus or [],
        fingers=fingers,
        can_id=can_id,
        slot_rate_hz=slot_rate_hz,
        pac_first=pac_first,
        electrodes=int(electrodes),
        drift_ppm=drift_ppm,
    )
    emulate_command(device, fault or [], seconds)


def biotac_bridge(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(min=1, help="Its speed [bit/s].")] = 460800,
    fingers: Annotated[int, typer.Option(min=1, max=5, help="BioTacs that it samples.")] = 3,
    source_id: Annotated[int, typer.Option(min=0, max=255, help="The bridge's id.")] = 1,
    slot_rate_hz: SlotRateOption = 4400,
    slots_per_packet: Annotated[
        int, typer.Option(min=22, max=44, help="Slots of a packet, 5 to 10 ms.")
    ] = 44,
    pac_first: PacFirstOption = False,
    electrodes: ElectrodesOption = Electrodes.BIOTAC,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    unit: UnitOption = "",
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """BioTacs behind our own microcontroller bridge, on a serial line."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    device = emulated.biotac_bridge(
        playing(play, seed, trajectory, epoch, unit).counts(fingers),
        link,
        baud,
        fingers=fingers,
        source_id=source_id,
        slot_rate_hz=slot_rate_hz,
        slots_per_packet=slots_per_packet,
        pac_first=pac_first,
        electrodes=int(electrodes),
        drift_ppm=drift_ppm,
    )
    emulate_command(device, fault or [], seconds)


def biotac_pic32(
    link: LinkOption = None,
    baud: Annotated[int, typer.Option(min=1, help="Its speed [bit/s].")] = 230400,
    electrodes_first: Annotated[
        bool, typer.Option("--electrodes-first", help="Its firmware is the older one.")
    ] = False,
    play: PlayOption = Play.TWIN,
    seed: SeedOption = 0,
    unit: UnitOption = "",
    trajectory: TrajectoryOption = None,
    epoch: EpochOption = 0.0,
    drift_ppm: DriftOption = 200.0,
    fault: FaultOption = None,
    seconds: SecondsOption = 0,
) -> None:
    """A BioTac polled by a PIC32 board, on a serial line; silent until its client starts it."""
    from palpate_gateway.cli import emulated
    from palpate_gateway.cli.emulate import emulate_command

    source = playing(play, seed, trajectory, epoch, unit).counts(1)
    device = emulated.biotac_pic32(
        source, link, baud, electrodes_first=electrodes_first, drift_ppm=drift_ppm
    )
    emulate_command(device, fault or [], seconds)
