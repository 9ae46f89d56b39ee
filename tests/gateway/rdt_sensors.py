"""RDT sensors in software, and the driver that reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.gateway.wrench_fakes import wave

from palpate.config import parse_config
from palpate_gateway.emulators.emulator import Wrench
from palpate_gateway.emulators.rdt import RdtEmulator
from palpate_gateway.wrench.rdt import RdtOptions, WrenchRdt

PRODUCTS = {"ati_net_ft": "netft", "ati_axia": "axia", "schunk_ftn": "axia", "onrobot_hex": "hex"}


def device_at(emulator: RdtEmulator, product: str = "ati_net_ft", **options: Any) -> WrenchRdt:
    host, _, port = emulator.address.partition(":")
    values = {"product": product, "host": host, "port": int(port), **options}
    values.setdefault("http_port", emulator.page.port)
    return WrenchRdt(parse_config(RdtOptions, values, where="test"))


@contextmanager
def running(
    product: str = "ati_net_ft", source: Callable[[float], Wrench] = wave, **options: Any
) -> Iterator[tuple[RdtEmulator, WrenchRdt]]:
    with (
        RdtEmulator(PRODUCTS[product], source) as emulator,
        device_at(emulator, product, **options) as device,
    ):
        yield emulator, device
