"""Claims on sensors: one gateway publishes under a key, whatever starts, ends or stands still."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from palpate import clock
from palpate.bus import SensorClaims, Session, run_router
from palpate.bus.claims import SETTLE_S, YIELD_S
from palpate.bus.topics import CLAIM_ROOT, SensorClaim, claim_key
from palpate.config import LinkConfig
from palpate.errors import ClaimedElsewhere, SensorTaken

PATIENCE_S = 20.0
LEASE_S = 2.0

HOLDER = """
import sys, time
from palpate.bus import Session
from palpate.config import LinkConfig
endpoint, session_id = sys.argv[1], int(sys.argv[2])
with Session.open(LinkConfig(connect=(endpoint,), wait_for_router_s=60)) as session:
    claims = session.claims(session_id=session_id, instance="child", lease_s=2.0)
    claims.want("finger")
    before = None
    while True:
        held = claims.wait("finger", 0.02)
        if held is not before:
            before = held
            print("held" if held else "not held", flush=True)
"""


@contextmanager
def claims_of(link: LinkConfig, session_id: int) -> Iterator[SensorClaims]:
    with Session.open(link) as session:
        claims = session.claims(
            session_id=session_id, instance=f"gateway-{session_id}", lease_s=LEASE_S
        )
        claims.want("finger")
        yield claims


def held_within_patience(claims: SensorClaims) -> bool:
    return claims.wait("finger", PATIENCE_S)


def refusal_of(claims: SensorClaims) -> ClaimedElsewhere:
    deadline = time.monotonic() + PATIENCE_S
    while (refusal := claims.refusal("finger")) is None:
        assert time.monotonic() < deadline, "it was not refused"
        time.sleep(0.01)
    return refusal


class KnowsNobody:
    """The Zenoh session of a peer whose links to others have not come up."""

    def __init__(self, session: Any) -> None:
        self._session = session

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def liveliness(self) -> Any:
        return SimpleNamespace(get=lambda *_, **__: iter(()))


def test_holders_are_known_though_links_to_them_come_up_late(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was old enough to know them, and looked at its own view alone: nobody held anything."""
    monkeypatch.setattr("palpate.bus.link._YOUNG_S", 0.0)
    with claims_of(link, 20) as claims, Session.open(link) as looking:
        assert held_within_patience(claims)
        monkeypatch.setattr(looking, "_raw", KnowsNobody(looking._raw))
        deadline = time.monotonic() + PATIENCE_S
        while not (found := looking.holders(CLAIM_ROOT, "finger")):
            assert time.monotonic() < deadline, "nobody holds it"
            time.sleep(0.01)
        assert [one.instance for one in found] == ["gateway-20"]


def test_the_second_is_refused_and_told_who_is_first(link: LinkConfig) -> None:
    with claims_of(link, 20) as first, ExitStack() as stack:
        assert held_within_patience(first)
        # The lower session id decides only between two that both wait.
        other = stack.enter_context(claims_of(link, 10))
        first.name_serial("finger", "BT 0001/#2")
        deadline = time.monotonic() + PATIENCE_S
        while "BT 0001/#2" not in str(refusal_of(other)) and time.monotonic() < deadline:
            time.sleep(0.01)
        text = str(refusal_of(other))
        for part in ("'finger'", "'lab'", "BT 0001/#2", "'gateway-20'", os.uname().nodename):
            assert part in text
        assert not other.wait("finger", 0.5)
        with pytest.raises(SensorTaken):
            other.check("finger")
        first.check("finger")


def test_one_that_waits_takes_over_and_other_sensors_are_free(link: LinkConfig) -> None:
    with ExitStack() as stack:
        first = stack.enter_context(claims_of(link, 1))
        assert held_within_patience(first)
        with claims_of(link, 2) as second:
            refusal_of(second)
            second.want("thumb")
            assert second.wait("thumb", PATIENCE_S)
            assert not second.wait("finger", 0.0)
            stack.close()
            assert held_within_patience(second)
            second.check("finger")


@pytest.mark.parametrize("count", [2, 5])
def test_of_some_that_start_at_one_instant_exactly_one_holds(link: LinkConfig, count: int) -> None:
    with ExitStack() as stack:
        sessions = [stack.enter_context(Session.open(link)) for _ in range(count)]
        barrier = threading.Barrier(count)
        claims: dict[int, SensorClaims] = {}

        def start(number: int) -> None:
            barrier.wait()
            made = sessions[number].claims(
                session_id=100 - number, instance=f"g{number}", lease_s=LEASE_S
            )
            made.want("finger")
            claims[number] = made

        threads = [threading.Thread(target=start, args=(k,)) for k in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        # The lowest session id.
        assert held_within_patience(claims[count - 1])
        for number in range(count - 1):
            assert not claims[number].wait("finger", 0.0)
            assert "session 000000000000006" in str(refusal_of(claims[number])) or count == 2


@contextmanager
def child(link: LinkConfig, session_id: int) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, link.connect[0], str(session_id)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()


def says(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_a_killed_holder_is_followed(link: LinkConfig) -> None:
    with child(link, 1) as first:
        while says(first) != "held":
            pass
        with claims_of(link, 2) as second:
            assert "'child'" in str(refusal_of(second))
            first.kill()
            assert held_within_patience(second)


def test_a_frozen_holder_is_followed_and_does_not_come_back(link: LinkConfig) -> None:
    with child(link, 1) as first:
        while says(first) != "held":
            pass
        with claims_of(link, 2) as second:
            refusal_of(second)
            first.send_signal(signal.SIGSTOP)
            assert held_within_patience(second)
            first.send_signal(signal.SIGCONT)
            assert says(first) == "not held"
            # It would have to yield within this time, if the other insisted.
            time.sleep(1.5)
            second.check("finger")
            assert "'child'" not in str(second.refusal("finger"))
        # Only now it gets the sensor back.
        assert says(first) == "held"


def test_a_stall_of_this_process_alone_costs_no_claim(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with claims_of(link, 1) as claims:
        assert held_within_patience(claims)
        with claims._changed:
            claims._alive_s -= 2 * LEASE_S
        claims.check("finger")  # looks again, and holds again


def test_a_claim_is_given_up_and_begun_again_after_the_host_slept(
    link: LinkConfig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Others have seen its lease end meanwhile."""
    true_ns, slept_ns = clock.since_boot_ns, 0
    monkeypatch.setattr(clock, "since_boot_ns", lambda: true_ns() + slept_ns)
    with claims_of(link, 1) as claims:
        assert held_within_patience(claims)
        assert "stood still" not in caplog.text
        slept_ns = round(2e9 * LEASE_S)
        claims.check("finger")  # looks again, and holds again
        assert "stood still" in caplog.text


@pytest.mark.parametrize("older", [True, False])
def test_of_two_that_could_not_see_each_other_the_older_holds(
    link: LinkConfig, older: bool
) -> None:
    """As after the router was away: both hold, and then they meet."""
    other = SensorClaim("lab", "finger", 5, True, 1 if older else 2**62)
    with claims_of(link, 9) as claims, Session.open(link) as met:
        assert held_within_patience(claims)
        token = met._raw.liveliness().declare_token(claim_key(other))
        if older:
            assert "session 0000000000000005" in str(refusal_of(claims))
            with pytest.raises(SensorTaken):
                claims.check("finger")
            token.undeclare()
            assert held_within_patience(claims)
        else:
            time.sleep(3 * YIELD_S)
            claims.check("finger")
            assert claims.refusal("finger") is None


@pytest.mark.parametrize("flooded", ["s{}", "thumb"], ids=["not-wanted", "wanted"])
def test_a_flood_of_claims_is_bounded_and_hides_no_holder(
    link: LinkConfig,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    flooded: str,
) -> None:
    """They were all kept, and looked through many times a second with the lock.

    And one sensor was held by two gateways, if the flood was on another that the second wanted.
    """
    most, flood = 20, 60
    monkeypatch.setattr("palpate.bus.claims.MOST_CLAIMS", most)

    def wait_until_ignored(count: int) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while sum("is ignored" in one.getMessage() for one in caplog.records) < count:
            assert time.monotonic() < deadline, "none was ignored"
            time.sleep(0.01)

    with Session.open(link) as invents, ExitStack() as stack:
        for number in range(flood):  # each comes before the holder of the finger
            claim = SensorClaim("lab", flooded.format(number), 1000 + number, True, 1)
            invents.foreign_token(claim_key(claim))
        first = stack.enter_context(claims_of(link, 2**62))
        assert held_within_patience(first)
        wait_until_ignored(flood - most)
        caplog.clear()
        session = stack.enter_context(Session.open(link))
        other = session.claims(session_id=1, instance="other", lease_s=LEASE_S)
        wait_until_ignored(flood + 1 - most)
        assert not any(one.sensor == "finger" for one in other._others.values())
        other.want("thumb")
        other.want("finger")
        assert f"session {2**62:016x}" in str(refusal_of(other))
        assert not other.wait("finger", 5 * SETTLE_S)
        assert other.refusal("finger") is not None
        assert len(other._others) <= most
        first.check("finger")


def test_without_a_link_nothing_is_taken(free_port: int) -> None:
    alone = LinkConfig(connect=(f"tcp/127.0.0.1:{free_port}",))
    with claims_of(alone, 1) as claims:
        assert not claims.wait("finger", 1.0)
        assert claims.refusal("finger") is None


@contextmanager
def router_at(endpoint: str) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_router, args=((endpoint,), stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.parametrize("direct", [True, False])
def test_a_router_that_is_started_again_moves_no_claim(free_port: int, direct: bool) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    link = LinkConfig(connect=(endpoint,), wait_for_router_s=PATIENCE_S, direct=direct)
    with ExitStack() as stack:
        router = stack.enter_context(ExitStack())
        router.enter_context(router_at(endpoint))
        first = stack.enter_context(claims_of(link, 2))
        assert held_within_patience(first)
        second = stack.enter_context(claims_of(link, 1))
        refusal_of(second)
        for _ in range(2):
            router.close()
            assert not second.wait("finger", 1.0)
            router.enter_context(router_at(endpoint))
            assert not second.wait("finger", 3.0)
            assert first.wait("finger", 0.0)
            first.check("finger")
            refusal_of(second)
