from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import DeviceError
from palpate_gateway.protocols.netft_xml import DOCUMENT_BYTES_MAX, parse_netft_xml

TAGS = {
    "prodname": "Net F/T",
    "cfgcalsn": "FT01234",
    "runrate": "7000",
    "comrdtrate": "1000",
    "cfgcpf": "1000000",
    "cfgcpt": "1000000",
    "scfgfu": "N",
    "scfgtu": "Nm",
}


def document(**tags: str | None) -> bytes:
    parts = (f"<{k}>{v}</{k}>" for k, v in (TAGS | tags).items() if v is not None)
    return f'<?xml version="1.0"?>\n<netft>{"".join(parts)}</netft>'.encode()


def test_settings_in_si_units() -> None:
    settings = parse_netft_xml(document())
    assert settings.serial == "FT01234"
    assert (settings.scale.counts_per_n, settings.scale.counts_per_n_m) == (1e6, 1e6)
    assert (settings.sample_rate_hz, settings.rdt_rate_hz) == (7000.0, 1000.0)


def test_only_the_scale_is_needed() -> None:
    settings = parse_netft_xml(document(cfgcalsn=None, runrate=None, comrdtrate="fast"))
    assert settings.serial == ""
    assert (settings.sample_rate_hz, settings.rdt_rate_hz) == (None, None)


@pytest.mark.parametrize(
    ("unit", "newtons"),
    [
        ("N", 1.0), ("kN", 1e3), ("lbf", 4.4482216152605), ("klbf", 4448.2216152605),
        ("kgf", 9.80665), ("gf", 9.80665e-3), ("lb", 4.4482216152605), ("kg", 9.80665),
        (" LBF ", 4.4482216152605),
    ],
)  # fmt: skip
def test_units_of_force(unit: str, newtons: float) -> None:
    scale = parse_netft_xml(document(scfgfu=unit, cfgcpf="1000")).scale
    assert scale.counts_per_n == pytest.approx(1000 / newtons, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "newton_metres"),
    [
        ("Nm", 1.0), ("N-m", 1.0), ("N.m", 1.0), ("N m", 1.0), ("Nmm", 1e-3), ("N-mm", 1e-3),
        ("kN-m", 1e3), ("kNm", 1e3), ("lbf-in", 0.1129848290276167),
        ("lbf-ft", 1.3558179483314004), ("kgf-cm", 0.0980665), ("kg-cm", 0.0980665),
    ],
)  # fmt: skip
def test_units_of_torque(unit: str, newton_metres: float) -> None:
    scale = parse_netft_xml(document(scfgtu=unit, cfgcpt="2.5e3")).scale
    assert scale.counts_per_n_m == pytest.approx(2500 / newton_metres, rel=1e-12)


def test_counts_become_the_same_force_in_any_unit() -> None:
    pounds = parse_netft_xml(document(scfgfu="lbf", scfgtu="lbf-in")).scale
    force_n, *_, torque_n_m = pounds.wrench((1_000_000, 0, 0, 0, 0, 1_000_000))
    assert force_n == pytest.approx(4.4482216)
    assert torque_n_m == pytest.approx(0.11298483)


@pytest.mark.parametrize("tag", ["cfgcpf", "cfgcpt", "scfgfu", "scfgtu"])
@pytest.mark.parametrize("text", [None, "", "  "])
def test_missing_tags_are_named(tag: str, text: str | None) -> None:
    with pytest.raises(DeviceError, match=f"in the tags {tag} ->") as caught:
        parse_netft_xml(document(**{tag: text}))
    assert "browser" in caught.value.remedy


@pytest.mark.parametrize("tag", ["cfgcpf", "cfgcpt"])
@pytest.mark.parametrize("text", ["0", "-5", "nan", "inf", "1e999", "many", "1_000", "0x10", "٣"])
def test_counts_that_are_no_positive_number(tag: str, text: str) -> None:
    with pytest.raises(DeviceError, match=f"{tag} is '.*', not a positive number"):
        parse_netft_xml(document(**{tag: text}))


@pytest.mark.parametrize(
    ("tag", "text"), [("scfgfu", "dyn"), ("scfgtu", "N"), ("scfgfu", "Nm"), ("scfgtu", "5")]
)
def test_unknown_units_are_named(tag: str, text: str) -> None:
    with pytest.raises(DeviceError, match=f"{tag} is the unknown unit '{text}'") as caught:
        parse_netft_xml(document(**{tag: text}))
    assert "N and Nm" in caught.value.remedy


def test_scale_beyond_floats() -> None:
    with pytest.raises(DeviceError, match="out of range"):
        parse_netft_xml(document(cfgcpf="1e308", scfgfu="gf"))


@pytest.mark.parametrize(
    "data",
    [b"", b"404 not found", b"<netft>", document()[:-3], b"\xff\xfe<\x00a\x00/\x00>\x00", b"\x00"],
)
def test_what_is_not_xml(data: bytes) -> None:
    with pytest.raises(DeviceError, match="not XML"):
        parse_netft_xml(data)


def test_other_encodings_and_namespaces() -> None:
    text = document(cfgcalsn="Müller").decode()
    assert parse_netft_xml(b"\xef\xbb\xbf" + text.encode()).serial == "Müller"
    assert parse_netft_xml(text.encode("latin-1")).serial == "Müller"
    spaced = text.replace("<netft>", '<netft xmlns="urn:x"><settings>')
    assert parse_netft_xml(spaced.replace("</netft>", "</settings></netft>").encode()).serial


BOMB = (
    '<?xml version="1.0"{}?><!DOCTYPE netft [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">'
    "]><netft><prodname>&b;</prodname></netft>"
)


@pytest.mark.parametrize("bomb", [BOMB.format(""), "<!DOCTYPE html><html></html>"])
def test_document_types_are_refused(bomb: str) -> None:
    with pytest.raises(DeviceError, match="document type"):
        parse_netft_xml(bomb.encode())


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32"])
def test_document_type_does_not_hide_in_an_encoding(encoding: str) -> None:
    with pytest.raises(DeviceError, match=r"not XML|document type"):
        parse_netft_xml(BOMB.format(f' encoding="{encoding}"').encode(encoding))


def test_document_type_does_not_hide_behind_a_named_encoding() -> None:
    head, body = BOMB.format(' encoding="cp037"').split("?>")
    with pytest.raises(DeviceError, match=r"not XML|document type"):
        parse_netft_xml(f"{head}?>".encode() + body.encode("cp037"))
    named = document().replace(b'"1.0"', b'"1.0" encoding="cp037"')
    assert parse_netft_xml(named).serial == "FT01234"


def test_large_and_deep_documents() -> None:
    with pytest.raises(DeviceError, match="bytes, more than"):
        parse_netft_xml(document() + b" " * DOCUMENT_BYTES_MAX)
    depth = 140_000
    deep = b"<a>" * depth + b"</a>" * depth
    with pytest.raises(DeviceError, match="nothing in the tags"):
        parse_netft_xml(deep)
    with pytest.raises(DeviceError, match="not a positive number"):
        parse_netft_xml(document(cfgcpf="7" * 1_000_000 + "x"))


@settings(max_examples=100, deadline=None)
@given(st.one_of(st.binary(), st.binary().map(lambda junk: document()[:150] + junk)))
def test_only_device_errors(data: bytes) -> None:
    with suppress(DeviceError):
        parse_netft_xml(data)
