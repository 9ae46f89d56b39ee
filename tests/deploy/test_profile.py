"""Profiles: what is wrong is named with file, key and remedy."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest
import tomli_w

from palpate.errors import ConfigError
from palpate_deploy.station.profile import (
    changed,
    load_profile,
    parse_profile,
    plain_values,
    profile_names,
)


def _write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", profile_names())
def test_shipped_profile_is_valid(name: str) -> None:
    assert load_profile(name).processes


def test_the_four_profiles_ship() -> None:
    assert {"demo", "virtual", "replay", "bench"} <= set(profile_names())


@pytest.mark.parametrize(
    ("text", "key", "remedy"),
    [
        ('statoin = "lab"', "'statoin'", "'station'"),
        ('[features]\nbundel = "x"', "'features.bundel'", "'bundle'"),
        ('[[gateway.sensors]]\nnam = "x"', "'gateway.sensors.0.nam'", "'name'"),
        ('[link]\nzzz = "x"', "'link.zzz'", "known keys: certificates, connect"),
        ('[log]\nlevle = "info"', "'log.levle'", "'level'"),
        ('_env_prefix = "X"', "'_env_prefix'", "known keys: features"),
    ],
)
def test_unknown_key_names_file_key_and_nearest(
    tmp_path: Path, text: str, key: str, remedy: str
) -> None:
    path = _write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_profile(path)
    assert str(path) in caught.value.problem
    assert key in caught.value.problem
    assert remedy in caught.value.remedy


def test_wrong_type_names_key_value_and_what_was_expected(tmp_path: Path) -> None:
    path = _write(tmp_path, '[features]\ndrain_s = "soon"')
    with pytest.raises(ConfigError, match=r"features\.drain_s.*'soon'.*number"):
        load_profile(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('topics = ["elektrodes"]', "unknown topic 'elektrodes'; known are .*electrodes"),
        ('sensor = "No Such"', "'No Such' cannot stand in a Zenoh key"),
    ],
)
def test_what_is_recorded_is_checked_with_the_profile(tmp_path: Path, text: str, says: str) -> None:
    path = _write(tmp_path, f"[recorder]\n{text}")
    with pytest.raises(ConfigError, match=says):
        load_profile(path)


def test_unknown_process_is_named(tmp_path: Path) -> None:
    path = _write(tmp_path, 'processes = ["router", "gatway"]')
    with pytest.raises(ConfigError, match=r"processes\.1.*gatway.*'gateway'"):
        load_profile(path)


def test_a_value_of_several_types_is_named_by_its_key(tmp_path: Path) -> None:
    path = _write(tmp_path, "[gateway]\ncore = -5")
    with pytest.raises(ConfigError, match=r"gateway\.core = -5"):
        load_profile(path)


def test_bad_toml_names_the_line(tmp_path: Path) -> None:
    path = _write(tmp_path, 'station = "lab"\n[features\n')
    with pytest.raises(ConfigError, match=r"mine\.toml is not TOML.*line 2"):
        load_profile(path)


def test_missing_file() -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        load_profile("./nowhere.toml")


def test_a_folder_is_no_profile(tmp_path: Path) -> None:
    (tmp_path / "d.toml").mkdir()
    with pytest.raises(ConfigError, match="is no file"):
        load_profile(tmp_path / "d.toml")


def test_unknown_name_gives_the_nearest() -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile("virtaul")
    assert "'virtual'" in caught.value.remedy


def test_exposed_router_without_tls_is_refused(tmp_path: Path) -> None:
    path = _write(tmp_path, '[router]\nlisten = ["tcp/0.0.0.0:7447"]')
    with pytest.raises(ConfigError, match="mutual TLS"):
        load_profile(path)


@pytest.mark.parametrize(
    ("listen", "says"),
    [
        ("[]", "listen is empty"),
        ('["tcp/127.0.0.1:0"]', "no port"),
        ('["tls/127.0.0.1:7447"]', r"needs certificates.*\[link\] certificates"),
    ],
)
def test_router_that_nobody_can_reach_is_refused(tmp_path: Path, listen: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load_profile(_write(tmp_path, f"[router]\nlisten = {listen}"))


def test_all_addresses_and_one_of_them_exclude_each_other(tmp_path: Path) -> None:
    """The router could not bind the second one, and would never start."""
    two = '["tls/127.0.0.1:7447", "tls/0.0.0.0:7447"]'
    text = f'[router]\nlisten = {two}\n[link]\ncertificates = "/pki"\n'
    with pytest.raises(ConfigError, match="all addresses") as caught:
        load_profile(_write(tmp_path, text))
    assert "leave the other one out" in caught.value.remedy
    load_profile(_write(tmp_path, text.replace("0.0.0.0:7447", "192.168.1.2:7447")))
    load_profile(_write(tmp_path, text.replace("127.0.0.1:7447", "[::1]:7447")))
    with pytest.raises(ConfigError, match="at ::, which is all addresses"):
        load_profile(_write(tmp_path, text.replace("0.0.0.0:7447", "[::]:7447")))


def test_router_port_is_said_once(tmp_path: Path) -> None:
    """Who starts the router connects to it, unless told otherwise."""
    path = _write(tmp_path, '[router]\nlisten = ["tcp/127.0.0.1:9000"]')
    assert load_profile(path).link.connect == ("tcp/127.0.0.1:9000",)


def test_environment_wins_over_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _write(tmp_path, '[features]\nbundle = "a"\ndrain_s = 1.0')
    monkeypatch.setenv("PALPATE_FEATURES__BUNDLE", "b")
    monkeypatch.setenv("PALPATE_STATION", "left")
    profile = load_profile(path)
    assert (profile.features.bundle, profile.features.drain_s, profile.station) == (
        "b",
        1.0,
        "left",
    )


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("PALPATE_STATOIN", "x", "PALPATE_STATION"),
        ("PALPATE_FEATURES__BUNDEL", "x", "bundle"),
        ("PALPATE_FEATURES__DRAIN_S", "soon", "PALPATE_FEATURES__DRAIN_S"),
    ],
)
def test_bad_environment_variable_is_named(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, said: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(ConfigError) as caught:
        load_profile("virtual")
    assert variable in caught.value.problem
    assert said in str(caught.value)


def test_name_that_cannot_stand_in_a_key(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="My Lab"):
        load_profile(_write(tmp_path, 'station = "My Lab"'))


def test_changed_profile_is_checked() -> None:
    profile = load_profile("virtual")
    assert str(changed(profile, recorder={"out": "elsewhere"}).recorder.out) == "elsewhere"
    with pytest.raises(ConfigError, match="command line"):
        changed(profile, recorder={"capacity": -1})


@pytest.mark.parametrize("name", profile_names())
def test_profile_survives_toml(name: str) -> None:
    profile = load_profile(name)
    text = tomli_w.dumps(plain_values(profile))
    assert parse_profile(tomllib.loads(text), where="text") == profile


@pytest.mark.parametrize("odd", [math.inf, -math.inf, math.nan])
def test_options_that_are_no_number_survive_toml_to_be_refused_by_name(odd: float) -> None:
    """The driver says which one is wrong; before, nothing could write the profile down."""
    options = {"rate_hz": odd, "mount": {"orientation_wxyz": [odd, 0, 0, 0]}}
    sensor = {"name": "finger", "driver": "virtual", "options": options}
    profile = parse_profile({"gateway": {"sensors": [sensor]}}, where="test")
    read = tomllib.loads(tomli_w.dumps(plain_values(profile)))
    assert repr(read["gateway"]["sensors"][0]["options"]) == repr(options)
