"""`palpate certs` and what `palpate doctor` says of certificates, from outside."""

from __future__ import annotations

import datetime
import json
import re
import shutil
import ssl
import stat
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest
from typer.testing import CliRunner

pytest.importorskip("cryptography")

from tests.lab_router import router_of

from palpate.bus import Session
from palpate.config import LinkConfig, Role, TlsConfig
from palpate.errors import ConfigError
from palpate_deploy.cli.app import app
from palpate_deploy.station import certificates
from palpate_deploy.station.certificates import issue, make_authority, read_certificate
from palpate_deploy.station.processes import check_certificates
from palpate_deploy.station.profile import load_profile


def _run(*words: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


def _doctor(profile: Path) -> dict[str, str]:
    result = CliRunner().invoke(app, ["doctor", "--profile", str(profile), "--json"])
    found = [one for one in json.loads(result.stdout) if one["what"] == "certificates"]
    assert len(found) == 1
    return dict(found[0])


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A lab's folder, as the commands make it."""
    folder = tmp_path / "lab"
    _run("certs", "ca", folder)
    for role in ("router", "gateway", "service"):
        _run("certs", "issue", folder, "--role", role, "--host", "192.168.1.10")
    return folder


@pytest.fixture
def profile(lab: Path, tmp_path: Path) -> Path:
    path = tmp_path / "station.toml"
    path.write_text(
        f'[router]\nlisten = ["tls/127.0.0.1:17999"]\n[link]\ncertificates = "{lab}"\n'
        f'[recorder]\nout = "{tmp_path / "runs"}"\n'
    )
    return path


def test_keys_are_read_by_their_owner_only(lab: Path) -> None:
    assert stat.S_IMODE(lab.stat().st_mode) == 0o700
    for path in (lab / "ca.key", lab / "router" / "key.pem"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not list(lab.glob(".*"))


def test_another_implementation_reads_them(lab: Path) -> None:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(lab / "ca.pem"))
    context.load_cert_chain(lab / "router" / "cert.pem", lab / "router" / "key.pem")
    with pytest.raises(ssl.SSLError):
        context.load_cert_chain(lab / "router" / "cert.pem", lab / "gateway" / "key.pem")


def test_nothing_is_overwritten(lab: Path) -> None:
    before = {path: path.read_bytes() for path in sorted(lab.rglob("*.*")) if path.is_file()}
    assert "holds something already" in _run("certs", "ca", lab, code=2)
    assert "holds something already" in _run("certs", "issue", lab, "--role", "router", code=2)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--name", "../evil"), "cannot stand in"),
        (("--name", "router"), "that of another role"),
        (("--host", "a b"), "neither an address nor"),
        (("--host", "*.example.org"), "neither an address nor"),
    ],
)
def test_what_cannot_be_issued_is_refused(lab: Path, words: tuple[str, ...], says: str) -> None:
    assert says in _run("certs", "issue", lab, "--role", "robot", *words, code=2)
    assert not (lab.parent / "evil").exists()


def test_another_role_is_refused_by_name(lab: Path) -> None:
    assert "one of: router, gateway" in _run("certs", "issue", lab, "--role", "boss", code=2)


def test_without_an_authority_nothing_is_issued(tmp_path: Path) -> None:
    assert "holds no authority" in _run("certs", "issue", tmp_path, "--role", "robot", code=2)
    assert "holds no certificates" in _run("certs", "show", tmp_path, code=2)


def test_show_tells_role_name_hosts_and_end(lab: Path) -> None:
    _run("certs", "issue", lab, "--role", "robot", "--name", "arm1", "--days", "7")
    rows = {one["name"]: one for one in json.loads(_run("certs", "show", lab, "--json"))}
    assert set(rows) == {"router", "gateway", "service", "arm1"}
    arm = rows["arm1"]
    assert (arm["role"], arm["problem"]) == ("robot", "")
    assert set(arm["hosts"]) == {"localhost", "127.0.0.1", "::1"}
    assert "192.168.1.10" in rows["router"]["hosts"]
    end = datetime.datetime.fromisoformat(arm["until"]) - datetime.datetime.now(datetime.UTC)
    assert 6.9 < end / datetime.timedelta(days=1) <= 7.0


def test_a_damaged_certificate_hides_no_other(lab: Path) -> None:
    (lab / "gateway" / "key.pem").unlink()
    (lab / "service" / "cert.pem").unlink()
    rows = {one["name"]: one for one in json.loads(_run("certs", "show", lab, "--json", code=1))}
    assert rows["router"]["problem"] == ""
    assert "key.pem does not exist" in rows["gateway"]["problem"]
    assert "cert.pem does not exist" in rows["service"]["problem"]
    assert rows["gateway"]["role"] is rows["gateway"]["until"] is None
    shown = _run("certs", "show", lab, code=1)
    assert all(name in shown for name in rows)
    own = json.loads(_run("certs", "show", lab / "service", "--json", code=1))
    assert own == [rows["service"]]


def test_a_key_of_another_authority_issues_nothing(lab: Path, tmp_path: Path) -> None:
    make_authority(tmp_path / "other")
    shutil.copy(tmp_path / "other" / "ca.key", lab / "ca.key")
    said = " ".join(_run("certs", "issue", lab, "--role", "operator", code=2).split())
    assert "ca.key is not the key of" in said
    assert not (lab / "operator").exists()
    (lab / "ca.key").write_text("no key")
    said = " ".join(_run("certs", "issue", lab, "--role", "operator", code=2).split())
    assert "no private key" in said
    assert "palpate certs ca NEW-FOLDER" in said


def test_one_that_does_not_hold_when_it_is_issued_is_told(lab: Path) -> None:
    before = datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=3)
    with mock.patch.object(certificates, "_now", return_value=before):
        assert "check the clock" in _run("certs", "issue", lab, "--role", "robot", code=1)


def test_a_certificate_ends_with_its_authority(tmp_path: Path) -> None:
    make_authority(tmp_path / "lab", days=3)
    made = issue(tmp_path / "lab", Role.ROBOT, days=365)
    assert read_certificate(TlsConfig.of_folder(made)).days_left <= 3.0
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=4)
    with mock.patch.object(certificates, "_now", return_value=later):
        with pytest.raises(ConfigError, match=r"authority in .* has ended"):
            issue(tmp_path / "lab", Role.OPERATOR)
        assert "has ended" in read_certificate(TlsConfig.of_folder(made)).problem


def test_doctor_warns_before_the_end(profile: Path, lab: Path) -> None:
    found = _doctor(profile)
    assert found["grade"] == "ok"
    assert "router, gateway, service" in found["found"]
    shutil.rmtree(lab / "gateway")
    _run("certs", "issue", lab, "--role", "gateway", "--days", "29")
    found = _doctor(profile)
    assert found["grade"] == "warn"
    assert "palpate certs issue" in found["fix"]
    shutil.rmtree(lab)
    make_authority(lab, days=10)
    for role in ("router", "gateway", "service"):
        _run("certs", "issue", lab, "--role", role)
    found = _doctor(profile)
    assert found["grade"] == "warn"
    assert "palpate certs ca" in found["fix"]


def test_doctor_names_what_is_wrong(profile: Path, lab: Path, tmp_path: Path) -> None:
    def wrong() -> str:
        found = _doctor(profile)
        assert found["grade"] == "fail", found
        assert found["fix"]
        return found["found"]

    shutil.rmtree(lab / "gateway")
    assert "gateway/ca.pem does not exist" in wrong()
    shutil.copytree(lab / "service", lab / "gateway")
    assert "that of a service, a gateway needs its own" in wrong()
    shutil.rmtree(lab / "gateway")
    make_authority(tmp_path / "other")
    shutil.copytree(issue(tmp_path / "other", Role.GATEWAY), lab / "gateway")
    assert "different authorities" in wrong()
    shutil.copy(lab / "ca.pem", lab / "gateway" / "ca.pem")
    assert "ca.pem is not the authority" in wrong()
    shutil.rmtree(lab / "gateway")
    _run("certs", "issue", lab, "--role", "gateway")
    (lab / "gateway" / "key.pem").chmod(0o644)
    assert "others than its owner may read" in wrong()
    (lab / "gateway" / "key.pem").write_text("no key")
    assert "no private key" in wrong()


def test_no_station_starts_with_certificates_that_nobody_accepts(
    profile: Path, lab: Path, tmp_path: Path
) -> None:
    make_authority(tmp_path / "other")
    shutil.copy(tmp_path / "other" / "ca.pem", lab / "gateway" / "ca.pem")
    said = _run("up", "--profile", profile, code=2)
    assert _doctor(profile)["found"] in " ".join(said.split())
    shutil.copy(lab / "ca.pem", lab / "gateway" / "ca.pem")
    (lab / "gateway" / "key.pem").write_text("")
    assert "no private key" in _run("up", "--profile", profile, code=2)
    (lab / "service" / "key.pem").chmod(0o440)
    shutil.rmtree(lab / "gateway")
    _run("certs", "issue", lab, "--role", "gateway")
    assert len(check_certificates(load_profile(profile), private=False)) == 3
    with pytest.raises(ConfigError, match="others than its owner"):
        check_certificates(load_profile(profile), private=True)


def test_a_station_of_this_host_alone_needs_none() -> None:
    result = CliRunner().invoke(app, ["doctor", "--json"])
    found = {one["what"]: one for one in json.loads(result.stdout)}["certificates"]
    assert found["grade"] == "ok"


def test_a_profile_with_certificates_listens_with_them_only(lab: Path, tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    for listen, says in (
        ("tcp/127.0.0.1:17999", "asks for no certificate"),
        ("tcp/0.0.0.0:17999", "without mutual TLS"),
    ):
        path.write_text(f'[router]\nlisten = ["{listen}"]\n[link]\ncertificates = "{lab}"\n')
        assert says in " ".join(_run("up", "--print-config", "--profile", path, code=2).split())
    path.write_text('[router]\nlisten = ["tls/0.0.0.0:17999"]\n')
    assert "without mutual TLS" in " ".join(
        _run("up", "--print-config", "--profile", path, code=2).split()
    )


@pytest.mark.slow
def test_a_link_ends_with_the_certificate_that_opened_it(
    lab: Path, new_port: Callable[[], int]
) -> None:
    then = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=1, seconds=-10)
    with mock.patch.object(certificates, "_now", return_value=then):
        issue(lab, Role.ROBOT, days=1)
    endpoint = f"tls/127.0.0.1:{new_port()}"
    link = LinkConfig(connect=(endpoint,), certificates=lab, wait_for_router_s=60, direct=False)
    with (
        router_of(link, patience_s=60),
        Session.open(link.as_role(Role.SERVICE)) as service,
        Session.open(link.as_role(Role.ROBOT)) as robot,
    ):
        deadline = time.monotonic() + 60
        while robot.has_router():
            assert time.monotonic() < deadline, "the link outlives its certificate"
            time.sleep(0.1)
        assert service.has_router(), "another link has ended, too"


def test_the_profiles_on_the_page_are_right(lab: Path, tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    assert len(blocks) == 2
    path = tmp_path / "lab.toml"
    path.write_text("".join(blocks))
    profile = load_profile(path)
    assert profile.link.connect == ("tls/127.0.0.1:7447",)
    assert profile.link.listen == ("tls/127.0.0.1:0",)
    assert profile.models.trusted_keys
