"""How the sensors that speak RDT differ, and what they tell by HTTP (reference 3.2, 3.3)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Product:
    """How one product differs from the others."""

    name: str
    rate_hz: float
    counter_hz: float
    starts: tuple[int, ...]
    overload: int
    error: int
    has_page: bool = True


_ANY_ERROR = 1 << 31
_START_ONE, _START, _START_MANY = 0x0001, 0x0002, 0x0003

PRODUCTS = {
    "netft": Product(
        "Net F/T",
        rate_hz=1000.0,
        counter_hz=7000.0,
        starts=(_START, _START_MANY),
        overload=_ANY_ERROR | 1 << 17,
        error=_ANY_ERROR | 1 << 28,
    ),
    "axia": Product(
        "Ethernet Axia",
        rate_hz=1000.0,
        counter_hz=7912.0,
        starts=(_START_ONE, _START, _START_MANY),
        overload=_ANY_ERROR | 1 << 30,
        error=_ANY_ERROR | 1 << 2,
    ),
    "hex": Product(
        "HEX",
        rate_hz=100.0,
        counter_hz=1000.0,
        starts=(_START,),
        overload=1 << 6,
        error=1 << 10,
        has_page=False,
    ),
}

LATCHED = _ANY_ERROR | 1 << 16
"""Status of a Net F/T whose threshold was passed once; the data is good."""


def page(product: str, counts_per: tuple[float, float], units: tuple[str, str]) -> bytes:
    """The device's facts as its own web server tells them; only the tags that the reference has."""
    tags = {
        "prodname": product,
        "cfgcpf": f"{counts_per[0]:.10g}",
        "cfgcpt": f"{counts_per[1]:.10g}",
        "scfgfu": units[0],
        "scfgtu": units[1],
    }
    inside = "\n".join(f"<{tag}>{value}</{tag}>" for tag, value in tags.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<netft>\n{inside}\n</netft>\n'.encode()
