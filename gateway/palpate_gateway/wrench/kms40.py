"""Weiss Robotics KMS 40: text over TCP (hardware reference 3.1).

Samples have no number and no usable time: they get the host's time, and a lost sample looks like a
late one. They do not say whether they are valid, so the driver asks for the device's flags from
time to time, while it streams.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence

from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.clock.sample_times import ArrivalTimes
from palpate_gateway.ports.port import silent
from palpate_gateway.ports.sockets import ReceivedBytes, TcpPort
from palpate_gateway.protocols import kms40 as wire
from palpate_gateway.protocols.kms40 import KmsDecoder, KmsFlags, KmsForceLine, KmsRefusal, KmsReply
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions

_ANSWER_S = 2.0
_GREET_S = 0.25
_GOODBYE_S = 0.3
_PATIENCE_S = 0.25
"""Silence after which the stream is started again; longer at low rates [s]."""

_EXPECTED = (
    KmsFlags.CALIBRATION_VALID
    | KmsFlags.STABLE
    | KmsFlags.TARE_ON
    | KmsFlags.FILTER_ON
    | KmsFlags.ACQUISITION_RUNNING
    | KmsFlags.SCRIPT_RUNNING
)
"""Flags of a healthy device."""


class Kms40Options(WrenchOptions):
    """Options of the ``wrench_kms40`` driver.

    Attributes:
        host: Address; two factory settings are known, 192.168.1.30 and 192.168.0.30.
        port: TCP port.
        rate_hz: Samples each second, 500 divided by a whole number.
        filter_number: Number in the device's table of filters; None = leave its setting.
        flags_every_s: Time between two requests for overload and faults [s]; 0 = never. Samples
            between a fault and the next answer are published.
    """

    host: str = Field(min_length=1)
    port: int = Field(default=wire.PORT, ge=1, le=65535)
    rate_hz: float = Field(default=wire.BASE_RATE_HZ, ge=1.0, le=wire.BASE_RATE_HZ)
    filter_number: int | None = Field(default=None, ge=0, le=wire.FILTER_MAX)
    flags_every_s: float = Field(default=1.0, ge=0.0, le=60.0)

    @model_validator(mode="after")
    def _has_divider(self) -> Kms40Options:
        divider = wire.divider_of_rate(self.rate_hz)
        near = wire.rate_of_divider(divider)
        if abs(near / self.rate_hz - 1.0) > 1e-3:
            below = wire.rate_of_divider(divider + 1)
            raise ValueError(
                f"rate_hz {self.rate_hz:g} is not 500 divided by a whole number; the nearest are "
                f"{below:g} and {near:g}"
            )
        return self


class WrenchKms40(WrenchDevice):
    """A KMS 40 on the network."""

    options_class = Kms40Options

    def __init__(self, options: Kms40Options) -> None:
        self._divider = wire.divider_of_rate(options.rate_hz)
        rate_hz = wire.rate_of_divider(self._divider)
        model = f"Weiss KMS 40 at {options.host}"
        super().__init__("wrench_kms40", model, rate_hz, options)
        self._filter, self._flags_every_s = options.filter_number, options.flags_every_s
        self._has_clock = False
        self._port = TcpPort(options.host, options.port)
        self.address = self._port.name
        self._patience_s = max(_PATIENCE_S, 5.0 / rate_hz)
        self._begin()

    def _begin(self) -> None:
        """Reset the state of an earlier connection."""
        self._decoder = KmsDecoder()
        self._flags = KmsFlags(0)
        # Meaning of the flags for samples, computed once and used 500 times per second.
        self._faulty = self._over_range = False
        self._flags_due_s = 0.0
        self._flags_asked = False
        self._heard_s = time.monotonic()
        self._arrivals = ArrivalTimes(1.0 / self.info.rate_hz)

    def zero(self) -> None:
        """See ``WrenchDevice``; the stream pauses, and the samples before it are discarded."""
        self._ask(wire.STOP_REQUEST, "L0")
        try:
            self._ask(wire.TARE_REQUEST, "TARE", "1")
        finally:
            self._ask(wire.START_REQUEST, "L1")
            self._arrivals.begin()

    def _keeps_zero(self) -> bool:
        return bool(self._flags & KmsFlags.TARE_ON)

    def _connect(self) -> str:
        self._begin()
        self._port.open()
        self._greet()
        self._ask(wire.query_request(wire.KmsQuery.IDENTITY), "ID")
        serial = self._ask(wire.query_request(wire.KmsQuery.SERIAL_NUMBER), "SN")
        if not serial:
            raise DeviceError(
                f"{self.info.model}: it gives no serial number",
                remedy="check that this is a KMS 40",
            )
        self._ask(wire.ALL_AXES_REQUEST, "LMASK", "{1,1,1,1,1,1}")
        if self._filter is not None:
            self._ask(wire.filter_request(self._filter), "FLT", str(self._filter))
        self._ask(wire.divider_request(self._divider), "LDIV", str(self._divider))
        self._ask(wire.QUIET_REQUEST, "VL", "0")
        if self._flags_every_s:
            self._check_flags()
        self._ask(wire.START_REQUEST, "L1")
        return serial

    def _greet(self) -> None:
        """Stop the stream of an earlier client; a busy device may ignore the first requests."""
        until = time.monotonic() + _ANSWER_S
        while True:
            left_s = until - time.monotonic()
            try:
                self._ask(wire.STOP_REQUEST, "L0", within_s=min(_GREET_S, left_s))
                return
            except DeviceTimeout:
                if left_s <= _GREET_S:
                    raise

    def _check_flags(self) -> None:
        hint = "; where its firmware has no FLAGS, set flags_every_s = 0"
        self._ask(wire.query_request(wire.KmsQuery.FLAGS), "FLAGS", hint=hint)
        faults = self._flags & wire.FAULTS
        if faults:
            raise DeviceError(
                f"{self.info.model}: it reports {', '.join(wire.flag_names(faults))}",
                remedy="its forces are not valid: check supply, temperature and calibration",
            )
        self._flags_due_s = time.monotonic() + self._flags_every_s

    def _close(self) -> None:
        # Wait for the echo: a socket that is closed with unread input cancels the request.
        with contextlib.suppress(DeviceError):
            self._ask(wire.STOP_REQUEST, "L0", within_s=_GOODBYE_S)
        self._port.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        until = time.monotonic() + timeout_s
        while True:
            left_s = max(until - time.monotonic(), 0.0)
            try:
                received = self._port.receive(min(left_s, self._patience_s))
            except DeviceTimeout:
                received = None
            readings = [] if received is None else self._readings(received)
            self._keep_going()
            if received is not None:
                return readings
            if time.monotonic() >= until:
                raise silent(self.info.model, round(timeout_s, 3))

    def _readings(self, received: ReceivedBytes) -> list[WrenchReading]:
        records = self._decoder.feed(received.data)
        count = sum(isinstance(record, KmsForceLine) for record in records)
        times_ns = iter(self._arrivals.times_ns(count, received.arrival_ns) if count else ())
        readings = []
        for record in records:
            if isinstance(record, KmsReply):
                self._note(record)
            if not isinstance(record, KmsForceLine):
                continue
            self._heard_s = time.monotonic()
            arrival_ns = next(times_ns)
            # The time of an invalid sample is used up above, so that the others keep theirs.
            if self._faulty:
                self._counts["invalid_samples"] += 1
                continue
            reading = self._reading(
                (*record.force, *record.torque),
                arrival_ns=arrival_ns,
                overload=self._over_range,
            )
            if reading is not None:
                readings.append(reading)
        return readings

    def _keep_going(self) -> None:
        """Request the stream if it has stopped, and the flags if they are due."""
        now_s = time.monotonic()
        if now_s - self._heard_s >= self._patience_s:
            self._heard_s = now_s
            self._counts["streams_restarted"] += 1
            self._port.write(wire.START_REQUEST)
        if self._flags_every_s and now_s >= self._flags_due_s:
            self._flags_due_s = now_s + self._flags_every_s
            self._counts["flags_unanswered"] += self._flags_asked
            self._flags_asked = True
            self._port.write(wire.query_request(wire.KmsQuery.FLAGS))

    def _note(self, reply: KmsReply) -> None:
        if reply.name != wire.KmsQuery.FLAGS:
            return
        self._flags_asked = False
        flags = wire.parse_flags(reply.value)
        if flags is None:
            self._counts["bad_flags"] += 1
            return
        self._flags = flags
        self._faulty = bool(flags & wire.FAULTS)
        self._over_range = bool(wire.over_range_axes(flags))
        for name in wire.flag_names(flags & ~_EXPECTED):
            self._counts["status_" + name.replace(" ", "_")] += 1
        if not flags & KmsFlags.CALIBRATION_VALID:
            self._counts["status_calibration_not_valid"] += 1

    def _ask(
        self,
        request: bytes,
        name: str,
        wanted: str | None = None,
        *,
        within_s: float = _ANSWER_S,
        hint: str = "",
    ) -> str:
        """The value in the answer to a request; samples before the answer are discarded.

        ``hint`` ends the remedy where there is none.

        Raises:
            DeviceTimeout: No answer came.
            DeviceError: The device refuses, or answers with a value other than ``wanted``.
        """
        self._port.write(request)
        asked = f"{self.info.model}: {request.decode('ascii').strip()}"
        until = time.monotonic() + within_s
        while (left_s := until - time.monotonic()) > 0.0:
            try:
                data = self._port.read(left_s)
            except DeviceTimeout:
                break
            for record in self._decoder.feed(data):
                if isinstance(record, KmsRefusal):
                    raise DeviceError(
                        f"{asked} was refused: {record.meaning} (error {record.code})",
                        remedy=f"check that it is a KMS 40 whose firmware knows the command{hint}",
                    )
                if not isinstance(record, KmsReply):
                    continue
                self._note(record)
                if record.name == name:
                    self._heard_s = time.monotonic()
                    return self._checked(record.value, wanted, asked)
        raise DeviceTimeout(
            f"{asked} was not answered within {within_s:g} s",
            remedy=f"check that this is a KMS 40 and that no other client is connected to it{hint}",
        )

    def _checked(self, value: str, wanted: str | None, asked: str) -> str:
        if wanted is not None and value.replace(" ", "") != wanted:
            raise DeviceError(
                f"{asked} was answered with {value[:40]!r} instead of {wanted!r}",
                remedy="the device does not accept this setting: choose another rate or filter",
            )
        return value

    def _protocol_counters(self) -> Mapping[str, int]:
        return {**self._decoder.counters, **self._arrivals.counters}
