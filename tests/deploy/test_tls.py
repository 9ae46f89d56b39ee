"""Mutual TLS from outside: a router with certificates, the client, and every command that joins."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from palpate import Client
from palpate.bus import Session, run_router
from palpate.config import LinkConfig, TlsConfig
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate_deploy.cli.app import app

LIVE_S = 20.0

OPENSSL = shutil.which("openssl")


def _certificates(folder: Path, ca: Path | None = None) -> Path:
    """A folder as `--tls` wants it, of one host; with a new authority or one that is there."""
    folder.mkdir()

    def openssl(*words: str) -> None:
        assert OPENSSL
        subprocess.run([OPENSSL, *words], cwd=folder, check=True, capture_output=True, timeout=60)

    new_key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    if ca is None:
        openssl(
            *("req", "-x509", *new_key, "-keyout", "ca.key", "-out", "ca.pem"),
            *("-days", "2", "-subj", "/CN=palpate test authority"),
        )
        ca = folder
    else:
        shutil.copy(ca / "ca.pem", folder)
    names = "subjectAltName=IP:127.0.0.1,DNS:localhost"
    openssl(
        *("req", *new_key, "-keyout", "key.pem", "-out", "host.csr"),
        *("-subj", "/CN=localhost", "-addext", names),
    )
    openssl(
        *("x509", "-req", "-in", "host.csr", "-CA", str(ca / "ca.pem")),
        *("-CAkey", str(ca / "ca.key"), "-CAcreateserial", "-out", "cert.pem", "-days", "2"),
        *("-copy_extensions", "copy"),
    )
    return folder


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if OPENSSL is None:
        pytest.skip("openssl is not installed")
    return _certificates(tmp_path_factory.mktemp("tls") / "station")


@pytest.fixture(scope="module")
def station(certificates: Path, new_port: Callable[[], int]) -> Iterator[str]:
    """A router with mutual TLS and one process behind it: its endpoint."""
    endpoint = f"tls/127.0.0.1:{new_port()}"
    tls = TlsConfig.of_folder(certificates)
    stop = threading.Event()
    link = LinkConfig(connect=(endpoint,), listen=(), wait_for_router_s=LIVE_S, tls=tls)
    router = threading.Thread(
        target=run_router, args=((endpoint,), stop), kwargs={"link": link}, daemon=True
    )
    router.start()
    with (
        Session.open(link) as session,
        HealthReporter(session, Health("features", "features")),
        session.presence("features", instance="features") as presence,
    ):
        presence.ready()
        yield endpoint
    stop.set()
    router.join(LIVE_S)


def test_a_client_joins_with_its_certificates_only(
    station: str, certificates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(station, tls=certificates, timeout_s=LIVE_S) as robot:
        deadline = time.monotonic() + LIVE_S
        while not robot.status():
            assert time.monotonic() < deadline
        assert robot.status()[0].service == "features"
    with pytest.raises(ConfigError, match="needs certificates"):
        Client(station)
    monkeypatch.setenv("PALPATE_TLS", str(certificates))
    with Client(station, timeout_s=LIVE_S) as robot:
        assert robot.session.has_router()
    stranger = _certificates(tmp_path / "stranger")
    with pytest.raises(LinkError):
        Client(station, tls=stranger, timeout_s=1.0)
    (stranger / "cert.pem").unlink()
    with pytest.raises(ConfigError, match=r"cert\.pem does not exist"):
        Client(station, tls=stranger)
    with pytest.raises(ConfigError, match="is not encrypted"):
        Client("tcp/192.0.2.1:7447", tls=certificates)


def test_commands_join_with_certificates(station: str, certificates: Path) -> None:
    joined = ["--connect", station, "--tls", str(certificates)]
    result = CliRunner().invoke(app, ["topic", "echo", "status", "--count", "1", "--json", *joined])
    assert result.exit_code == 0, result.output
    assert '"features"' in result.stdout
    variables = {"PALPATE_CONNECT": station, "PALPATE_TLS": str(certificates)}
    result = CliRunner().invoke(app, ["status", "--json"], env=variables)
    assert "features" in result.output, result.output
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
