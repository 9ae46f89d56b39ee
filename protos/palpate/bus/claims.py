"""Claims on sensors: under the key of one sensor only one gateway publishes.

Each gateway declares a token for each of its sensors, first as ``wanted``. When no other gateway
holds the sensor, and none with a lower session id wants it, for ``SETTLE_S``, the token becomes
``held`` and the gateway may publish. A token vanishes with its process, or with the lease of a link
whose process stands still, and one that waits takes over.

A process that itself stood still for longer than the lease, or whose host was asleep for so long,
may have lost a claim without seeing it: it gives the claim up and begins again.

What services do is claimed in the same way. Of those that publish estimates of a sensor one holds
the claim and the others stand by. Of those that answer one key any number may hold it together, if
all would answer alike: those whose ``serial``, here the digest of what their answers depend on, is
that of the first. Routers claim the name of their station.
"""

from __future__ import annotations

import contextlib
import logging
import platform
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import zenoh

from palpate import clock
from palpate.bus.topics import (
    CLAIM_ROOT,
    STATION_ROOT,
    SensorClaim,
    claim_key,
    claims_key,
    parse_claim_key,
)
from palpate.bus.zenoh_session import Declared
from palpate.errors import ClaimedElsewhere, ReplicaDiffers, SensorTaken, StationTaken, WireError

SETTLE_S = 0.2
"""For so long a sensor must have been free before it is taken [s]: by then each of two gateways
that start at one instant sees the token of the other."""

REJOIN_S = 2.0
"""After the link was lost nothing is taken for this long [s]: who holds a sensor may need longer to
come back, because attempts to connect are up to a second apart."""

YIELD_S = 0.5
"""Of two that hold one sensor, the later one gives it up after this time [s]; one that stood still
notices that itself, sooner."""

MOST_CLAIMS = 1024
"""So many claims are remembered at most: anybody may declare tokens."""

_ASK_S = 1.0
_LOOK_S = 0.05
_SETTLED_LOOK_S = 0.5  # of one that holds all it wants: a rival's token wakes it

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Own:
    """One claim of this process, its tokens, and since when it could change its state."""

    claim: SensorClaim
    tokens: dict[str, zenoh.LivelinessToken]
    rival: SensorClaim | None = None
    since_s: float | None = None
    new: bool = True  # never held, and nobody else was seen


class SensorClaims(Declared):
    """The claims of one process. Safe to use from several threads; made by ``Session.claims``.

    Args:
        session: The Zenoh session.
        station: Station of the sensors.
        session_id: This run of the gateway.
        instance: Its name among several.
        lease_s: After such a silence others see this process as gone [s].
        root: What is claimed, see ``SensorClaim``.
        shared: Whether several may hold a claim, if they are of the same ``serial``.
        joined: Whether the session has a link to others: without it a free sensor means nothing.
    """

    def __init__(
        self,
        session: zenoh.Session,
        station: str,
        *,
        session_id: int,
        instance: str,
        lease_s: float,
        joined: Callable[[], bool],
        root: str = CLAIM_ROOT,
        shared: bool = False,
    ) -> None:
        self._root, self._shared = root, shared
        self._liveliness = session.liveliness()
        self._station, self._session_id, self._instance = station, session_id, instance
        self.lease_s = lease_s
        self._joined = joined
        self._own: dict[str, _Own] = {}
        self._others: dict[str, SensorClaim] = {}
        self._ignored = False
        self._changed = threading.Condition(threading.RLock())
        self._alive_s = _alive_s()
        self._was_joined, self._blind_until_s = False, 0.0
        self._subscriber = self._liveliness.declare_subscriber(
            claims_key(station, root=root), self._on_sample, history=True
        )
        self._thread = threading.Thread(target=self._run, name="claims", daemon=True)
        self._thread.start()

    def want(self, sensor: str, serial: str = "") -> None:
        """Claim a sensor; it is held as soon as nobody else holds it."""
        claim = SensorClaim(
            self._station,
            sensor,
            self._session_id,
            instance=self._instance,
            host=platform.node(),
            serial=serial,
            root=self._root,
            held=False,
        )
        with self._changed:
            if sensor not in self._own:
                self._own[sensor] = own = _Own(claim, {})
                self._declare(own, claim)
                self._changed.notify_all()

    def release(self, sensor: str) -> None:
        """Withdraw the claim on a sensor, if there is one."""
        with self._changed:
            own = self._own.pop(sensor, None)
        for token in own.tokens.values() if own is not None else ():
            token.undeclare()

    def holds(self, sensor: str) -> bool:
        """Whether a wanted sensor is held now; does not wait. Call it before each message."""
        own = self._own[sensor]
        now_s = _alive_s()
        if own.claim.held and now_s - self._alive_s >= self.lease_s:
            with self._changed:  # this process stood still, and may have lost it
                self._look()
        elif own.claim.held:
            self._alive_s = now_s
        return own.claim.held

    def may_begin(self, sensor: str) -> bool:
        """Whether a wanted sensor is held, or is new and nobody else is known to claim it.

        For a service, whose first messages need not wait until the claim is held: of two that begin
        at one instant both may send until each sees the token of the other, and who receives both
        drops what comes twice.
        """
        if self.holds(sensor):
            return True
        own = self._own[sensor]
        if not own.new:
            return False
        with self._changed:
            own.new = not any(self._excludes(one, own.claim) for one in self._others.values())
        return own.new

    def rival(self, sensor: str) -> SensorClaim | None:
        """The claim that comes before that of this process; None = there is none."""
        own = self._own[sensor]
        with self._changed:
            return None if own.claim.held else own.rival

    def wait(self, sensor: str, timeout_s: float) -> bool:
        """Whether a sensor is held, at once or within this time."""
        own = self._own[sensor]
        with self._changed:
            self._changed.wait_for(lambda: own.claim.held or self.closed, timeout_s)
            return own.claim.held

    def refusal(self, sensor: str) -> ClaimedElsewhere | None:
        """Why a sensor is not held: the gateway that comes first; None = it is, or may be soon."""
        own = self._own[sensor]
        with self._changed:
            return None if own.rival is None or own.claim.held else _taken(own.rival)

    def check(self, sensor: str) -> None:
        """Before each message: whether this gateway still holds the sensor.

        Raises:
            ClaimedElsewhere: It does not; a ``SensorTaken`` where sensors are claimed.
        """
        own = self._own[sensor]
        now_s = _alive_s()
        if own.claim.held and now_s - self._alive_s < self.lease_s:
            self._alive_s = now_s
            return
        with self._changed:
            self._look()
            # Given up only because this process stood still, it is held again after a moment.
            self._changed.wait_for(
                lambda: own.claim.held or own.rival is not None or self.closed, self.lease_s
            )
            if not own.claim.held:
                raise _taken(own.rival) if own.rival is not None else _unknown(own.claim)

    def name_serial(self, sensor: str, serial: str) -> None:
        """Add the serial number of the sensor to the claim, once the sensor is open."""
        own = self._own[sensor]
        with self._changed:
            if serial != own.claim.serial:
                self._declare(own, replace(own.claim, serial=serial))

    def close(self) -> None:
        """Withdraw all claims."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()
        self._thread.join(timeout=2)
        with contextlib.suppress(zenoh.ZError):  # the session is gone, and the tokens with it
            self._subscriber.undeclare()
            for own in self._own.values():
                for token in own.tokens.values():
                    token.undeclare()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        try:
            claim = parse_claim_key(key)
        except WireError as error:
            _log.warning("%s", error)
            return
        if claim.session_id == self._session_id:
            return
        with self._changed:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._others.pop(key, None)
            else:
                self._remember(key, claim)
            self._changed.notify_all()

    def _remember(self, key: str, claim: SensorClaim) -> None:
        """With the lock. Of too many those are ignored that are least likely to come first.

        Never the one that comes first of those on a wanted sensor, however many are on others.
        """
        self._others[key] = claim
        if len(self._others) > MOST_CLAIMS:
            first: dict[str, SensorClaim] = {}
            for one in self._others.values():
                own = self._own.get(one.sensor)
                if own is not None and self._excludes(one, own.claim):
                    first[one.sensor] = min(
                        first.get(one.sensor, one), one, key=lambda of: of.order
                    )
            last = max(
                self._others,
                key=lambda key: (
                    (one := self._others[key]).sensor not in self._own,
                    first.get(one.sensor) is not one,
                    one.order,
                ),
            )
            del self._others[last]
            self._ignored = True
            _log.warning("more than %d claims on sensors: %s is ignored", MOST_CLAIMS, last)

    def _ask(self, sensor: str) -> None:
        """Who claims a sensor, where some claims were ignored; with the lock."""
        key = claims_key(self._station, sensor, root=self._root)
        for reply in self._liveliness.get(key, timeout=_ASK_S):
            with contextlib.suppress(WireError):  # anybody may declare tokens
                if reply.ok is not None:
                    claim = parse_claim_key(found := str(reply.ok.key_expr))
                    if claim.session_id != self._session_id:
                        self._remember(found, claim)

    def _run(self) -> None:
        with self._changed:
            while not self.closed:
                try:
                    self._look()
                except zenoh.ZError:  # the session is closing
                    return
                settled = all(own.claim.held and own.rival is None for own in self._own.values())
                settled_s = min(_SETTLED_LOOK_S, 0.25 * self.lease_s)
                self._changed.wait(settled_s if settled else _LOOK_S)

    def _look(self) -> None:
        """Bring every claim up to date; with the lock."""
        now_s, alive_s = time.monotonic(), _alive_s()
        stood_still = alive_s - self._alive_s >= self.lease_s
        self._alive_s = alive_s
        sees = all(own.claim.held for own in self._own.values()) or self._sees(now_s)
        for own in self._own.values():
            if stood_still and own.claim.held:
                _log.warning("this process stood still: who publishes %s?", own.claim.sensor)
                self._become(own, held=False)
            own.rival = self._rival_of(own.claim)
            may_change = (own.rival is None) != own.claim.held
            if not may_change or not (own.claim.held or sees):
                own.since_s = None
            elif own.since_s is None or stood_still:
                own.since_s = now_s
            elif now_s - own.since_s >= (YIELD_S if own.claim.held else SETTLE_S):
                if self._ignored and not own.claim.held:
                    self._ask(own.claim.sensor)
                    own.rival = self._rival_of(own.claim)
                if own.rival is None or own.claim.held:
                    self._become(own, held=not own.claim.held)

    def _rival_of(self, own: SensorClaim) -> SensorClaim | None:
        others = [one for one in self._others.values() if self._excludes(one, own)]
        first = min(others, key=lambda one: one.order, default=own)
        return first if first.order < own.order else None

    def _excludes(self, other: SensorClaim, own: SensorClaim) -> bool:
        """Whether only one of two claims can be held."""
        return other.sensor == own.sensor and not (self._shared and other.serial == own.serial)

    def _sees(self, now_s: float) -> bool:
        """Whether the claims of others are known: the session is linked, and not just again."""
        joined = self._joined()
        # Not at the first time: nothing was missed before.
        if joined != self._was_joined and (self._was_joined or self._blind_until_s):
            self._blind_until_s = now_s + REJOIN_S
        self._was_joined = joined
        return joined and now_s >= self._blind_until_s

    def _become(self, own: _Own, *, held: bool) -> None:
        own.since_s, own.new = None, False
        self._declare(own, replace(own.claim, held=held, since_wall_ns=time.time_ns()))
        self._changed.notify_all()

    def _declare(self, own: _Own, claim: SensorClaim) -> None:
        """Replace the token of a claim; the new one first, so that it is never seen without."""
        key = claim_key(claim)
        before, own.tokens = own.tokens, {key: self._liveliness.declare_token(key)}
        own.claim = claim
        for token in before.values():
            token.undeclare()


def _alive_s() -> float:
    """A clock that goes on while the host is asleep: others then see this process as gone [s]."""
    return clock.since_boot_ns() * 1e-9


def _taken(rival: SensorClaim) -> ClaimedElsewhere:
    where = f" on host {rival.host}" if rival.host else ""
    if rival.root == STATION_ROOT:
        return StationTaken(
            f"there is another station {rival.station!r} at this site, whose router runs{where}, "
            f"session {rival.session_id:016x}",
            remedy="give one of the two another name: `station` in its profile; until then this "
            "one goes on without the site",
        )
    if rival.root != CLAIM_ROOT:
        return ReplicaDiffers(
            f"{rival.instance!r}{where} answers for {rival.sensor!r} of station {rival.station!r} "
            f"and would answer otherwise: its digest is {rival.serial[:12]}",
            remedy="give both the same version and the same parameters, or this one a `sensor` of "
            "its own; it serves by itself when the other ends",
        )
    of = f" (serial {rival.serial})" if rival.serial else ""
    return SensorTaken(
        f"sensor {rival.sensor!r}{of} of station {rival.station!r} is already published by gateway "
        f"{rival.instance!r}{where}, session {rival.session_id:016x}",
        remedy="stop that gateway, or give this sensor another name; it is taken over by itself "
        "when the other one ends",
    )


def _unknown(claim: SensorClaim) -> ClaimedElsewhere:
    return SensorTaken(
        f"this gateway stood still, or has no link to the router: sensor {claim.sensor!r} may have "
        "been taken over by another one",
        remedy="start the router: palpate up; publishing goes on by itself",
    )


class ClaimWatch(Declared):
    """Follows the claims that are held at a station (``"*"`` = any). Safe in several threads."""

    def __init__(self, session: zenoh.Session, station: str) -> None:
        self._claims: dict[str, tuple[str, int]] = {}
        self._holders: dict[str, frozenset[int]] = {}
        self._lock = threading.Lock()
        self._subscriber = session.liveliness().declare_subscriber(
            claims_key(station, held_only=True), self._on_sample, history=True
        )

    def holders(self, sensor: str) -> frozenset[int]:
        """Session ids of the gateways that hold a sensor; empty = no gateway has announced it."""
        return self._holders.get(sensor, frozenset())

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                claim = self._claims.pop(key, None)
                if claim is None:
                    return
                sensor = claim[0]
            elif len(self._claims) >= MOST_CLAIMS:
                _log.warning("more than %d claims on sensors: %s is ignored", MOST_CLAIMS, key)
                return
            else:
                try:
                    announced = parse_claim_key(key)
                except WireError as error:
                    _log.warning("%s", error)
                    return
                sensor = announced.sensor
                self._claims[key] = sensor, announced.session_id
            # A token is replaced by a newer one of the same run when the serial becomes known.
            left = frozenset(run for name, run in self._claims.values() if name == sensor)
            if left:
                self._holders[sensor] = left
            else:
                self._holders.pop(sensor, None)

    def close(self) -> None:
        """Stop watching."""
        self.closed = True
        with contextlib.suppress(zenoh.ZError):  # the session is gone
            self._subscriber.undeclare()
