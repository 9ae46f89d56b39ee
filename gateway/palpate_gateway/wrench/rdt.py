"""Sensors that speak RDT over UDP (hardware reference 3.2, 3.3).

ATI Net F/T, ATI Ethernet Axia, Schunk FTN-AXIA, and OnRobot HEX with its Ethernet converter. No
request is ever confirmed: what is asked for is looked for in the records, and asked for again.
"""

from __future__ import annotations

import contextlib
import logging
import re
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.ports.port import silent
from palpate_gateway.ports.sockets import ReceivedBytes, UdpPort, read_page
from palpate_gateway.protocols.netft_xml import DOCUMENT_BYTES_MAX, parse_netft_xml
from palpate_gateway.protocols.rdt import (
    HEX,
    PROFILES,
    RdtDecoder,
    RdtRecord,
    RdtScale,
    RdtSequence,
    hex_filter_request,
    hex_period_request,
    hex_sensor_number,
)
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice
from palpate_gateway.wrench.rdt_clock import CounterClock
from palpate_gateway.wrench.rdt_options import PRODUCTS, RdtOptions

_log = logging.getLogger(__name__)

_PATIENCE_S = 0.1
"""Silence after which the start request is repeated, unless it is that slow by itself [s]."""
_STARTS = 10
_ZEROS = 3
_ZERO_RECORDS = 5
_PAGE_S = 3.0
_AT_ONCE = 256
"""Most datagrams read before readings are handed over."""

_SUMMARY = 1 << 31
_SEVERAL_SENSORS = 1 << 3


class _Record(NamedTuple):
    """A new record, its number over all starts, the device's time [s] and its arrival [ns]."""

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
        self._profile = PROFILES[options.product]
        self._is_hex = self._profile is HEX
        self._port = UdpPort(options.host, options.port)
        self._patience_s = max(_PATIENCE_S, 5.0 / options.rate_hz)
        self._scale = RdtScale(1.0, 1.0)
        self._clock = CounterClock(None, model)
        self._begin()

    def _begin(self) -> None:
        """Forget what an earlier connection told."""
        self._decoder, self._sequence = RdtDecoder(), RdtSequence()
        self._early: list[_Record] = []
        self._heard_s = time.monotonic()

    def zero(self) -> None:
        """See ``WrenchDevice``; asked for again until the records show it."""
        before, spread_before = self._load()
        for _ in range(_ZEROS):
            self._port.write(self._profile.bias_request())
            after, spread = self._load()
            # Only a request that was lost leaves a load where it was.
            if np.all(abs(after) <= 0.5 * abs(before) + spread_before + spread + 2.0):
                return
        raise DeviceError(
            f"{self.info.model}: {_ZEROS} bias requests did not change what it tells",
            remedy="keep the load still and try again",
        )

    def _load(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Mean and spread of the next valid records [counts], shape ``(6,)`` each."""
        period_s = 1.0 / self.info.rate_hz
        # What was under way when it was asked for is of before.
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
        self._port.write(self._profile.stop_request())
        self._port.discard_input()
        if self._is_hex:
            if self._options.filter_code is not None:
                self._port.write(hex_filter_request(self._options.filter_code))
            self._port.write(hex_period_request(self._options.period_ms))
        self._start()
        several = self._is_hex and self._early[0].raw.status & _SEVERAL_SENSORS
        if several and self._options.sensor is None:
            raise DeviceError(
                f"{self.info.model}: its converter has several sensors",
                remedy="name one by the option 'sensor'",
            )
        return serial or self._port.name

    def _learn(self) -> str:
        """Find out what a count and a tick are worth; the serial number if it tells one."""
        options, profile, serial = self._options, self._profile, ""
        scale, counter_hz = options.scale() or profile.scale, profile.ft_rate_hz
        if scale is None:
            url = f"http://{options.host}:{options.http_port}/netftapi2.xml"
            page = read_page(url, timeout_s=_PAGE_S, most_bytes=DOCUMENT_BYTES_MAX)
            settings = parse_netft_xml(page)
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
            # Kept over connections: the next one would only find the same.
            self._counts["counter_rate_wrong"] += 1
            counter_hz = None
        wrong, self._clock = self._clock.wrong, CounterClock(counter_hz, self.info.model)
        self._clock.wrong = wrong
        self._tells_time = counter_hz is not None
        return serial

    def _start(self) -> None:
        for _ in range(_STARTS):
            self._port.write(self._profile.start_request())
            with contextlib.suppress(DeviceTimeout):
                self._early = self._fresh(self._port.receive(self._patience_s))
            if self._early:
                return
        raise DeviceTimeout(
            f"{self.info.model}: no record came after {_STARTS} start requests",
            remedy="check the address, that RDT is enabled in the device, and that nobody else "
            "reads from it",
        )

    def _close(self) -> None:
        with contextlib.suppress(DeviceError):
            self._port.write(self._profile.stop_request())
        self._port.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        readings = []
        for record in self._listen(timeout_s):
            overload = self._overload(record.raw)
            if overload is None:
                continue
            wrench = self._scale.wrench(record.raw.counts).tolist()
            readings.append(
                self._reading(
                    wrench,
                    time_s=record.time_s,
                    arrival_ns=record.arrival_ns,
                    tick=record.tick,
                    overload=overload,
                )
            )
        return [reading for reading in readings if reading is not None]

    def _listen(self, timeout_s: float) -> list[_Record]:
        """New records; may be none, if what came was not any."""
        records, self._early = self._early, []
        until = time.monotonic() + timeout_s
        while not records:
            heard = False
            left_s = max(until - time.monotonic(), 0.0)
            with contextlib.suppress(DeviceTimeout):
                records += self._fresh(self._port.receive(min(left_s, self._patience_s)))
                heard = True
                for _ in range(_AT_ONCE - 1):
                    records += self._fresh(self._port.receive(0.0))
            self._keep_going()
            if heard:
                break
            if time.monotonic() >= until:
                raise silent(self.info.model, round(timeout_s, 3))
        return records

    def _keep_going(self) -> None:
        """Ask for the stream again if there is none."""
        now_s = time.monotonic()
        if now_s - self._heard_s >= self._patience_s:
            self._heard_s = now_s
            self._counts["starts_repeated"] += 1
            self._port.write(self._profile.start_request())

    def _fresh(self, datagram: ReceivedBytes) -> list[_Record]:
        """Records of a datagram that are neither repeated nor late."""
        records = []
        for raw in self._decoder.feed(datagram.data):
            self._heard_s = time.monotonic()
            step = self._sequence.step(raw.rdt_sequence, raw.ft_sequence)
            if step.keep:
                time_s = self._clock.follow(
                    raw.ft_sequence, 1e-9 * datagram.arrival_ns, new_epoch=step.new_epoch
                )
                records.append(_Record(raw, step.tick, time_s, datagram.arrival_ns))
        return records

    def _overload(self, raw: RdtRecord) -> bool | None:
        """Whether the range is exceeded; None, and counted, if the record is not to be used."""
        profile, status = self._profile, raw.status
        if self._is_hex and self._options.sensor not in (None, hex_sensor_number(status)):
            self._counts["other_sensors"] += 1
            return None
        for name in profile.status_names(status):
            self._counts["status_" + re.sub("[^a-z0-9]+", "_", name.lower())] += 1
        overload = profile.overloaded(status)
        if overload:
            # Saturation is flagged, not dropped (hardware reference 4.3); it sets the summary too.
            status &= ~(profile.overload | _SUMMARY)
        if profile.valid(status):
            return overload
        self._counts["invalid_samples"] += 1
        return None

    def _protocol_counters(self) -> Mapping[str, int]:
        counters = {**self._decoder.counters, **self._sequence.counters}
        counters["lost_samples"] = counters.pop("lost_records")
        return counters
