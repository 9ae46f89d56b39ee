"""``palpate topic``: what is on the bus."""

from __future__ import annotations

from typing import Annotated

import typer

from palpate_deploy.options import (
    DEFAULT_CONNECT,
    DEFAULT_STATION,
    ConnectOption,
    JsonOption,
    SensorOption,
    StationOption,
    client_link,
    example,
    group,
)

app = group("What is on the bus: streams, rates, messages.")

TopicArgument = Annotated[str, typer.Argument(metavar="TOPIC", help="E.g. electrodes, features.")]


@app.command("list", epilog=example("palpate topic list"))
def list_(
    seconds: Annotated[float, typer.Option(min=0.1, help="How long to listen [s].")] = 1.5,
    connect: ConnectOption = DEFAULT_CONNECT,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """Every stream of the contract, and which of them are heard now."""
    from palpate_deploy.topic_list import list_topics

    list_topics(client_link(connect), station, seconds, as_json=json_)


@app.command(
    epilog=example("palpate topic hz electrodes", "palpate topic hz features --sensor finger")
)
def hz(
    topic: TopicArgument = "electrodes",
    sensor: SensorOption = "*",
    seconds: Annotated[
        float, typer.Option(min=0, help="End after this time [s]; 0 = at Ctrl-C.")
    ] = 0,
    connect: ConnectOption = DEFAULT_CONNECT,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """Rate, jitter, bandwidth and loss of a stream, once a second."""
    from palpate_deploy.topic_hz import measure

    raise typer.Exit(measure(client_link(connect), station, topic, sensor, seconds, as_json=json_))


@app.command(epilog=example("palpate topic echo features --count 3"))
def echo(
    topic: TopicArgument = "features",
    sensor: SensorOption = "*",
    count: Annotated[int, typer.Option(min=0, help="End after so many; 0 = at Ctrl-C.")] = 0,
    timeout_s: Annotated[float, typer.Option(help="End when none comes for so long [s].")] = 10.0,
    connect: ConnectOption = DEFAULT_CONNECT,
    station: StationOption = DEFAULT_STATION,
    json_: JsonOption = False,
) -> None:
    """Messages of a stream, decoded."""
    from palpate_deploy.topic_echo import echo_topic

    echo_topic(
        client_link(connect),
        station,
        topic,
        sensor,
        count=count,
        timeout_s=timeout_s,
        as_json=json_,
    )
