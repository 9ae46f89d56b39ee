"""A station is installed wholly or not at all, and goes without a trace."""

from __future__ import annotations

import hashlib
import json
import os
import socket
from pathlib import Path

import pytest
from tests.install.cases import PROFILES, VIRTUAL
from tests.install.conftest import PROGRAM, Install
from tests.install.image import contents, difference
from typer.testing import CliRunner, Result

from palpate.config import Role, TlsConfig
from palpate.errors import ConfigError, LinkError, MissingExtraError
from palpate_deploy.cli.app import app
from palpate_deploy.install import service
from palpate_deploy.install.ledger import InstallError
from palpate_deploy.install.plan import InstallOrder, present_version, program_of
from palpate_deploy.install.units import ServicePlan
from palpate_deploy.station.profile import load_profile

UNIT = "etc/systemd/system/palpate@lab.service"
PROFILE = "etc/palpate/lab.toml"
HOME = "/" + "root"


def _leave_data(root: Path) -> list[Path]:
    """A recording, a model and a kernel, in folders as systemd makes them for a dynamic user."""
    files = []
    for base, name in (
        ("var/lib", "runs/lab-1.mcap"),
        ("var/lib", "models/mine/1/model.onnx"),
        ("var/cache", "warp/1"),
    ):
        private = root / base / "private" / "palpate" / "lab"
        file = private / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("data")
        link = root / base / "palpate" / "lab"
        if not link.is_symlink():
            link.parent.mkdir(exist_ok=True)
            link.symlink_to("../private/palpate/lab")
        files.append(file)
    return files


def test_it_writes_what_it_says_and_purge_leaves_nothing(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    profile = tmp_path / "lab.toml"
    profile.write_text(PROFILES[case], encoding="utf-8")
    before = contents(root)
    service.install(InstallOrder(str(profile), "", root, PROGRAM))
    said = capsys.readouterr().out
    new = {line[2:] for line in difference(before, contents(root)) if (root / line[3:]).is_file()}
    ledger = json.loads((root / "etc/palpate/installed/lab.json").read_text("utf-8"))
    assert new - {"/etc/palpate/installed/lab.json"} == {
        line.split()[1] for line in said.splitlines() if line.startswith("wrote")
    }
    assert ledger["now"]["sha256"] == {
        path: hashlib.sha256((root / path[1:]).read_bytes()).hexdigest()
        for path in new - {"/etc/palpate/installed/lab.json"}
    }
    _leave_data(root)
    for folder in ("var/lib/private", "var/cache/private"):  # systemd's own
        before["/" + folder] = contents(root)["/" + folder]
    assert service.uninstall("lab", root, purge=True) == 0
    assert difference(before, contents(root)) == []


def test_the_commands_show_write_and_remove_a_station(
    root: Path, tmp_path: Path, install: Install
) -> None:
    profile = tmp_path / "lab.toml"
    profile.write_text(VIRTUAL, encoding="utf-8")

    def palpate(*words: str | Path) -> Result:
        text = [*map(str, words), "--root", str(root)]
        return CliRunner().invoke(app, text, catch_exceptions=False)

    before = contents(root)
    shown = palpate("install", profile, "--program", PROGRAM, "--dry-run")
    assert shown.exit_code == 0, shown.output
    assert UNIT in shown.stdout
    assert difference(before, contents(root)) == []
    files = tmp_path / "files"
    done = CliRunner().invoke(app, ["install", str(profile), "--containers", str(files)])
    assert done.exit_code == 0, done.output
    assert (files / "compose.yaml").exists()
    done = palpate("install", profile, "--program", PROGRAM)
    assert done.exit_code == 0, done.output
    assert f"wrote   /{UNIT}" in done.stdout
    assert palpate("uninstall", "lab").exit_code == 0
    assert not (root / UNIT).exists()
    assert (root / PROFILE).exists()
    assert palpate("uninstall", "lab", "--purge").exit_code == 0
    assert not (root / PROFILE).exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--containers", "OUT", "--dry-run"], ["--dry-run"]),
        (["--containers", "OUT", "--rollback"], ["--rollback"]),
        (["--containers", "OUT", "--root", "/mnt", "--replicas", "2"], ["--root", "--replicas"]),
        (["--containers", "OUT", "--program", PROGRAM], ["--program"]),
        (["--containers", "OUT", "--kubernetes", "OUT"], ["--containers"]),
        (["--kubernetes", "OUT", "--dry-run", "--rollback"], ["--dry-run"]),
        (["--kubernetes", "OUT", "--allow", "192.0.2.0/24"], ["--allow"]),
        (["--kubernetes", "OUT", "--program", PROGRAM, "--root", "/mnt"], ["--program", "--root"]),
        (["--replicas", "3"], ["--replicas"]),
        (["--rollback", "--allow", "192.0.2.0/24"], ["--allow"]),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(
    tmp_path: Path, profile: Path, options: list[str], named: list[str]
) -> None:
    out = tmp_path / "out"
    words = ["install", str(profile), *(str(out) if one == "OUT" else one for one in options)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2, done.output
    for option in named:
        assert option in done.output
    assert not out.exists()


def test_installed_profile_means_the_same_to_root_and_to_the_service(
    root: Path, install: Install
) -> None:
    install()
    installed = load_profile(root / PROFILE)
    assert str(installed.models.repository_folder) == "/var/lib/palpate/lab/models"
    assert str(installed.models.memory_folder) == "/var/lib/palpate/lab/state/palpate"


def test_dry_run_prints_every_file_and_writes_none(
    root: Path, profile: Path, install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(root)
    service.show_plan(InstallOrder(str(profile), "", root, PROGRAM))
    said = capsys.readouterr().out
    assert difference(before, contents(root)) == []
    install()
    for path in (UNIT, PROFILE):
        assert f"# ---- /{path}\n{(root / path).read_text('utf-8')}" in said


def test_dry_run_shows_what_the_install_would_write_and_what_would_stop_it(
    root: Path, profile: Path, install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install(allowed=("192.0.2.0/24",))
    order = InstallOrder(str(profile), "", root, PROGRAM)
    capsys.readouterr()
    service.show_plan(order)
    assert f"# ---- /{UNIT}\n{(root / UNIT).read_text('utf-8')}" in capsys.readouterr().out
    (root / UNIT).write_text("mine")
    before = contents(root)
    with pytest.raises(InstallError, match="changed since"):
        service.show_plan(order)
    assert difference(before, contents(root)) == []


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("prefix", f"palpate lies in {HOME}/venv/bin, "),
        ("executable", f"palpate's Python lies in {HOME}/python/bin, "),
    ],
)
def test_dry_run_shows_the_files_though_no_service_would_see_palpate(
    root: Path,
    profile: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    place: str,
    told: str,
) -> None:
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    monkeypatch.setattr("sys.prefix", f"{HOME}/venv" if place == "prefix" else "/opt/palpate")
    monkeypatch.setattr("sys.executable", f"{HOME}/python/bin/python3")
    order = InstallOrder(str(profile), "", root, "")
    with pytest.raises(ConfigError, match=told):
        service.show_plan(order)
    said = capsys.readouterr().out
    assert f"# ---- /{UNIT}\n" in said
    assert f"{program_of(order)} up" in said
    before = contents(root)
    with pytest.raises(ConfigError, match=told):
        service.install(order)
    assert difference(before, contents(root)) == []


def test_uninstall_keeps_profile_recordings_and_models(root: Path, install: Install) -> None:
    install()
    *data, kernel = _leave_data(root)
    assert service.uninstall("lab", root, purge=False) == 0
    assert not (root / UNIT).exists()
    assert not kernel.exists()
    assert (root / PROFILE).exists()
    assert all(file.read_text() == "data" for file in data)
    install()  # and again: the same profile is no obstacle
    assert (root / UNIT).exists()
    service.uninstall("lab", root, purge=False)
    assert service.uninstall("lab", root, purge=True) == 0
    assert not any(file.exists() for file in data)
    assert not (root / "etc/palpate").exists()


def test_data_alone_can_be_purged_and_nothing_else(root: Path) -> None:
    foreign = root / PROFILE
    foreign.parent.mkdir()
    foreign.write_text("mine")
    data = _leave_data(root)
    with pytest.raises(InstallError, match="not installed") as caught:
        service.uninstall("lab", root, purge=False)
    assert "--purge removes /var/lib/palpate/lab" in caught.value.remedy
    assert service.uninstall("lab", root, purge=True) == 0
    assert not any(file.exists() for file in data)
    assert foreign.read_text() == "mine"


def test_the_last_station_takes_the_common_folders_away(
    tmp_path: Path, profile: Path, install: Install
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    serial = tmp_path / "serial.toml"
    serial.write_text(PROFILES["serial"])
    for source, name in ((serial, "one"), (profile, "two"), (serial, "three")):
        service.install(InstallOrder(str(source), name, bare, PROGRAM))
    for name in ("one", "three", "two"):
        assert (bare / "etc/palpate/installed").is_dir()
        assert service.uninstall(name, bare, purge=True) == 0
    assert list(bare.iterdir()) == []


def test_upgrade_keeps_data_and_rollback_restores_every_byte(
    root: Path, profile: Path, install: Install
) -> None:
    install()
    data = _leave_data(root)
    first = contents(root)
    profile.write_text(VIRTUAL.replace('"recorder"', '"recorder", "fem"'))
    install(program="/opt/palpate-2/bin/palpate")
    second = contents(root)
    assert "palpate-2" in (root / UNIT).read_text("utf-8")
    assert (root / "etc/systemd/system/palpate-fem@lab.service").exists()
    for expected in (first, second, first):
        service.roll_back("lab", root)
        changed = difference(expected, contents(root))
        assert changed in ([], ["~ /etc/palpate/installed/lab.json"])
    assert all(file.read_text() == "data" for file in data)


def test_profile_that_stays_is_known_again_whichever_install_wrote_it(
    root: Path, profile: Path, install: Install
) -> None:
    for seed in range(8):
        profile.write_text(VIRTUAL.replace("seed = 7", f"seed = {seed}"))
        install()
        installed = contents(root)
        service.uninstall("lab", root, purge=False)
        profile.write_text(VIRTUAL.replace("seed = 7", "seed = 99"))
        install()
        profile.write_text(VIRTUAL.replace("seed = 7", f"seed = {seed}"))
        install()
        assert difference(installed, contents(root)) in ([], ["~ /etc/palpate/installed/lab.json"])


def test_same_again_changes_nothing_and_can_still_be_rolled_back(
    root: Path, install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install()
    install(program="/opt/palpate-2/bin/palpate")
    before = contents(root)
    install(program="/opt/palpate-2/bin/palpate")
    assert "nothing has changed" in capsys.readouterr().out
    assert difference(before, contents(root)) == []
    service.roll_back("lab", root)
    assert "palpate-2" not in (root / UNIT).read_text("utf-8")


def test_nothing_to_go_back_to_is_said(root: Path, install: Install) -> None:
    with pytest.raises(InstallError, match="nothing before"):
        service.roll_back("lab", root)
    install()
    with pytest.raises(InstallError, match="nothing before"):
        service.roll_back("lab", root)


def test_upgrade_keeps_the_networks_that_were_allowed(root: Path, install: Install) -> None:
    install(allowed=("192.168.7.0/24",))
    install(program="/opt/palpate-2/bin/palpate")
    assert "IPAddressAllow=localhost 192.168.7.0/24" in (root / UNIT).read_text("utf-8")


def test_profile_that_was_edited_in_place_is_taken_from_there_only(
    root: Path, profile: Path, install: Install
) -> None:
    install()
    edited = (root / PROFILE).read_text("utf-8") + "[log]\nlevel = 'debug'\n"
    (root / PROFILE).write_text(edited)
    with pytest.raises(InstallError, match="changed since") as caught:
        install()
    assert "palpate install /etc/palpate/lab.toml" in caught.value.remedy
    assert (root / PROFILE).read_text("utf-8") == edited
    install(root / PROFILE, program="/opt/palpate-2/bin/palpate")
    assert (root / PROFILE).read_text("utf-8") == edited
    service.uninstall("lab", root, purge=False)
    assert (root / PROFILE).read_text("utf-8") == edited


@pytest.mark.parametrize("path", [UNIT, PROFILE])
def test_file_of_somebody_else_is_not_overwritten(root: Path, install: Install, path: str) -> None:
    (root / path).parent.mkdir(exist_ok=True)
    (root / path).write_text("mine")
    before = contents(root)
    with pytest.raises(InstallError, match="no install wrote it"):
        install()
    assert difference(before, contents(root)) == []


def test_changed_unit_is_neither_overwritten_nor_removed_unless_asked(
    root: Path, install: Install
) -> None:
    install()
    (root / UNIT).write_text("[Service]\nExecStart=/bin/mine\n")
    with pytest.raises(InstallError, match="changed since"):
        install(program="/opt/palpate-2/bin/palpate")
    assert service.uninstall("lab", root, purge=False) == 0
    assert "mine" in (root / UNIT).read_text()
    assert service.uninstall("lab", root, purge=True) == 0
    assert not (root / UNIT).exists()
    assert not (root / "etc/palpate").exists()


def test_changed_unit_that_is_needed_no_more_stops_an_upgrade(
    root: Path, profile: Path, install: Install
) -> None:
    profile.write_text(VIRTUAL.replace('"recorder"', '"recorder", "fem"'))
    install()
    solver = root / "etc/systemd/system/palpate-fem@lab.service"
    solver.write_text("[Service]\nExecStart=/bin/mine\n")
    profile.write_text(VIRTUAL)
    before = contents(root)
    with pytest.raises(InstallError, match=r"palpate-fem@lab\.service is changed"):
        install()
    assert difference(before, contents(root)) == []
    solver.unlink()
    install()


def test_changes_by_systemctl_edit_stay_until_purge(root: Path, install: Install) -> None:
    install()
    override = root / f"{UNIT}.d" / "override.conf"
    override.parent.mkdir()
    override.write_text("[Service]\nMemoryMax=4G\n")
    install(program="/opt/palpate-2/bin/palpate")
    service.uninstall("lab", root, purge=False)
    assert override.exists()
    service.uninstall("lab", root, purge=True)
    assert not override.parent.exists()


@pytest.mark.parametrize("path", [UNIT, PROFILE])
def test_planted_link_is_never_followed(root: Path, install: Install, path: str) -> None:
    install()
    victim = root / "etc/passwd"
    victim.write_text("root:x:0:0\n")
    (root / path).unlink()
    (root / path).symlink_to("/etc/passwd" if path == UNIT else victim)
    with pytest.raises(InstallError, match="but a link"):
        install(program="/opt/palpate-2/bin/palpate")
    service.uninstall("lab", root, purge=False)
    assert (root / path).is_symlink()
    assert service.uninstall("lab", root, purge=True) == 0
    assert not (root / path).is_symlink()
    assert victim.read_text() == "root:x:0:0\n"


def test_link_in_the_place_of_recordings_is_never_followed(
    root: Path, install: Install, tmp_path: Path
) -> None:
    install()
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("precious")
    (root / "var/lib/palpate").mkdir()
    (root / "var/lib/palpate/lab").symlink_to(precious)
    (root / "var/cache/palpate").symlink_to(precious)
    with pytest.raises(InstallError, match="leads out of"):
        service.uninstall("lab", root, purge=True)
    (root / "var/cache/palpate").unlink()
    assert service.uninstall("lab", root, purge=True) == 0
    assert (precious / "file").read_text() == "precious"


def test_folder_in_the_place_of_a_file_is_left_and_said(root: Path, install: Install) -> None:
    install()
    (root / UNIT).unlink()
    (root / UNIT).mkdir()
    (root / UNIT / "mine").touch()
    assert service.uninstall("lab", root, purge=True) == 1
    assert (root / UNIT / "mine").exists()


def test_folder_that_leads_out_of_the_root_is_refused(
    root: Path, tmp_path: Path, install: Install
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (root / "etc/systemd/system").rename(root / "etc/systemd/system.old")
    (root / "etc/systemd/system").symlink_to(outside)
    with pytest.raises(InstallError, match="leads out of"):
        install()
    assert list(outside.iterdir()) == []
    assert not (root / "etc/palpate").exists()


@pytest.mark.parametrize("name", ["../../x", "a/b", "..", "-x", "x" * 41, "x\n", "x y", "%i"])
def test_name_that_leads_elsewhere_is_refused(root: Path, install: Install, name: str) -> None:
    before = contents(root)
    with pytest.raises(ConfigError):
        install(name=name)
    with pytest.raises(ConfigError):
        service.uninstall(name, root, purge=True)
    with pytest.raises(ConfigError):
        service.roll_back(name, root)
    assert difference(before, contents(root)) == []


def test_ledger_that_names_other_files_is_not_believed(root: Path, install: Install) -> None:
    install()
    ledger = root / "etc/palpate/installed/lab.json"
    victim = root / "etc/passwd"
    victim.write_text("x")
    values = json.loads(ledger.read_text())
    values["now"]["texts"]["/etc/passwd"] = "x"
    ledger.write_text(json.dumps(values))
    with pytest.raises(InstallError, match="/etc/passwd, which no install writes"):
        service.uninstall("lab", root, purge=True)
    assert victim.exists()
    ledger.write_text("{")
    with pytest.raises(InstallError, match="damaged"):
        install()


def test_only_root_installs_on_this_host_and_anyone_may_look(
    profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    order = InstallOrder(str(profile), "", Path("/"), PROGRAM)
    for act in (
        lambda: service.install(order),
        lambda: service.roll_back("lab", Path("/")),
        lambda: service.uninstall("lab", Path("/"), purge=True),
    ):
        with pytest.raises(InstallError, match="only root") as caught:
            act()
        assert "sudo" in caught.value.remedy
    service.show_plan(order)
    assert "ExecStart=" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("profile_text", "problem"),
    [
        ('station = "A B"', "station"),
        ("prozesses = []", "prozesses"),
        ('[recorder]\nout = "/data/runs"', "writes into /var/lib/palpate/lab only"),
        ('[recorder]\nout = "../other"', "writes into /var/lib/palpate/lab only"),
        ('[models]\nfolder = "/srv/models"', "[models] names no state"),
        (
            '[models]\nfolder = "~/models"\nstate = "/var/lib/palpate/lab/state"',
            "does not see /home",
        ),
        ('[models]\nfolder = "/srv/models"\nstate = "/srv/state"', "writes into"),
        ('[link]\nconnect = ["tcp/robot.lab:7447"]', "'robot.lab' is a name"),
        (f'[features]\nbundle = "{HOME}/bundle/1"', "does not see"),
        (
            '[[gateway.sensors]]\ndriver = "wrench_kms40"\noptions = { host = "ft" }',
            "'ft' is a name",
        ),
        (
            '[[gateway.sensors]]\ndriver = "text_log"\noptions = { path = "/tmp/x.btd" }',
            "does not see",
        ),
        ('[[gateway.sensors]]\ndriver = "unheard"', "unknown driver"),
    ],
)
def test_profile_that_cannot_be_a_service_is_refused(
    root: Path, tmp_path: Path, install: Install, profile_text: str, problem: str
) -> None:
    before = contents(root)
    (tmp_path / "lab.toml").write_text(profile_text)
    with pytest.raises(ConfigError) as caught:
        install(tmp_path / "lab.toml")
    assert problem in caught.value.problem
    assert difference(before, contents(root)) == []


def test_router_for_other_hosts_needs_to_know_which(
    root: Path, tmp_path: Path, install: Install
) -> None:
    (tmp_path / "lab.toml").write_text(
        '[router]\nlisten = ["tls/0.0.0.0:7447"]\n[link.tls]\ncertificate = "/pki/cert.pem"\n'
        'root_ca_certificate = "/pki/ca.pem"\nprivate_key = "/pki/key.pem"\n'
    )
    with pytest.raises(ConfigError, match="talks to none that is not named"):
        install(tmp_path / "lab.toml")
    install(tmp_path / "lab.toml", allowed=("10.0.0.0/8",))
    unit = (root / UNIT).read_text("utf-8")
    assert "LoadCredential=key.pem:/pki/key.pem" in unit
    assert "PALPATE_LINK__TLS__PRIVATE_KEY=%d/key.pem" in unit
    assert "IPAddressAllow=localhost 10.0.0.0/8" in unit
    with pytest.raises(ConfigError, match="no network"):
        install(tmp_path / "lab.toml", allowed=("everyone",))


def test_page_for_other_hosts_needs_to_know_which(
    root: Path, tmp_path: Path, install: Install
) -> None:
    (tmp_path / "lab.toml").write_text('[web]\nlisten = "0.0.0.0:7480"\n')
    install(tmp_path / "lab.toml")  # it has no page
    (tmp_path / "lab.toml").write_text(
        'processes = ["router", "gateway", "web"]\n[web]\nlisten = "0.0.0.0:7480"\n'
    )
    with pytest.raises(ConfigError, match=r"tcp/0\.0\.0\.0:7480 is there for other hosts"):
        install(tmp_path / "lab.toml")


def test_router_of_a_station_reaches_its_site(root: Path, tmp_path: Path, install: Install) -> None:
    text = (
        '[router]\nlisten = ["tls/127.0.0.1:7447"]\nconnect = ["tls/192.168.1.2:7447"]\n'
        '[link]\ncertificates = "/pki"\n'
    )
    (tmp_path / "lab.toml").write_text(text)
    install(tmp_path / "lab.toml")
    assert "IPAddressAllow=localhost 192.168.1.2" in (root / UNIT).read_text("utf-8")
    (tmp_path / "lab.toml").write_text(text.replace("192.168.1.2", "site.lab"))
    with pytest.raises(ConfigError, match=r"'site\.lab' is a name"):
        install(tmp_path / "lab.toml", name="other")
    install(tmp_path / "lab.toml", allowed=("10.0.0.0/8",))
    assert "IPAddressAllow=localhost 10.0.0.0/8" in (root / UNIT).read_text("utf-8")


def test_certificates_by_role_are_handed_over_by_systemd(
    root: Path, tmp_path: Path, install: Install
) -> None:
    (tmp_path / "lab.toml").write_text(
        '[router]\nlisten = ["tls/127.0.0.1:7447"]\n[link]\ncertificates = "/pki"\n'
    )
    install(tmp_path / "lab.toml")
    unit = (root / UNIT).read_text("utf-8")
    handed = dict(
        line.removeprefix("LoadCredential=").split(":")
        for line in unit.splitlines()
        if line.startswith("LoadCredential=")
    )
    assert {name.partition("_")[0] for name in handed} == {"router", "gateway", "service"}
    assert "Environment=PALPATE_LINK__CERTIFICATES=%d" in unit
    credentials = tmp_path / "credentials"  # as systemd lays them out
    credentials.mkdir()
    for name in handed:
        (credentials / name).write_text("")
    for role in (Role.ROUTER, Role.GATEWAY, Role.SERVICE):
        tls = TlsConfig.of_role(credentials, role)
        assert handed[tls.private_key.name] == f"/pki/{role}/key.pem"
    with pytest.raises(ConfigError, match="operator"):
        TlsConfig.of_role(credentials, Role.OPERATOR)


def test_certificate_that_is_not_there_is_named(
    root: Path, tmp_path: Path, install: Install, this_host: Path
) -> None:
    (tmp_path / "lab.toml").write_text(
        '[router]\nlisten = ["tls/127.0.0.1:7447"]\n'
        f'[link.tls]\nroot_ca_certificate = "{tmp_path}/ca.pem"\n'
        f'certificate = "{tmp_path}/lab.toml"\nprivate_key = "{tmp_path}/lab.toml"\n'
    )
    with pytest.raises(ConfigError, match=r"ca\.pem does not exist"):
        install(tmp_path / "lab.toml")


def test_variable_of_the_shell_is_refused(
    root: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_STATION", "elsewhere")  # of a client: harmless
    install()
    monkeypatch.setenv("PALPATE_FEATURES__BUNDLE", "mine")
    with pytest.raises(ConfigError, match="no service will have it"):
        install()


def test_missing_extra_is_named(
    root: Path, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match="services"):
        install()
    assert not (root / "etc/palpate").exists()


@pytest.mark.parametrize("program", ["palpate", "/opt/my palpate", "/opt/%i/palpate", "/opt/a;b"])
def test_program_that_a_unit_cannot_name_is_refused(install: Install, program: str) -> None:
    with pytest.raises(ConfigError, match="not the plain path"):
        install(program=program)


def test_port_in_use_is_said_on_a_first_install_only(
    root: Path, tmp_path: Path, install: Install, this_host: Path
) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        profile = tmp_path / "lab.toml"
        profile.write_text(f'{VIRTUAL}[router]\nlisten = ["tcp/127.0.0.1:{port}"]\n')
        with pytest.raises(LinkError, match="in use"):
            install(profile)
        assert not (root / "etc/palpate").exists()
    install(profile)
    with socket.socket() as own:  # the station that is to be brought up to date
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind(("127.0.0.1", port))
        own.listen()
        install(profile, program="/opt/palpate-2/bin/palpate")


def test_systemd_is_told(
    root: Path, tmp_path: Path, install: Install, this_host: Path, profile: Path
) -> None:
    profile.write_text(PROFILES["elements"].replace("biotac_can", "virtual"))
    install(name="lab")
    assert this_host.read_text().splitlines() == [
        "systemctl daemon-reload",
        "udevadm control --reload",
        "systemctl enable --quiet palpate@lab.service",
    ]
    this_host.write_text("")
    service.uninstall("lab", root, purge=True)
    told = this_host.read_text().splitlines()
    assert told[0] == (
        "systemctl disable --now --quiet palpate@lab.service palpate-fem@lab.service"
    )
    assert "systemctl daemon-reload" in told


def test_all_is_as_it_was_when_systemd_refuses(
    root: Path, install: Install, this_host: Path
) -> None:
    before = contents(root)
    failing = Path(f"{this_host}.fail")
    failing.touch()
    with pytest.raises(InstallError, match="systemctl daemon-reload"):
        install()
    assert difference(before, contents(root)) == []
    failing.unlink()
    install()
    installed = contents(root)
    failing.touch()
    with pytest.raises(InstallError):
        install(program="/opt/palpate-2/bin/palpate")
    with pytest.raises(InstallError):
        service.uninstall("lab", root, purge=True)
    assert difference(installed, contents(root)) == []


def test_a_unit_that_is_needed_no_more_is_stopped_when_all_else_is_done(
    root: Path, tmp_path: Path, install: Install, this_host: Path
) -> None:
    profile = tmp_path / "lab.toml"
    profile.write_text(PROFILES["elements"].replace("biotac_can", "virtual"), encoding="utf-8")
    install()
    before = contents(root)
    profile.write_text(VIRTUAL, encoding="utf-8")
    this_host.write_text("")
    failing = Path(f"{this_host}.fail")
    failing.write_text("enable\n")
    with pytest.raises(InstallError, match="systemctl enable"):
        install()
    assert difference(before, contents(root)) == []
    told = this_host.read_text()
    assert "disable" not in told, "it still runs"
    assert "daemon-reload" in told.partition("systemctl enable")[2], "systemd knows the old units"
    failing.unlink()
    this_host.write_text("")
    install()
    told = this_host.read_text()
    stopped = "systemctl disable --now --quiet palpate-fem@lab.service"
    assert stopped in told.partition("systemctl enable")[2]
    assert "daemon-reload" in told.partition(stopped)[2], "systemd forgets it"
    assert not (root / "etc/systemd/system/palpate-fem@lab.service").exists()


def test_rollback_to_a_program_that_is_another_one_by_now_is_refused(
    root: Path, tmp_path: Path, install: Install, this_host: Path
) -> None:
    program = tmp_path / "palpate"
    install(program=str(program))
    install(program="/opt/palpate-2/bin/palpate")
    installed = contents(root)
    with pytest.raises(InstallError, match="No such file"):
        service.roll_back("lab", root)
    program.write_text("#!/bin/sh\necho palpate 99.0\n")
    program.chmod(0o755)
    with pytest.raises(InstallError, match=r"is now: palpate 99\.0") as caught:
        service.roll_back("lab", root)
    assert f"install palpate {present_version()} there again" in caught.value.remedy
    assert difference(installed, contents(root)) == []
    program.write_text(f"#!/bin/sh\necho palpate {present_version()}\n")
    service.roll_back("lab", root)
    assert str(program) in (root / UNIT).read_text("utf-8")


def test_rollback_enables_a_unit_that_comes_back(
    root: Path, tmp_path: Path, profile: Path, install: Install, this_host: Path
) -> None:
    program = tmp_path / "palpate"
    program.write_text(f"#!/bin/sh\necho palpate {present_version()}\n")
    program.chmod(0o755)
    profile.write_text(VIRTUAL.replace('"recorder"', '"recorder", "fem"'))
    install(program=str(program))
    profile.write_text('station = "lab"\nprocesses = ["fem"]\n')
    install(program=str(program))
    enable = "systemctl enable --quiet palpate@lab.service"
    this_host.write_text("")
    service.roll_back("lab", root)
    assert enable in this_host.read_text()
    this_host.write_text("")
    service.roll_back("lab", root)
    assert enable not in this_host.read_text()


def test_wish_to_start_with_the_host_goes_too(root: Path, install: Install) -> None:
    install()
    link = root / "etc/systemd/system/multi-user.target.wants/palpate@lab.service"
    link.symlink_to("/etc/systemd/system/palpate@lab.service")
    service.uninstall("lab", root, purge=False)
    assert not link.is_symlink()


def test_plan_names_the_unit_to_start(profile: Path) -> None:
    plan = ServicePlan("lab", load_profile(profile), None, PROGRAM)  # type: ignore[arg-type]
    assert plan.main_unit == "palpate@lab.service"
