"""Roles on the bus: the table covers every key, and real sessions can do what it says, no more."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

pytest.importorskip("cryptography")

from tests.lab_router import make_certificates, router_of

from palpate.bus import Session
from palpate.bus.access import PUBLISHERS, QUESTIONS, Deed, rights
from palpate.bus.endpoints import ENDPOINTS
from palpate.bus.topics import STATION_ROOT, TOPICS, sensor_key, service_key
from palpate.config import LinkConfig, Role, RouterOptions, TlsConfig
from palpate.errors import ConfigError, LinkError

LIVE_S = 30.0
QUIET_S = 1.0
"""So long what must not arrive is waited for [s]; what is refused never comes, however long."""

HOLDERS = (Role.GATEWAY, Role.SERVICE, Role.ROBOT, Role.OPERATOR)
Lab = dict[Role, zenoh.Session]

FRAMES = sensor_key("lab", "finger", "electrodes")
ESTIMATES = sensor_key("lab", "finger", "features")
ROBOT = sensor_key("lab", "arm", "robot_pose")
TARE = sensor_key("lab", "finger", "tare")
MODELS = service_key("lab", "features", "features", "models")
STATUS = service_key("lab", "features", "features", "status")
OTHER = sensor_key("lab", "finger", "something_new")


def test_the_table_has_every_key_and_no_other() -> None:
    assert set(PUBLISHERS) == set(TOPICS)
    assert set(QUESTIONS) == set(ENDPOINTS)


def test_every_key_of_the_page_can_be_used_by_somebody() -> None:
    page = Path(__file__).parents[2] / "docs" / "asyncapi.md"
    rows = [
        line.split("|")[1].strip().strip("`")
        for line in page.read_text().splitlines()
        if line.startswith("| `palpate/")
    ]
    assert len(rows) >= len(TOPICS) + len(ENDPOINTS)
    allowed = [
        zenoh.KeyExpr(key)
        for role in HOLDERS
        for deed, keys in rights(role).items()
        if deed not in (Deed.SUBSCRIBE, Deed.WATCH)
        for key in keys
    ]
    of_router = rights(Role.ROUTER)[Deed.SHOW]
    for row in rows:
        key = row
        for name in ("alive", "held"):
            key = key.replace(f"<{name} or wanted>", name)
        while "<" in key:
            head, _, tail = key.partition("<")
            inside, _, tail = tail.partition(">")
            key = head + ("gateway" if inside == "service" and "@live" in head else "x") + tail
        if key.startswith(
            f"{STATION_ROOT}/"
        ):  # the name of a station: a router's claim, and nobody else's
            assert not any(one.includes(zenoh.KeyExpr(key)) for one in allowed), row
            assert any(zenoh.KeyExpr(one).includes(zenoh.KeyExpr(key)) for one in of_router), row
            continue
        assert any(one.includes(zenoh.KeyExpr(key)) for one in allowed), row


def test_only_operators_and_services_reach_what_changes_a_station() -> None:
    askers = {name: question.askers for name, question in QUESTIONS.items()}
    assert askers["models"] == askers["zero"] == {Role.OPERATOR}
    assert askers["tare"] == {Role.OPERATOR, Role.SERVICE}
    assert PUBLISHERS["electrodes"] == {Role.GATEWAY}
    assert PUBLISHERS["features"] == {Role.SERVICE}
    assert [name for name, who in PUBLISHERS.items() if Role.ROBOT in who] == ["robot_pose"]
    assert not [name for name, who in PUBLISHERS.items() if Role.OPERATOR in who]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("lab") / "certs")


@pytest.fixture(scope="module", params=["direct", "through the router"])
def lab(
    authority: Path, request: pytest.FixtureRequest, new_port: Callable[[], int]
) -> Iterator[Lab]:
    """A session of each role, and their router: with direct links, or none."""
    endpoint = f"tls/127.0.0.1:{new_port()}"
    direct = request.param == "direct"
    link = LinkConfig(
        connect=(endpoint,), certificates=authority, direct=direct, wait_for_router_s=LIVE_S
    )
    with contextlib.ExitStack() as opened:
        opened.enter_context(router_of(link, patience_s=LIVE_S))
        raw = {
            role: opened.enter_context(Session.open(link.as_role(role)))._raw for role in HOLDERS
        }
        others = len(HOLDERS) - 1 if direct else 0
        deadline = time.monotonic() + LIVE_S
        while any(len(one.info.peers_zid()) < others for one in raw.values()):
            assert time.monotonic() < deadline, "the direct links do not come up"
            time.sleep(0.05)
        yield raw


def _heard(lab: Lab, key: str) -> dict[Role, set[Role]]:
    """Who hears whom under a key, when everybody publishes there."""
    found: dict[Role, set[Role]] = {role: set() for role in lab}

    def hear(listener: Role) -> Callable[[zenoh.Sample], None]:
        return lambda sample: found[Role(sample.payload.to_string())].add(listener)

    subscribers = [one.declare_subscriber(key, hear(role)) for role, one in lab.items()]
    try:
        publishing = PUBLISHERS.get(key.rpartition("/")[2], frozenset())
        deadline = time.monotonic() + LIVE_S
        while True:
            for role, one in lab.items():
                one.put(key, role.value)
            if all(found[role] == set(lab) for role in publishing):
                break
            assert time.monotonic() < deadline, f"nobody hears {publishing} under {key}: {found}"
            time.sleep(0.1)
        time.sleep(QUIET_S)
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()
    return {role: listeners - {role} for role, listeners in found.items() if listeners - {role}}


@pytest.mark.parametrize(
    ("key", "publishers"),
    [
        (FRAMES, {Role.GATEWAY}),
        (ESTIMATES, {Role.SERVICE}),
        (ROBOT, {Role.ROBOT}),
        (TARE, {Role.GATEWAY}),
        (OTHER, set()),
        ("rt/chatter", set()),
    ],
)
def test_only_its_publishers_are_heard_under_a_key(
    lab: Lab, key: str, publishers: set[Role]
) -> None:
    heard = _heard(lab, key)
    assert set(heard) == publishers
    for role, listeners in heard.items():
        assert listeners == set(lab) - {role}


@pytest.mark.parametrize(
    ("key", "answerer", "askers"),
    [
        (TARE, Role.GATEWAY, {Role.SERVICE, Role.OPERATOR}),
        (TARE, Role.SERVICE, set()),
        (TARE, Role.ROBOT, set()),
        (MODELS, Role.SERVICE, {Role.OPERATOR}),
        (MODELS, Role.GATEWAY, set()),
        (MODELS, Role.OPERATOR, set()),
        (STATUS, Role.SERVICE, {Role.GATEWAY, Role.ROBOT, Role.OPERATOR}),
        (STATUS, Role.ROBOT, set()),
        (STATUS, Role.GATEWAY, set()),  # it may say only how gateways are
    ],
)
def test_only_some_ask_and_only_some_answer(
    lab: Lab, key: str, answerer: Role, askers: set[Role]
) -> None:
    def answers(role: Role) -> bool:
        replies = lab[role].get(key, timeout=LIVE_S)
        return any(reply.ok is not None for reply in replies)

    queryable = lab[answerer].declare_queryable(key, lambda query: query.reply(key, b"x"))
    try:
        deadline = time.monotonic() + LIVE_S
        while not all(map(answers, askers)):
            assert time.monotonic() < deadline
        time.sleep(QUIET_S)
        assert {role for role in lab if role is not answerer and answers(role)} == askers
    finally:
        queryable.undeclare()


@pytest.mark.parametrize(
    ("key", "shown_by"),
    [
        ("palpate/@v1/@live/lab/features/features/alive", {Role.SERVICE}),
        ("palpate/@v1/@live/lab/gateway/gateway/alive", {Role.GATEWAY, Role.SERVICE}),
        ("palpate/@v1/@sensor/lab/finger/held/0/1/gateway/x/x", {Role.GATEWAY}),
        ("palpate/@v1/@asking/lab/0123", {Role.ROBOT, Role.OPERATOR, Role.SERVICE}),
    ],
)
def test_only_some_show_a_token(lab: Lab, key: str, shown_by: set[Role]) -> None:
    for role in lab:
        token = lab[role].liveliness().declare_token(key)
        try:
            others = [one for other, one in lab.items() if other is not role]

            def seen(one: zenoh.Session) -> bool:
                return any(reply.ok is not None for reply in one.liveliness().get(key, timeout=5.0))

            deadline = time.monotonic() + LIVE_S
            while role in shown_by and not all(map(seen, others)):
                assert time.monotonic() < deadline, f"{role} is not seen"
            if role not in shown_by:
                time.sleep(QUIET_S)
                assert not any(map(seen, others)), f"{role} is seen"
        finally:
            token.undeclare()
        time.sleep(0.2)


def test_a_message_that_is_too_large_for_its_stream_is_dropped(lab: Lab) -> None:
    sizes: list[int] = []
    subscriber = lab[Role.GATEWAY].declare_subscriber(
        ROBOT, lambda sample: sizes.append(len(sample.payload))
    )
    try:
        deadline = time.monotonic() + LIVE_S
        while not sizes:
            lab[Role.ROBOT].put(ROBOT, b"x" * 1000)
            time.sleep(0.1)
            assert time.monotonic() < deadline
        for size in (100_000, 5 << 20):
            lab[Role.ROBOT].put(ROBOT, b"x" * size)
        time.sleep(QUIET_S)
        lab[Role.ROBOT].put(ROBOT, b"x" * 2000)
        while sizes[-1] != 2000:
            time.sleep(0.05)
            assert time.monotonic() < deadline
    finally:
        subscriber.undeclare()
    assert set(sizes) == {1000, 2000}


def test_links_with_roles_have_certificates_everywhere(authority: Path) -> None:
    link = LinkConfig(certificates=authority, connect=("tls/127.0.0.1:1",)).as_role(Role.ROBOT)
    assert link.listen == ("tls/127.0.0.1:0",)
    with pytest.raises(ValueError, match="whoever comes has no role"):
        LinkConfig(certificates=authority, listen=("tcp/127.0.0.1:0",))
    plain = LinkConfig(tls=TlsConfig.of_folder(authority / "robot"))
    with pytest.raises(ConfigError, match="shows no certificate"):
        Session.open(plain)
    with pytest.raises(ConfigError, match="this process has no role"):
        Session.open(LinkConfig(certificates=authority, connect=("tls/127.0.0.1:1",)))
    with pytest.raises(ConfigError, match="palpate certs issue makes it"):
        LinkConfig(certificates=authority / "none").as_role(Role.ROBOT)


def test_ros_needs_a_router_of_its_own(authority: Path) -> None:
    own = LinkConfig(certificates=authority, connect=("tls/127.0.0.1:1",)).as_role(Role.SERVICE)
    with pytest.raises(ConfigError, match="only what the roles of palpate"):
        RouterOptions().changed(own, roles=False)
    other = RouterOptions(
        connect="tls/127.0.0.1:2", tls=TlsConfig.of_folder(authority / "service")
    ).changed(own, roles=False)
    assert other.connect == ("tls/127.0.0.1:2",)
    assert not other.has_roles
    assert RouterOptions().changed(own) == own


_HALF = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"


@pytest.mark.parametrize("text", ["", "hello", _HALF, None], ids=["empty", "words", "half", "none"])
@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
def test_a_file_that_is_no_certificate_is_named(
    authority: Path, tmp_path: Path, name: str, text: str | None
) -> None:
    folder = shutil.copytree(authority / "robot", tmp_path / "robot")
    link = LinkConfig(connect=("tls/127.0.0.1:1",), tls=TlsConfig.of_folder(folder))
    (folder / name).unlink() if text is None else (folder / name).write_text(text)
    what = "private key" if name == "key.pem" else "certificate"
    with pytest.raises(ConfigError, match=rf"robot/{name} cannot be used as {what}: \w+") as caught:
        Session.open(link)
    assert "palpate certs issue" in caught.value.remedy


def test_a_key_of_another_certificate_is_named(authority: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(authority / "robot", tmp_path / "robot")
    shutil.copy(authority / "service" / "key.pem", folder)
    link = LinkConfig(connect=("tls/127.0.0.1:1",), tls=TlsConfig.of_folder(folder))
    with pytest.raises(ConfigError, match=r"robot/key.pem cannot be used as private key: .*match"):
        Session.open(link)


def test_an_error_of_zenoh_is_told_without_places_in_its_source(free_port: int) -> None:
    listen = (f"tcp/no-such-host.invalid:{free_port}",)
    link = LinkConfig(connect=()).model_copy(update={"listen": listen})
    with pytest.raises(LinkError, match="cannot join the bus: ") as caught:
        Session.open(link)
    assert ".rs:" not in str(caught.value)
