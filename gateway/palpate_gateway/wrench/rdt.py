"""Sensors that speak RDT over UDP (hardware reference 3.2, 3.3).

ATI Net F/T, ATI Ethernet Axia, Schunk FTN-AXIA, and OnRobot HEX with its Ethernet converter. The
devices never confirm a request: the driver looks for its effect in the records, and repeats it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import time
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.ports.port import settle, silent
from palpate_gateway.ports.sockets import ReceivedBytes, UdpPort, read_page
from palpate_gateway.protocols import rdt as wire
from palpate_gateway.protocols.netft_xml import (
    DOCUMENT_BYTES_MAX,
    NetftSettings,
    parse_netft_xml,
)
from palpate_gateway.protocols.rdt import RdtDecoder, RdtRecord, RdtScale, RdtSequence, unwrap
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions

PRODUCTS = {
    "ati_net_ft": "ATI Net F/T",
    "ati_axia": "ATI Ethernet Axia",
    "schunk_ftn": "Schunk FTN-AXIA",
    "onrobot_hex": "OnRobot HEX",
}
"""Common name of each product."""


class RdtOptions(WrenchOptions):
    """Options of the ``wrench_rdt`` driver.

    Attributes:
        product: The product; it decides the meaning of the status word.
        host: Address; the factory setting of all products is the default.
        port: UDP port of the records.
        http_port: TCP port of the web page with the scale.
        rate_hz: Records each second. A HEX is set to it, 1000 divided by a whole number; the
            others are set on their own web page, and this value must be the same.
        counts_per_n: Counts per newton, instead of the device's own value; give both.
        counts_per_n_m: Counts per newton metre.
        counter_hz: Rate of the device's own counter, its clock; None = that of the product or of
            the web page, 0 = use the host's clock.
        filter_code: Low-pass filter of a HEX (0 none, 1 500 Hz, 2 150, 3 50, 4 15, 5 5, 6 1.5);
            None = leave its setting.
        sensor: Number of the sensor at a HEX converter that has several; None = there is one.
    """

    product: Literal["ati_net_ft", "ati_axia", "schunk_ftn", "onrobot_hex"]
    host: str = Field(default="192.168.1.1", min_length=1)
    port: int = Field(default=wire.PORT, ge=1, le=65535)
    http_port: int = Field(default=80, ge=1, le=65535)
    rate_hz: float = Field(default=1000.0, ge=1.0, le=8000.0)
    counts_per_n: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    counts_per_n_m: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    counter_hz: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)
    filter_code: int | None = Field(default=None, ge=0, le=max(wire.HEX_FILTERS_HZ))
    sensor: int | None = Field(default=None, ge=0, le=7)

    @property
    def period_ms(self) -> int:
        """Time from record to record in the request to a HEX [ms]."""
        return round(1000.0 / self.rate_hz)

    def scale(self) -> RdtScale | None:
        """Scale of counts; None = from the device or the product."""
        if self.counts_per_n is None or self.counts_per_n_m is None:
            return None
        return RdtScale(self.counts_per_n, self.counts_per_n_m)

    @model_validator(mode="after")
    def _fits_product(self) -> RdtOptions:
        if (self.counts_per_n is None) != (self.counts_per_n_m is None):
            raise ValueError("counts_per_n and counts_per_n_m must be given together")
        if self.product == "onrobot_hex":
            period_ms = self.period_ms
            fits = 1 <= period_ms <= wire.HEX_PERIOD_MAX_MS
            if not fits or abs(self.rate_hz * period_ms / 1000.0 - 1.0) > 1e-3:
                raise ValueError(
                    f"rate_hz {self.rate_hz:g} of a HEX is not 1000 divided by a whole number "
                    f"from 1 to {wire.HEX_PERIOD_MAX_MS}"
                )
        elif self.filter_code is not None or self.sensor is not None:
            raise ValueError("filter_code and sensor are options of the onrobot_hex only")
        return self


CHECK_S = 10.0
"""Time over which the rate of the counter is measured [s]."""

_TOLERANCE = 0.03
"""Relative tolerance of the rate: products differ by more, late arrivals change it by less."""

_COUNTS_MOST_HZ = 1e6
"""No device counts faster [counts/s]; after a restart the counter seems to have gained far more."""

_RESTART_S = 0.5
"""If the two clocks differ by more over a gap in the stream, the device was off [s]."""


class CounterClock:
    """The counter of a sensor as a clock, and a check of its rate; unwraps 32 bits into seconds.

    Args:
        rate_hz: Rate of the counter; None = unknown, it only shows whether the device restarted.
        name: Name of the device, for errors.
    """

    def __init__(self, rate_hz: float | None, name: str) -> None:
        self.wrong = False
        """Whether the counter runs at another rate."""
        self._rate_hz, self._name = rate_hz, name
        self._last: tuple[int, float] | None = None
        self._first: tuple[int, float] | None = None
        self._suspect_hz: float | None = None

    def follow(self, raw: int, arrival_s: float, *, new_epoch: bool) -> float | None:
        """The device's time [s]; None if the rate is unknown.

        Args:
            raw: The counter as sent.
            arrival_s: Host time when it arrived [s].
            new_epoch: The record is the first after a start request.

        Raises:
            DeviceLost: The device was restarted, or the counter runs at another rate.
        """
        if self._last is None or self._first is None:
            self._first = self._last = raw, arrival_s
        counter = unwrap(raw, self._last[0])
        if new_epoch:
            self._check_restart(counter - self._last[0], arrival_s - self._last[1])
        # Unwrapped, the counter is a Python integer and never overflows.
        self._last = counter, arrival_s
        if self._rate_hz is None:
            return None
        waited_s = arrival_s - self._first[1]
        if waited_s >= CHECK_S:
            self._check_rate((counter - self._first[0]) / waited_s, self._rate_hz)
            self._first = self._last
        return counter / self._rate_hz

    def _check_restart(self, gained: int, waited_s: float) -> None:
        if self._rate_hz is None:
            # After a restart far behind, the nearer way may be forwards: too far for the time.
            went_on = 0 <= gained <= _COUNTS_MOST_HZ * (waited_s + _RESTART_S)
        else:
            went_on = gained >= 0 and abs(gained / self._rate_hz - waited_s) <= _RESTART_S
        if not went_on:
            raise DeviceLost(
                f"{self._name}: its counter did not continue: it was restarted",
                remedy="it is opened again automatically; its zero is gone, take it again",
            )

    def _check_rate(self, measured_hz: float, rate_hz: float) -> None:
        if abs(measured_hz / rate_hz - 1.0) <= _TOLERANCE:
            self._suspect_hz = None
            return
        # A pause of this process looks like a slow counter and then like a fast one, so one wrong
        # measurement is not enough.
        before_hz, self._suspect_hz = self._suspect_hz, measured_hz
        # A counter that stands still has a rate, too: 0.
        again = before_hz is not None and math.isclose(before_hz, measured_hz, rel_tol=_TOLERANCE)
        if again:
            self.wrong = True
            raise DeviceLost(
                f"{self._name}: its counter runs at {measured_hz:.0f} Hz, not {rate_hz:g} Hz",
                remedy="it is opened again with the host's clock; give the option counter_hz",
            )


_log = logging.getLogger(__name__)

_PATIENCE_S = 0.1
"""Silence after which the start request is repeated; longer at low rates [s]."""
_STARTS = 10
_ZEROS = 3
_ZERO_RECORDS = 5
_PAGE_S, _PAGE_AGAIN_S = 3.0, 1.0
"""Longest time to read the web page when it is opened, and between two records [s]."""

_AT_ONCE = 256
"""Most datagrams in one answer of ``read``."""

_SUMMARY = 1 << 31
_SEVERAL_SENSORS = 1 << 3


class _Record(NamedTuple):
    """A new record, its number over all starts, the device's time [s] and the arrival [ns]."""

    raw: RdtRecord
    tick: int
    time_s: float | None
    arrival_ns: int


class WrenchRdt(WrenchDevice):
    """A sensor that sends RDT records."""

    options_class = RdtOptions

    def __init__(self, options: RdtOptions) -> None:
        model = f"{PRODUCTS[options.product]} at {options.host}"
        super().__init__("wrench_rdt", model, options.rate_hz, options)
        self._options = options
        self._profile = wire.PROFILES[options.product]
        self._is_hex = self._profile is wire.HEX
        self._port = UdpPort(options.host, options.port)
        self.address = self._port.name
        self._patience_s = max(_PATIENCE_S, 5.0 / options.rate_hz)
        self._scale = RdtScale(1.0, 1.0)
        self._clock = CounterClock(None, model)
        self._begin()

    def _begin(self) -> None:
        """Reset the state of an earlier connection."""
        self._decoder, self._sequence = RdtDecoder(), RdtSequence()
        self._early: list[_Record] = []
        self._number = 0
        self._interrupted_at: int | None = None
        self._heard_s = time.monotonic()

    def zero(self) -> None:
        """See ``WrenchDevice``; the request is repeated until the records show its effect."""
        before, spread_before = self._load()
        for _ in range(_ZEROS):
            self._port.write(self._profile.bias_request)
            after, spread = self._load()
            # Only a lost request leaves the load unchanged.
            if np.all(abs(after) <= 0.5 * abs(before) + spread_before + spread + 2.0):
                return
        raise DeviceError(
            f"{self.info.model}: {_ZEROS} bias requests did not change its readings",
            remedy="keep the load still and try again",
        )

    def _load(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Mean and spread of the next valid records [counts], shape ``(6,)`` each."""
        period_s = 1.0 / self.info.rate_hz
        # Records that were under way at the request are older than its effect.
        from_s = time.monotonic() + max(0.05, 2.0 * period_s)
        until = from_s + 2.0 + 10.0 * period_s
        counts: list[Sequence[int]] = []
        while len(counts) < _ZERO_RECORDS:
            if time.monotonic() > until:
                raise DeviceTimeout(
                    f"{self.info.model}: no valid records to take a zero from",
                    remedy="look at the counters of its status",
                )
            with contextlib.suppress(DeviceTimeout):
                for record in self._listen(self._patience_s):
                    self._counts["samples_while_zeroing"] += 1
                    if time.monotonic() >= from_s and self._overload(record.raw) is not None:
                        counts.append(record.raw.counts)
        return np.mean(counts, axis=0, dtype=np.float64), np.ptp(np.array(counts, float), axis=0)

    def _connect(self) -> str:
        self._begin()
        serial = self._learn()
        self._port.open()
        self._port.write(wire.STOP_REQUEST)
        settle(self._port, quiet_s=0.0, longest_s=math.inf)
        if self._is_hex:
            if self._options.filter_code is not None:
                self._port.write(wire.hex_filter_request(self._options.filter_code))
            self._port.write(wire.hex_period_request(self._options.period_ms))
        self._start()
        first = self._early[0].raw.status
        self._number = wire.hex_sensor_number(first)
        self._interrupted_at = None
        self._is_chosen(first)
        return serial or self._port.name

    def _learn(self) -> str:
        """Get the scale of counts and the counter's rate; the serial number if there is one."""
        options, profile, serial = self._options, self._profile, ""
        scale, counter_hz = options.scale() or profile.scale, profile.ft_rate_hz
        if scale is None:
            settings = self._page(_PAGE_S)
            scale, serial = settings.scale, settings.serial
            counter_hz = counter_hz or settings.sample_rate_hz
            sends_hz = settings.rdt_rate_hz or options.rate_hz
            if abs(sends_hz / options.rate_hz - 1.0) > 0.01:
                self._counts["rate_not_as_configured"] += 1
                _log.warning(
                    "%s sends %g records a second, but rate_hz is %g",
                    *(self.info.model, sends_hz, options.rate_hz),
                )
        self._scale = scale
        if options.counter_hz is not None:
            counter_hz = options.counter_hz or None
        if self._clock.wrong:
            # Remembered over connections: a new one would measure the same wrong rate.
            self._counts["counter_rate_wrong"] += 1
            counter_hz = None
        wrong, self._clock = self._clock.wrong, CounterClock(counter_hz, self.info.model)
        self._clock.wrong = wrong
        self._has_clock = counter_hz is not None
        return serial

    def _page(self, timeout_s: float) -> NetftSettings:
        options = self._options
        url = f"http://{options.host}:{options.http_port}/netftapi2.xml"
        page = read_page(url, timeout_s=timeout_s, most_bytes=DOCUMENT_BYTES_MAX)
        return parse_netft_xml(page)

    def _check_scale(self) -> None:
        """After an interruption: whoever caused it may have changed the device's settings."""
        self._interrupted_at = None
        if self._options.scale() or self._profile.scale:
            return
        try:
            scale = self._page(_PAGE_AGAIN_S).scale
        except DeviceError:
            self._counts["page_unread"] += 1
            return
        if scale != self._scale:
            raise DeviceLost(
                f"{self.info.model}: its counts per N and per N m were "
                f"{self._scale.counts_per_n:g} and {self._scale.counts_per_n_m:g}, and are "
                f"{scale.counts_per_n:g} and {scale.counts_per_n_m:g}",
                remedy="it is opened again with the new ones; take its zero again",
            )

    def _start(self) -> None:
        for _ in range(_STARTS):
            self._port.write(wire.START_REQUEST)
            with contextlib.suppress(DeviceTimeout):
                self._take(self._port.receive(self._patience_s), self._early)
            if self._early:
                return
        raise DeviceTimeout(
            f"{self.info.model}: no record came after {_STARTS} start requests",
            remedy="check the address, that RDT is enabled in the device, and that no other "
            "client reads from it",
        )

    def _close(self) -> None:
        with contextlib.suppress(DeviceError):
            self._port.write(wire.STOP_REQUEST)
        self._port.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        records = self._listen(timeout_s)
        return self._before_error(self._measured(record) for record in records)

    def _measured(self, record: _Record) -> WrenchReading | None:
        if self._interrupted_at is not None and record.tick >= self._interrupted_at:
            self._check_scale()
        overload = self._overload(record.raw)
        if overload is None:
            return None
        return self._reading(
            self._scale.wrench(record.raw.counts).tolist(),
            time_s=record.time_s,
            arrival_ns=record.arrival_ns,
            tick=record.tick,
            overload=overload,
        )

    def _listen(self, timeout_s: float) -> list[_Record]:
        """New records, those before an error first; may be none, if the datagrams held none."""
        if self._held_error is not None:
            raise self._held_error
        records, self._early = self._early, []
        until = time.monotonic() + timeout_s
        while not records:
            received = False
            left_s = max(until - time.monotonic(), 0.0)
            try:
                self._take(self._port.receive(min(left_s, self._patience_s)), records)
                received = True
                for _ in range(_AT_ONCE - 1):
                    self._take(self._port.receive(0.0), records)
            except DeviceTimeout:
                pass
            except DeviceError as error:
                if not records:
                    raise
                self._held_error = error
            self._keep_going()
            if received:
                break
            if time.monotonic() >= until:
                raise silent(self.info.model, round(timeout_s, 3))
        return records

    def _keep_going(self) -> None:
        """Repeat the start request if the stream has stopped."""
        now_s = time.monotonic()
        if now_s - self._heard_s >= self._patience_s:
            self._heard_s = now_s
            self._counts["starts_repeated"] += 1
            self._port.write(wire.START_REQUEST)

    def _take(self, datagram: ReceivedBytes, records: list[_Record]) -> None:
        """Add the records of a datagram, without repeated and late ones."""
        for raw in self._decoder.feed(datagram.data):
            self._heard_s = time.monotonic()
            step = self._sequence.step(raw.rdt_sequence, raw.ft_sequence)
            if step.new_epoch and self._interrupted_at is None:
                self._interrupted_at = step.tick
            if step.keep:
                time_s = self._clock.follow(
                    raw.ft_sequence, 1e-9 * datagram.arrival_ns, new_epoch=step.new_epoch
                )
                records.append(_Record(raw, step.tick, time_s, datagram.arrival_ns))

    def _overload(self, raw: RdtRecord) -> bool | None:
        """Whether the range is exceeded; None, and counted, if the record is not valid."""
        profile, status = self._profile, raw.status
        if not self._is_chosen(status):
            self._counts["other_sensors"] += 1
            return None
        for name in profile.status_names(status):
            self._counts["status_" + re.sub("[^a-z0-9]+", "_", name.lower())] += 1
        overload = profile.overloaded(status)
        if overload:
            # A saturated sample is published with a flag (hardware reference 4.3). Saturation also
            # sets the summary bit.
            status &= ~(profile.overload | _SUMMARY)
        if profile.valid(status):
            return overload
        self._counts["invalid_samples"] += 1
        return None

    def _is_chosen(self, status: int) -> bool:
        """Whether a record is of the sensor to be read.

        Raises:
            DeviceLost: None is named, and there are several, perhaps only since a moment ago.
        """
        if not self._is_hex:
            return True
        number, chosen = wire.hex_sensor_number(status), self._options.sensor
        if chosen is None and (status & _SEVERAL_SENSORS or number != self._number):
            raise DeviceLost(
                f"{self.info.model}: its converter has several sensors",
                remedy="name one by the option 'sensor'",
            )
        return chosen in (None, number)

    def _protocol_counters(self) -> Mapping[str, int]:
        counters = {**self._decoder.counters, **self._sequence.counters}
        counters["lost_samples"] = counters.pop("lost_records")
        return counters
