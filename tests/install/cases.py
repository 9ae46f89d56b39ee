"""Profiles of stations that need different things of their host."""

from __future__ import annotations

VIRTUAL = """\
station = "lab"
processes = ["router", "gateway", "features", "recorder"]
[[gateway.sensors]]
name = "finger"
driver = "virtual"
options = { seed = 7, unit = "biotac-2" }
[features]
bundle = "features-twin"
"""

_CAN = """\
[[gateway.sensors]]
name = "finger"
driver = "biotac_can"
options = { channel = "can0" }
"""
_NETWORK = """\
[[gateway.sensors]]
name = "wrench"
driver = "wrench_rdt"
options = { product = "ati_net_ft", host = "192.168.1.1" }
"""
_SERIAL = """\
[[gateway.sensors]]
name = "second"
driver = "wrench_bota"
options = { port = "/dev/serial/by-id/usb-1", rate_hz = 800 }
"""
_FEM = 'processes = ["router", "gateway", "features", "fem", "recorder"]\n'

PROFILES = {
    "virtual": VIRTUAL,
    "can": _CAN,
    "network": _NETWORK,
    "serial": _SERIAL,
    "elements": _FEM,
    "everything": _FEM + _CAN + _NETWORK + _SERIAL,
}
"""TOML by what is special."""
