"""Mutual TLS from outside: a router with certificates, the client, and every command that joins."""

from __future__ import annotations

import datetime
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("cryptography")

from tests.lab_router import make_certificates, router_of

from palpate import Client
from palpate.bus import Session
from palpate.config import LinkConfig, Role, endpoint_host_port, is_loopback
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate_deploy.cli.app import app
from palpate_deploy.station import certificates as issuing
from palpate_deploy.station.certificates import issue, make_authority

LIVE_S = 20.0


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a lab with a certificate for each role."""
    return make_certificates(tmp_path_factory.mktemp("tls") / "lab")


@pytest.fixture(scope="module")
def station(certificates: Path, new_port: Callable[[], int]) -> Iterator[str]:
    """A router with mutual TLS and one process behind it: its endpoint."""
    endpoint = f"tls/127.0.0.1:{new_port()}"
    link = LinkConfig(connect=(endpoint,), certificates=certificates, wait_for_router_s=LIVE_S)
    with (
        router_of(link, patience_s=LIVE_S),
        Session.open(link.as_role(Role.SERVICE)) as session,
        HealthReporter(session, Health("features", "features")),
        session.presence("features", instance="features") as presence,
    ):
        presence.ready()
        yield endpoint


def test_a_client_joins_with_its_certificates_only(
    station: str, certificates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = certificates / "robot"
    with Client(station, tls=own, timeout_s=LIVE_S) as robot:
        deadline = time.monotonic() + LIVE_S
        while not robot.status():
            assert time.monotonic() < deadline
        assert robot.status()[0].service == "features"
    with pytest.raises(ConfigError, match="needs certificates"):
        Client(station)
    monkeypatch.setenv("PALPATE_TLS", str(own))
    with Client(station, timeout_s=LIVE_S) as robot:
        assert robot.session.has_router()
    make_authority(tmp_path / "other")
    stranger = issue(tmp_path / "other", Role.ROBOT)
    with pytest.raises(LinkError, match="does not hold here"):
        Client(station, tls=stranger, timeout_s=1.0)
    shutil.copy(own / "ca.pem", stranger / "ca.pem")
    with pytest.raises(LinkError, match=r"refuses the certificate .*cert\.pem: \w+"):
        Client(station, tls=stranger, timeout_s=1.0)
    before = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=3)
    monkeypatch.setattr(issuing, "_now", lambda: before)
    ended = issue(certificates, Role.ROBOT, "ended", days=1)
    with pytest.raises(LinkError, match=r"refuses the certificate .*expired"):
        Client(station, tls=ended, timeout_s=1.0)
    plain = LinkConfig(connect=(station.replace("tls/", "tcp/"),), wait_for_router_s=1.0)
    with pytest.raises(LinkError, match=r"something listens .* -> connect to tls/"):
        Session.open(plain)
    (stranger / "cert.pem").unlink()
    with pytest.raises(ConfigError, match=r"cert\.pem does not exist"):
        Client(station, tls=stranger)
    with pytest.raises(ConfigError, match="is not encrypted"):
        Client("tcp/192.0.2.1:7447", tls=own)


def test_a_link_ends_with_its_certificate(
    station: str, certificates: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(seconds=8)
    monkeypatch.setattr(issuing, "_now", lambda: ends - datetime.timedelta(days=1))
    own = issue(certificates, Role.ROBOT, "visitor", days=1)
    with Client(station, tls=own, timeout_s=LIVE_S) as robot:
        assert robot.session.has_router()
        deadline = time.monotonic() + 8 + LIVE_S
        while robot.session.has_router():
            assert time.monotonic() < deadline, "the certificate has ended, the link has not"
            time.sleep(0.05)
        assert datetime.datetime.now(datetime.UTC) >= ends.replace(microsecond=0)


def test_commands_join_with_certificates(station: str, certificates: Path) -> None:
    own = str(certificates / "operator")
    joined = ["--connect", station, "--tls", own]
    result = CliRunner().invoke(app, ["topic", "echo", "status", "--count", "1", "--json", *joined])
    assert result.exit_code == 0, result.output
    assert '"features"' in result.stdout
    variables = {"PALPATE_CONNECT": station, "PALPATE_TLS": own}
    result = CliRunner().invoke(app, ["status", "--json"], env=variables)
    assert "features" in result.output, result.output
    result = CliRunner().invoke(app, ["fleet", *joined])
    assert "features" in result.output, result.output
    result = CliRunner().invoke(app, ["top", "--json", *joined, "--station", "lab"])
    assert json.loads(result.stdout)["processes"][0]["service"] == "features", result.output
    result = CliRunner().invoke(app, ["status", "--connect", station])
    assert result.exit_code == 2
    assert "--tls FOLDER" in result.output


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    if hasattr(command, "commands"):
        for sub, inner in command.commands.items():
            yield from _commands(inner, f"{name} {sub}")
    else:
        yield name, command


def test_every_command_that_joins_a_bus_takes_certificates() -> None:
    joining = 0
    for name, command in _commands(typer.main.get_command(app), "palpate"):
        options = {option: one for one in command.params for option in one.opts}
        if "--connect" in options:
            joining += 1
            assert "--tls" in options, f"{name} joins a bus and has no option --tls"
            assert options["--tls"].envvar == "PALPATE_TLS", name
    assert joining >= 8


def test_variables_of_who_joins_do_not_disturb_a_profile() -> None:
    variables = {"PALPATE_CONNECT": "tls/192.0.2.1:7447", "PALPATE_TLS": "/no/such/folder"}
    result = CliRunner().invoke(app, ["up", "--print-config"], env=variables)
    assert result.exit_code == 0, result.output
    assert "tcp/127.0.0.1:7447" in result.stdout


def test_whatever_listens_does_so_on_loopback_by_default() -> None:
    listening = 0
    for name, command in _commands(typer.main.get_command(app), "palpate"):
        for option in command.params:
            default = option.default or getattr(option, "show_default", None)
            if "--listen" not in option.opts or not isinstance(default, str):
                continue
            listening += 1
            address = default if "/" not in default else endpoint_host_port(default)[0]
            assert is_loopback(address), f"{name} --listen {default}"
    assert listening >= 5
