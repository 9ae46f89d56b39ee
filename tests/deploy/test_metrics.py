"""Metrics for Prometheus: what a station says, as an independent parser reads it."""

from __future__ import annotations

import dataclasses
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.samples import Sample

from palpate.bus import Session
from palpate.census import ProcessReport
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate.messages import SensorState, SensorStatus, ServiceState, Status, SupervisedProcess
from palpate_deploy.station import metrics
from palpate_deploy.station.metrics import StationCollector, run_metrics
from palpate_deploy.station.observation import ObservedProcess
from palpate_deploy.station.profile import MetricsConfig, Profile, parse_profile

PATIENCE_S = 20.0
WaitUntil = Callable[[Callable[[], bool], float, str], float]

FEATURES = Status(
    "features",
    "left",
    ServiceState.DEGRADED,
    1,
    1,
    60.0,
    "1",
    {"frames_received": 500, "stale": 10},
    {"latency_p50_s": 1.25e-3, "latency_p99_s": 3e-3, "infer_p50_s": 4e-4, "busy_ratio": 0.5,
     "process_rss_bytes": 1e8},
    models=("features-twin:12",),
)  # fmt: skip
GATEWAY = Status(
    "gateway",
    "gateway",
    ServiceState.READY,
    1,
    1,
    60.0,
    "1",
    {"thumb.frames_published": 7, "ring.frames_published": 9, "wall_steps": 1},
    {"thumb.tare_age_s": 61.0},
    sensor_states=(
        SensorStatus("thumb", SensorState.LIVE),
        SensorStatus("ring", SensorState.LOST),
    ),
)
SUPERVISOR = Status(
    "supervisor",
    "supervisor",
    ServiceState.READY,
    1,
    1,
    60.0,
    "1",
    {"features.hung": 2},
    {"router.process_rss_bytes": 7e7},
    processes=(SupervisedProcess("features", "left", "running", 4711, 3, 1.0),),
)


def observed(*statuses: Status, up: bool = True) -> list[ObservedProcess]:
    return [
        ObservedProcess(ProcessReport(one.service, one.instance, up, up, one if up else None))
        for one in statuses
    ]


def exported(*statuses: Status, up: bool = True) -> dict[str, list[Sample]]:
    """Samples by name, from the text that Prometheus would read."""
    collector = StationCollector("lab", Health("metrics", "metrics"))
    collector.update(observed(*statuses, up=up))
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    found: dict[str, list[Sample]] = {}
    for family in text_string_to_metric_families(generate_latest(registry).decode()):
        for sample in family.samples:
            found.setdefault(sample.name, []).append(sample)
    return found


def value(samples: list[Sample], **labels: str) -> float:
    """The value of the only sample that has these labels."""
    (one,) = [s for s in samples if labels.items() <= s.labels.items()]
    return one.value


def test_counters_gauges_and_latencies_of_a_process() -> None:
    found = exported(FEATURES)
    (received,) = found["palpate_frames_received_total"]
    assert received.labels == {
        "station": "lab", "service": "features", "instance": "left", "sensor": "",
    }  # fmt: skip
    assert received.value == 500
    assert value(found["palpate_stale_total"]) == 10
    assert value(found["palpate_busy_ratio"]) == 0.5
    assert value(found["palpate_process_rss_bytes"]) == 1e8
    latency = found["palpate_latency_seconds"]
    assert value(latency, stage="latency", quantile="0.5") == 1.25e-3
    assert value(latency, stage="latency", quantile="0.99") == 3e-3
    assert value(latency, stage="infer", quantile="0.5") == 4e-4
    assert value(found["palpate_process_up"]) == 1
    assert value(found["palpate_process_state"], state="degraded") == 1
    assert value(found["palpate_process_state"], state="ready") == 0
    assert value(found["palpate_model_info"], model="features-twin", version="12") == 1


def test_sensors_have_a_label() -> None:
    found = exported(GATEWAY)
    frames = found["palpate_frames_published_total"]
    assert (value(frames, sensor="thumb"), value(frames, sensor="ring")) == (7, 9)
    assert value(found["palpate_tare_age_seconds"], sensor="thumb") == 61.0
    assert value(found["palpate_wall_steps_total"], sensor="") == 1
    assert value(found["palpate_sensor_state"], sensor="ring", state="lost") == 1
    assert value(found["palpate_sensor_state"], sensor="thumb", state="lost") == 0


def test_the_only_sensor_of_a_gateway_has_its_label_too() -> None:
    alone = dataclasses.replace(
        GATEWAY,
        counters={"frames_published": 5},
        gauges={"tare_age_s": 3.0, "process_rss_bytes": 1.0},
        sensor_states=GATEWAY.sensor_states[:1],
    )
    found = exported(alone)
    assert value(found["palpate_frames_published_total"], sensor="thumb") == 5
    assert value(found["palpate_process_rss_bytes"], sensor="") == 1.0


def test_the_supervisor_speaks_for_the_router_and_counts_restarts() -> None:
    found = exported(SUPERVISOR, FEATURES)
    assert value(found["palpate_process_rss_bytes"], service="router") == 7e7
    assert value(found["palpate_process_restarts_total"], service="features") == 3
    assert value(found["palpate_hung_total"], service="features", sensor="") == 2


def test_each_replica_has_its_own_figures() -> None:
    """Those of the second were left out: the first was not told apart from it."""
    other = dataclasses.replace(
        SUPERVISOR,
        instance="supervisor-b",
        counters={"features.hung": 4},
        gauges={},
        processes=(SupervisedProcess("features", "features-b", "running", 4712, 1, 1.0),),
    )
    found = exported(SUPERVISOR, other)
    hung = {one.labels["instance"]: one.value for one in found["palpate_hung_total"]}
    assert hung == {"left": 2, "features-b": 4}
    assert value(found["palpate_exporter_left_out"]) == 0


def test_a_process_that_says_nothing_is_down_and_has_no_old_values() -> None:
    found = exported(FEATURES, up=False)
    assert value(found["palpate_process_up"]) == 0
    assert found.keys() == {"palpate_process_up", "palpate_exporter_left_out"}


@pytest.mark.parametrize(
    "name", ["x\ny 1", "a{b}", "", "ä", "9lives", "x" * 300, "process_up", "latency_seconds"]
)
def test_a_name_that_cannot_be_a_metric_is_left_out_and_counted(name: str) -> None:
    bad = dataclasses.replace(FEATURES, counters={name: 1, "fine": 2}, gauges={})
    found = exported(bad)
    assert value(found["palpate_fine_total"]) == 2
    if name != "latency_seconds":
        assert value(found["palpate_exporter_left_out"]) == 1


def test_labels_are_escaped() -> None:
    odd = dataclasses.replace(FEATURES, models=('a"b\\c:1',))
    assert value(exported(odd)["palpate_model_info"], model='a"b\\c') == 1


def test_invented_names_are_bounded() -> None:
    counters = {f"name_{number}": 1 for number in range(3 * metrics.SERIES_MOST)}
    found = exported(dataclasses.replace(FEATURES, counters=counters))
    assert sum(map(len, found.values())) <= metrics.SERIES_MOST + 1
    assert value(found["palpate_exporter_left_out"]) >= 2 * metrics.SERIES_MOST


@contextmanager
def serving(link: LinkConfig, port: int) -> Iterator[Callable[[], dict[str, list[Sample]]]]:
    """The process, and a scrape of it."""
    stop = threading.Event()
    config = MetricsConfig(listen=f"127.0.0.1:{port}")
    process = threading.Thread(target=run_metrics, args=(config, link, "lab", stop))
    process.start()

    def scrape() -> dict[str, list[Sample]]:
        try:
            with urllib.request.urlopen(f"http://{config.listen}/metrics", timeout=10) as answer:
                text = answer.read().decode()
        except OSError:
            return {}
        return {
            sample.name: [s for s in family.samples if s.name == sample.name]
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }

    try:
        yield scrape
    finally:
        stop.set()
        process.join(PATIENCE_S)
    assert not process.is_alive()


def test_a_station_is_served_over_http(
    link: LinkConfig, free_port: int, wait_until: WaitUntil
) -> None:
    with Session.open(link) as session:
        health = Health("features", "features")
        health.set_state(ServiceState.READY)
        reporter = HealthReporter(
            session, health, period_s=0.1, refresh=lambda: health.count("frames_received", 10)
        )
        presence = session.presence("features", instance="features")
        presence.ready()
        with serving(link, free_port) as scrape:

            def up(service: str) -> bool:
                found = scrape().get("palpate_process_up", [])
                return any(s.labels["service"] == service and s.value == 1 for s in found)

            wait_until(lambda: up("features") and up("metrics"), PATIENCE_S, "all are up")
            first = value(scrape()["palpate_frames_received_total"], service="features")

            def grows() -> bool:
                samples = scrape()["palpate_frames_received_total"]
                return value(samples, service="features") > first

            wait_until(grows, PATIENCE_S, "the counter grows")
            assert value(scrape()["palpate_scrapes_total"], service="metrics") > 0
            reporter.close()
            presence.close()
            wait_until(
                lambda: "palpate_frames_received_total" not in scrape(),
                PATIENCE_S,
                "a process that has gone disappears",
            )


def test_a_port_in_use_is_said(link: LinkConfig, free_port: int, wait_until: WaitUntil) -> None:
    with serving(link, free_port) as scrape:
        wait_until(lambda: bool(scrape()), PATIENCE_S, "it serves")
        with pytest.raises(LinkError, match=f"127.0.0.1:{free_port}") as caught:
            run_metrics(
                MetricsConfig(listen=f"127.0.0.1:{free_port}"), link, "lab", threading.Event()
            )
    assert "[metrics] listen" in caught.value.remedy


@pytest.mark.parametrize("listen", ["0.0.0.0:9464", "192.168.1.7:9464", "9464", "[::]:9464", ":1"])
def test_metrics_stay_on_this_host(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"metrics\.listen"):
        parse_profile({"metrics": {"listen": listen}}, where="lab.toml")


def test_a_station_has_metrics_only_if_its_profile_names_them() -> None:
    assert "metrics" not in Profile().processes
    named = parse_profile({"processes": ["router", "metrics"]}, where="lab.toml")
    assert named.metrics.listen == "127.0.0.1:9464"
