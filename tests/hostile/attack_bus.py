"""Attacks on a station by its links, by what a role may not do, and by commands."""

from __future__ import annotations

import datetime
import shutil
import socket
import ssl
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.x509.oid import NameOID
from tests.hostile.lab import LIVE_S, STATION, Heard, Lab, copy_of_bundle, raw
from tests.hostile.victim import Victim

from palpate.admin import new_nonce, signed
from palpate.bus import Session, endpoints
from palpate.bus.topics import SensorClaim, claim_key, sensor_key, service_key
from palpate.bus.zenoh_session import open_zenoh
from palpate.client.estimates import ask_tare
from palpate.client.models import ModelAdmin
from palpate.config import Role
from palpate.errors import PalpateError
from palpate.messages import ModelAction, ModelCommand, ModelInventory, ModelRequest
from palpate_deploy.station import certificates
from palpate_deploy.station.certificates import issue, make_authority
from palpate_deploy.station.host import free_endpoint

QUIET_S = 1.0
"""So long what must not arrive is waited for [s]."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an attack.

    Attributes:
        refused: Whether it had no effect.
        says: What the attacker was told.
        logged: Where the station tells of it: a line of a log or a counter; empty = nowhere.
        numbers: What was measured.
    """

    refused: bool
    says: str
    logged: str
    numbers: Mapping[str, float] = field(default_factory=dict)


# --- links ---------------------------------------------------------------------------------------


def no_certificate(lab: Lab) -> Outcome:
    """A stranger who trusts the lab's authority shows no certificate."""
    context = ssl.create_default_context(cafile=str(lab.certificates / "ca.pem"))
    return _handshake(lab, context, "peer sent no certificates")


def foreign_authority(lab: Lab) -> Outcome:
    """A stranger shows an operator's certificate of an authority of his own."""
    make_authority(lab.folder / "foreign")
    issue(lab.folder / "foreign", Role.OPERATOR)
    return _handshake(lab, _context(lab, lab.folder / "foreign" / "operator"), "invalid peer")


def expired(lab: Lab) -> Outcome:
    """An operator's certificate of the lab that ended yesterday."""
    then = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=31)
    with mock.patch.object(certificates, "_now", return_value=then):
        folder = issue(lab.certificates, Role.OPERATOR, "former", days=30)
    return _handshake(lab, _context(lab, folder), "invalid peer certificate")


def no_encryption(lab: Lab) -> Outcome:
    """A stranger speaks to the router without TLS."""
    since = len(lab.log("router"))
    with socket.create_connection(("127.0.0.1", lab.port), timeout=LIVE_S) as link:
        link.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with suppress(ConnectionError):
            says = link.recv(100)
    return Outcome(True, f"closed after {says!r}", lab.logged("router", "corrupt message", since))


def _context(lab: Lab, folder: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(lab.certificates / "ca.pem"))
    context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    return context


def _handshake(lab: Lab, context: ssl.SSLContext, words: str) -> Outcome:
    """Whether a TLS client gets a byte from the router; with TLS 1.3 it reads to be refused."""
    since = len(lab.log("router"))
    try:
        with (
            socket.create_connection(("127.0.0.1", lab.port), timeout=LIVE_S) as link,
            context.wrap_socket(link, server_hostname="localhost") as safe,
        ):
            safe.sendall(b"\x00" * 64)
            got = safe.recv(100)
        refused, says = not got, f"got {got!r}"
    except (ssl.SSLError, ConnectionError) as error:
        refused, says = True, str(error)
    return Outcome(refused, says, lab.logged("router", words, since))


def no_role(lab: Lab) -> Outcome:
    """A certificate of the lab's authority whose common name is no role."""
    folder = lab.certificates / "intern"
    if not folder.exists():
        _issue_without_role(lab, folder)
    since = len(lab.log("router"))
    with ExitStack() as stack:
        heard = [
            stack.enter_context(Heard(lab.operator, key))
            for key in (FRAMES, sensor_key(STATION, "arm", "robot_pose"))
        ]
        session = stack.enter_context(lab.join("intern", direct=False))
        read = stack.enter_context(Heard(session, FRAMES))
        for key in (FRAMES, sensor_key(STATION, "arm", "robot_pose")):
            raw(session).put(key, FORGED)
        told = list(raw(session).get(_status_key("features"), timeout=2.0))
        time.sleep(QUIET_S)
        quiet = not any(FORGED in one.payloads for one in heard)
        quiet = quiet and set(read.payloads) <= {FORGED}  # it hears itself
    says = "frames and answers: none"
    return Outcome(quiet and not told, says, lab.logged("router", "has no role", since))


def _issue_without_role(lab: Lab, folder: Path) -> None:
    """As ``issue`` does, with another common name."""
    shutil.copytree(lab.certificates / "robot", folder)
    authority, key = certificates._authority(lab.certificates)
    template = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "intern")]))
        .issuer_name(authority.subject)
        .public_key(template.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(template.not_valid_before_utc)
        .not_valid_after(template.not_valid_after_utc)
    )
    for one in template.extensions:
        builder = builder.add_extension(one.value, one.critical)
    made = builder.sign(key, hashes.SHA256())
    (folder / "cert.pem").write_bytes(certificates._public(made))


def only_loopback(lab: Lab) -> Outcome:
    """Whoever looks for an open door: where do the station's processes listen?"""
    found = [address for pid in lab.processes().values() for address in _listening(pid)]
    outside = [one for one in found if not one.startswith("127.")]
    says = f"{len(found)} listening sockets, {len(outside)} of them not on loopback"
    return Outcome(bool(found) and not outside, says, "not needed", {"sockets": len(found)})


def _listening(pid: int) -> Iterator[str]:
    """Addresses at which a process listens, as ``/proc`` tells."""
    inodes = set()
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            target = str(one.readlink())
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in inodes:
                host, _, port = words[1].partition(":")
                octets = [str(int(host[i : i + 2], 16)) for i in range(6, -1, -2)]
                yield f"{'.'.join(octets) if table == 'tcp' else host}:{int(port, 16)}"


def _joins_after_s(lab: Lab, endpoint: str) -> float:
    """How long a robot's session takes to join at an endpoint [s]."""
    began_s = time.monotonic()
    with lab.join("robot", direct=False, connect=(endpoint,)):
        return round(time.monotonic() - began_s, 1)


def half_open_links(lab: Lab) -> Outcome:
    """A stranger opens 200 connections to the router, says nothing on any, and hangs up."""
    with ExitStack() as stack:
        for _ in range(200):
            link = socket.socket()
            stack.callback(link.close)
            link.settimeout(2.0)
            with suppress(OSError):
                link.connect(("127.0.0.1", lab.port))
        before = lab.counter("features", "estimates_published")
        silent_s = _joins_after_s(lab, lab.outside)
    since = len(lab.log("router"))
    # Zenoh 1.10 waits for 0.1 s after each handshake that fails, before it accepts another one.
    numbers = {
        "joins_while_silent_s": silent_s,
        "joins_own_listener_s": _joins_after_s(lab, lab.endpoint),
        "joins_same_listener_s": _joins_after_s(lab, lab.outside),
    }
    says = "who has joined is not disturbed; who joins at the same listener waits"
    logged = lab.logged("router", "tls handshake eof", since)
    return Outcome(lab.goes_on(before), says, logged, numbers)


# --- roles ---------------------------------------------------------------------------------------

FORGED = b"forged"
FRAMES = sensor_key(STATION, "finger", "electrodes")


def _status_key(service: str) -> str:
    return service_key(STATION, service, service, "status")


def forging(holder: str, *streams: str) -> Callable[[Lab], Outcome]:
    def attack(lab: Lab) -> Outcome:
        # The same role hears itself: that the message left is shown so.
        keys = [sensor_key(STATION, "finger", stream) for stream in streams]
        with ExitStack() as stack:
            session = stack.enter_context(lab.join(holder))
            heard = [stack.enter_context(Heard(lab.operator, key)) for key in keys]
            time.sleep(QUIET_S)
            since = lab.lengths()
            for _ in range(20):
                for key in keys:
                    raw(session).put(key, FORGED)
                time.sleep(0.05)
            time.sleep(QUIET_S)
            reached = sum(one.payloads.count(FORGED) for one in heard)
            logged = lab.told_refused(holder, since)
        return Outcome(not reached, "nothing", logged, {"sent": 20 * len(keys), "heard": reached})

    attack.__doc__ = f"Whoever has the certificate of a {holder} publishes {', '.join(streams)}."
    return attack


def robot_tares(lab: Lab) -> Outcome:
    """A robot tares a finger."""
    key, since = sensor_key(STATION, "finger", "tare"), lab.lengths()
    with lab.robot() as robot, Heard(lab.operator, key) as tares:
        says = error_of(lambda: ask_tare(robot, "finger", frames=5, timeout_s=3.0))
        time.sleep(QUIET_S)
        # A gateway that was asked refuses, too, if the finger is touched: by a RemoteError.
        logged = lab.told_refused("robot", since)
        return Outcome(says.startswith("LinkError") and not tares.payloads, says, logged)


def robot_loads(lab: Lab) -> Outcome:
    """A robot that has stolen the admin token loads a model."""
    before, since = served(lab), lab.lengths()
    with lab.robot() as robot:
        thief = ModelAdmin(robot, lab.token)
        says = error_of(lambda: thief.load("features", "features-twin"))
        logged = lab.told_refused("robot", since)
    return Outcome(bool(says) and served(lab) == before, says, logged)


def robot_claims(lab: Lab) -> Outcome:
    """A robot shows an older claim on a finger, to make its gateway give it up."""
    claim = SensorClaim(STATION, "finger", 1, True, 1, "gateway", "thief", "X")
    before, since = lab.counter("features", "estimates_published"), lab.lengths()
    with lab.robot() as robot:
        token = raw(robot).liveliness().declare_token(claim_key(claim))
        time.sleep(3 * QUIET_S)
        after = lab.counter("features", "estimates_published")
        token.undeclare()
        logged = lab.told_refused("robot", since)
    given_up = "already published" in lab.log("gateway")[since["gateway"] :]
    fine = not given_up and after > before
    return Outcome(fine, "nothing", logged, {"estimates_meanwhile": after - before})


def robot_answers(lab: Lab) -> Outcome:
    """A robot answers in the place of the features service."""
    key, since = _status_key("features"), lab.lengths()
    with lab.robot() as robot:
        answer = raw(robot).declare_queryable(key, lambda query: query.reply(key, FORGED))
        time.sleep(QUIET_S)
        found = [
            reply.ok.payload.to_bytes()
            for reply in raw(lab.operator).get(key, timeout=5.0, target=zenoh.QueryTarget.ALL)
            if reply.ok is not None
        ]
        answer.undeclare()
        logged = lab.told_refused("robot", since)
    return Outcome(FORGED not in found, "nothing", logged, {"answers": len(found)})


def robot_routes(lab: Lab) -> Outcome:
    """A robot plays the router for a service that was sent there, and forges frames."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    with ExitStack() as stack:
        router = open_zenoh(lab.link("robot", connect=(), listen=(endpoint,)), "router")
        stack.callback(router.close)
        victim = stack.enter_context(Victim(lab.certificates / "service", endpoint, FRAMES))
        time.sleep(QUIET_S)
        for _ in range(10):
            router.put(FRAMES, FORGED)
        time.sleep(QUIET_S)
        heard, log = victim.end()
    logged = next((line for line in log if "refused: a message of" in line), "")
    return Outcome(not heard, "nothing", logged, {"sent": 10.0, "heard": float(heard)})


def served(lab: Lab) -> list[str]:
    found = ModelAdmin(lab.operator, lab.token).served("features")
    return [f"{one.name}:{one.version}" for answer in found for one in answer.served]


def error_of(call: Callable[[], object]) -> str:
    """The typed error of a call; empty = it succeeded."""
    try:
        call()
    except PalpateError as error:
        return f"{type(error).__name__}: {error.problem}"
    return ""


# --- commands ------------------------------------------------------------------------------------


def command(lab: Lab, *, wall_ns: int | None = None, bundle: str = "features-twin") -> ModelCommand:
    now = time.time_ns() if wall_ns is None else wall_ns
    return ModelCommand(ModelAction.LOAD, STATION, "features", new_nonce(), now, bundle=bundle)


def give(session: Session, request: ModelRequest) -> Sequence[ModelInventory | PalpateError]:
    return session.query_all(
        endpoints.MODELS, request, service="features", instance="features", timeout_s=LIVE_S
    )


def refused_command(lab: Lab, request: ModelRequest, counter: str = "commands_denied") -> Outcome:
    before, count = served(lab), lab.counter("features", counter)
    answers = give(lab.operator, request)
    says = "; ".join(
        f"{type(one).__name__} {one.code.name}: {one.problem}"
        for one in answers
        if isinstance(one, PalpateError)
    )
    refused = bool(says) and not any(isinstance(one, ModelInventory) for one in answers)
    lab.wait(lambda: lab.counter("features", counter) > count, f"{counter} counts")
    return Outcome(refused and served(lab) == before, says, f"counter features.{counter}")


def replayed_command(lab: Lab) -> Outcome:
    """The bytes of an operator's load command are sent again, by an operator's certificate."""
    request = signed(command(lab), lab.token)
    if not isinstance(give(lab.operator, request)[0], ModelInventory):
        raise AssertionError("the operator's own command is not obeyed")
    ModelAdmin(lab.operator, lab.token).roll_back("features")
    return refused_command(lab, request)


def replayed_by_robot(lab: Lab) -> Outcome:
    """The bytes of an operator's load command are sent again by a robot."""
    request = signed(command(lab), lab.token)
    give(lab.operator, request)
    ModelAdmin(lab.operator, lab.token).roll_back("features")
    before, since = served(lab), lab.lengths()
    with lab.robot() as robot:
        answers = give(robot, request)
        logged = lab.told_refused("robot", since)
    return Outcome(not answers and served(lab) == before, "no answer", logged)


def old_command(lab: Lab) -> Outcome:
    """A command that was signed 31 s ago, and held back."""
    return refused_command(
        lab, signed(command(lab, wall_ns=time.time_ns() - 31_000_000_000), lab.token)
    )


def altered_command(lab: Lab) -> Outcome:
    """A command whose bundle was changed after it was signed."""
    request = signed(command(lab), lab.token)
    return refused_command(
        lab, ModelRequest(request.command.replace(b"features-twin", b"features-evil"), request.mac)
    )


def operator_without_token(lab: Lab) -> Outcome:
    """An operator's certificate with a token of another station."""
    return refused_command(lab, signed(command(lab), b"\x01" * 32))


def bundle_by_path(lab: Lab) -> Outcome:
    """A command loads a bundle from a folder outside the repository."""
    made = copy_of_bundle(lab.fresh("outside"), "outside")
    return refused_command(
        lab, signed(command(lab, bundle=f"../../{made}"), lab.token), "commands_refused"
    )
