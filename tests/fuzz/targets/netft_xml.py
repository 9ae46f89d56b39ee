"""Settings of an ATI device, as its web server sends them."""

from __future__ import annotations

import math

from tests.fuzz.streams import has_remedy

from palpate.errors import DeviceError
from palpate_gateway.protocols.netft_xml import parse_netft_xml


def check(data: bytes) -> None:
    """All bytes are the document: settings that make sense, or an error with a remedy."""
    try:
        settings = parse_netft_xml(data)
    except DeviceError as error:
        has_remedy(error)
        return
    scale = settings.scale
    for counts in (scale.counts_per_n, scale.counts_per_n_m):
        assert math.isfinite(counts)
        assert counts > 0
    for rate in (settings.sample_rate_hz, settings.rdt_rate_hz):
        assert rate is None or (math.isfinite(rate) and rate > 0)
    assert parse_netft_xml(data) == settings


def seeds() -> list[bytes]:
    """Documents in several units and encodings, and some that are refused."""
    plain = (
        "<netft><prodname>Net F/T</prodname><cfgcalsn>FT1</cfgcalsn><cfgcpf>{}</cfgcpf>"
        "<cfgcpt>1000000</cfgcpt><scfgfu>{}</scfgfu><scfgtu>{}</scfgtu>"
        "<runrate>7000</runrate><comrdtrate>7000</comrdtrate></netft>"
    )
    units = [("1000000", "N", "Nm"), ("1e6", "lbf", "lbf-in"), ("0", "N", "N-mm"), ("5", "", "x")]
    documents = [plain.format(*one) for one in units]
    return [
        *(one.encode("ascii") for one in documents),
        ('<?xml version="1.0" encoding="latin-1"?>' + documents[0]).encode("latin-1"),
        ("\ufeff" + documents[1].replace("-", "·")).encode("utf-8"),
        documents[0].replace("<netft>", '<netft xmlns="a:b">').encode("ascii"),
        b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
        b"<a><b/>&#8364;<![CDATA[x]]></a>",
    ]
