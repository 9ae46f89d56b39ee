"""Options of the ``wrench_rdt`` driver."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from palpate_gateway.protocols.rdt import HEX_FILTERS_HZ, HEX_PERIOD_MAX_MS, PORT, RdtScale
from palpate_gateway.wrench.device import WrenchOptions

PRODUCTS = {
    "ati_net_ft": "ATI Net F/T",
    "ati_axia": "ATI Ethernet Axia",
    "schunk_ftn": "Schunk FTN-AXIA",
    "onrobot_hex": "OnRobot HEX",
}
"""What people call each product."""


class RdtOptions(WrenchOptions):
    """Options of the ``wrench_rdt`` driver.

    Attributes:
        product: Which meaning the status word has.
        host: Address; the factory setting of all products is the default.
        port: UDP port of the records.
        http_port: TCP port of the web page that tells what a count is worth.
        rate_hz: Records each second. A HEX is set to it, 1000 divided by a whole number; the
            others are set on their own web page, and this must say the same.
        counts_per_n: What a count is worth, instead of what the device tells; with the next.
        counts_per_n_m: The same for torque.
        counter_hz: Rate of the device's own counter, its clock; None = the product's or what the
            device tells, 0 = use the host's clock.
        filter_code: Low-pass filter of a HEX (0 none, 1 500 Hz, 2 150, 3 50, 4 15, 5 5, 6 1.5);
            None = as it is set.
        sensor: Number of the sensor at a HEX converter that has several; None = there is one.
    """

    product: Literal["ati_net_ft", "ati_axia", "schunk_ftn", "onrobot_hex"]
    host: str = Field(default="192.168.1.1", min_length=1)
    port: int = Field(default=PORT, ge=1, le=65535)
    http_port: int = Field(default=80, ge=1, le=65535)
    rate_hz: float = Field(default=1000.0, ge=1.0, le=8000.0)
    counts_per_n: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    counts_per_n_m: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    counter_hz: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)
    filter_code: int | None = Field(default=None, ge=0, le=max(HEX_FILTERS_HZ))
    sensor: int | None = Field(default=None, ge=0, le=7)

    @property
    def period_ms(self) -> int:
        """Time from record to record, as a HEX is told [ms]."""
        return round(1000.0 / self.rate_hz)

    def scale(self) -> RdtScale | None:
        """What a count is worth; None = the device or the product says so."""
        if self.counts_per_n is None or self.counts_per_n_m is None:
            return None
        return RdtScale(self.counts_per_n, self.counts_per_n_m)

    @model_validator(mode="after")
    def _fits_product(self) -> RdtOptions:
        if (self.counts_per_n is None) != (self.counts_per_n_m is None):
            raise ValueError("counts_per_n and counts_per_n_m must be given together")
        if self.product == "onrobot_hex":
            period_ms = self.period_ms
            fits = 1 <= period_ms <= HEX_PERIOD_MAX_MS
            if not fits or abs(self.rate_hz * period_ms / 1000.0 - 1.0) > 1e-3:
                raise ValueError(
                    f"rate_hz {self.rate_hz:g} of a HEX is not 1000 divided by a whole number "
                    f"from 1 to {HEX_PERIOD_MAX_MS}"
                )
        elif self.filter_code is not None or self.sensor is not None:
            raise ValueError("filter_code and sensor are options of the onrobot_hex only")
        return self
