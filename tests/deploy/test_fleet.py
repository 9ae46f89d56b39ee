"""`palpate fleet`: every station that a router sees, a line for each."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Session
from palpate.bus.topics import LIVE_ROOT
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState
from palpate_deploy.station import fleet
from palpate_deploy.station.activity import SensorActivity
from palpate_deploy.station.fleet import StationSummary, look_at_fleet, show_fleet
from palpate_deploy.station.profile import load_profile


def test_each_station_has_a_line(link: LinkConfig, capsys: pytest.CaptureFixture[str]) -> None:
    with (
        Session.open(link, station="arm1") as first,
        Session.open(link, station="arm2") as second,
    ):
        sessions = {"arm1": first, "arm2": second}
        healths = {name: Health("features", "features") for name in sessions}
        reporters = [HealthReporter(sessions[name], healths[name]) for name in sessions]
        for name, session in sessions.items():
            session.presence("features", instance="features").ready()
            healths[name].set_state(ServiceState.READY)
        assert show_fleet(link, as_json=False) == 0
        shown = capsys.readouterr().out
        assert "arm1" in shown
        assert "arm2" in shown
        healths["arm2"].fail(LinkError("the cable is out", remedy="plug it in"))
        assert show_fleet(link, as_json=True) == 1
        told: dict[str, Any] = json.loads(capsys.readouterr().out)
        by_name = {one["station"]: one["troubles"] for one in told["stations"]}
        assert by_name["arm1"] == []
        assert "the cable is out" in by_name["arm2"][0]["problem"]
        for reporter in reporters:
            reporter.close()


def test_a_name_that_no_station_can_have_hides_no_other(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It ended the command; and what was cut off was not told."""
    monkeypatch.setattr(fleet, "_STATIONS_MOST", 1)
    with (
        Session.open(link, station="arm1") as first,
        Session.open(link, station="arm2") as second,
    ):
        for session in (first, second):
            session.presence("features", instance="features").ready()
        declare = first._raw.liveliness().declare_token
        odd = [
            declare(f"{LIVE_ROOT}/{name}/features/features/alive")
            for name in ("Arm 1", "a[red]", "\x1b[2J")
        ]
        assert [one.station for one in look_at_fleet(link)] == ["arm1"]
        for token in odd:
            token.undeclare()
    assert "2 stations are seen; the first 1 by name are asked" in caplog.text


def test_nobody_is_a_failure(link: LinkConfig) -> None:
    assert look_at_fleet(link) == []
    assert show_fleet(link, as_json=False) == 1


def test_only_a_finger_is_said_to_have_no_tare(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ring = SensorActivity("ring", "gateway", "live", 1.0, tactile=True)
    force = SensorActivity("force", "gateway", "live", 1.0)
    found = [StationSummary("arm1", [], [ring, force])]
    monkeypatch.setattr(fleet, "look_at_fleet", lambda _: found)
    show_fleet(LinkConfig(), as_json=False)
    shown = capsys.readouterr().out
    assert "ring live - no tare" in shown
    assert "force live -" in shown
    assert shown.count("tare") == 1


PROFILE = """
station = "arm1"
{top}

[router]
listen = ["tcp/127.0.0.1:7447"]
connect = ["{connect}"]
"""


@pytest.fixture
def profile_of(tmp_path: Path) -> Callable[..., Path]:
    def write(*, top: str = "", connect: str = "tls/192.168.1.2:7447") -> Path:
        path = tmp_path / "arm1.toml"
        path.write_text(PROFILE.format(top=top, connect=connect), encoding="utf-8")
        return path

    return write


def test_a_replica_names_its_processes(profile_of: Callable[..., Path]) -> None:
    profile = load_profile(profile_of(top='replica = "b"'))
    assert profile.instance("features") == "features-b"
    assert profile.instance("router") == "router"
    assert load_profile(profile_of()).instance("features") == "features"
    with pytest.raises(ConfigError, match="replica"):
        load_profile(profile_of(top='replica = "B/*"'))


def test_a_router_does_not_connect_to_itself(profile_of: Callable[..., Path]) -> None:
    with pytest.raises(ConfigError, match="itself listens"):
        load_profile(profile_of(connect="tcp/127.0.0.1:7447"))


def test_a_site_without_certificates_is_not_joined_with_roles(
    profile_of: Callable[..., Path],
) -> None:
    path = profile_of(connect="tcp/192.168.1.2:7447")
    text = path.read_text(encoding="utf-8").replace("tcp/127", "tls/127")
    path.write_text(text + '\n[link]\ncertificates = "/etc/palpate/certs"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="shows no certificate"):
        load_profile(path)


@pytest.mark.parametrize(
    ("connect", "listen", "direct"),
    [
        (("tls/127.0.0.1:7447",), ("tls/127.0.0.1:0",), True),
        (("tls/192.168.1.2:7447",), ("tls/127.0.0.1:0",), False),
        (("tls/192.168.1.2:7447",), ("tls/192.168.1.9:7448",), True),
        ((), ("tls/127.0.0.1:0",), True),
    ],
)
def test_links_are_direct_where_others_reach_them(
    connect: tuple[str, ...], listen: tuple[str, ...], *, direct: bool
) -> None:
    link = LinkConfig(connect=connect, listen=listen, certificates=Path("/etc/palpate/certs"))
    assert link.links_directly is direct
    assert link.model_copy(update={"direct": False}).links_directly is False
