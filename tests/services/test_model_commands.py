"""Commands to a running service: who may give them, and that no frame is lost by one."""

from __future__ import annotations

import itertools
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate import codec
from palpate.admin import read_token, signed, token_file
from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import ELECTRODES, FEATURES, TARE
from palpate.client.models import ModelAdmin
from palpate.config import LinkConfig
from palpate.errors import BundleError, ConfigError, ErrorCode, LinkError, RemoteError
from palpate.files.bundle import read_bundle
from palpate.messages import (
    ElectrodeFrame,
    ModelAction,
    ModelCommand,
    ServiceRequest,
    ServiceState,
    Status,
    Tare,
)
from palpate_services.config import FeaturesServiceConfig, ModelsConfig
from palpate_services.inference.estimates import estimate
from palpate_services.inference.model import load
from palpate_services.inference.services import run_estimating

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]


@pytest.fixture
def kept(tmp_path: Path, make_bundle: Callable[..., Path], recipe: Any) -> ModelsConfig:
    """A repository with x:1 and x:2, which give other estimates, and the broken x:3."""
    folder = tmp_path / "models" / "x"
    folder.mkdir(parents=True)
    for version, threshold_n in ((1, 0.0), (2, 500.0)):
        made = make_bundle(name="x", version=version, contact_threshold_n=threshold_n)
        shutil.copytree(made, folder / str(version))
    shutil.copytree(make_bundle(recipe(poison=True), name="x", version=3), folder / "3")
    return ModelsConfig(folder=tmp_path / "models", state=tmp_path / "state")


Serve = Callable[..., AbstractContextManager[Session]]


@pytest.fixture
def serve(kept: ModelsConfig, link: LinkConfig, until: Until) -> Serve:
    """Run the features service while the block runs; the block gets a session of its own."""

    @contextmanager
    def running(models: ModelsConfig | None = kept, **config: Any) -> Iterator[Session]:
        stop = threading.Event()
        settings = FeaturesServiceConfig(
            **{"bundle": "x:1", "max_age_s": 20.0, "unannounced": True, **config}
        )
        node = threading.Thread(
            target=run_estimating, args=(settings, link, "lab", stop), kwargs={"models": models}
        )
        node.start()
        try:
            with Session.open(link) as session:
                until(lambda: any(a.ready for a in session.alive()))
                yield session
        finally:
            stop.set()
            node.join(timeout=20)
        assert not node.is_alive()

    return running


@pytest.fixture
def admin(kept: ModelsConfig) -> Callable[[Session], ModelAdmin]:
    return lambda session: ModelAdmin(session, read_token(token_file(kept.memory_folder, "lab")))


Admin = Callable[[Session], ModelAdmin]


def status_of(session: Session) -> Status:
    return session.query(endpoints.STATUS, ServiceRequest(), service="features", timeout_s=5.0)


def test_list_load_unload_and_roll_back(serve: Serve, admin: Admin, until: Until) -> None:
    with serve() as session:
        operator = admin(session)
        (inventory,) = operator.served("features")
        assert inventory.instance == "features"
        assert inventory.available[-3:] == ("x:1", "x:2", "x:3")
        assert [(s.name, s.version) for s in inventory.served] == [("x", 1)]
        (inventory,) = operator.load("features", "x:2", sensor="thumb")
        assert [(s.sensor, s.version) for s in inventory.served] == [("", 1), ("thumb", 2)]
        metadata = session.query(endpoints.MODEL, ServiceRequest(), service="features")
        assert metadata.served == inventory.served
        assert "thumb x:2" in status_of(session).message
        operator.unload("features", sensor="thumb")
        operator.roll_back("features", sensor="thumb")
        operator.unload("features")
        (inventory,) = operator.roll_back("features")
        assert [(s.sensor, s.version) for s in inventory.served] == [("", 1), ("thumb", 2)]
        until(lambda: status_of(session).counters.get("commands_obeyed") == 6)
        with pytest.raises(LinkError, match="no service 'field'"):
            operator.load("field", "x:2")


def test_a_broken_bundle_leaves_the_old_one_serving(serve: Serve, admin: Admin) -> None:
    with serve() as session:
        operator = admin(session)
        with pytest.raises(RemoteError, match="NaN or infinite") as caught:
            operator.load("features", "x:3")
        assert caught.value.code is BundleError.code
        with pytest.raises(RemoteError, match=r"x:9.*available: .*x:2") as caught:
            operator.load("features", "x:9")
        assert caught.value.code is ConfigError.code
        (inventory,) = operator.served("features")
        assert inventory.served[0].version == 1
        assert status_of(session).counters["commands_refused"] == 2


def test_without_the_token_nothing_is_told_or_changed(
    serve: Serve, admin: Admin, until: Until
) -> None:
    with serve() as session:
        stranger = ModelAdmin(session, bytes(32))
        orders: list[Callable[[], object]] = [
            lambda: stranger.served("features"),
            lambda: stranger.load("features", "x:2"),
            lambda: stranger.unload("features"),
            lambda: stranger.roll_back("features"),
        ]
        for order in orders:
            with pytest.raises(RemoteError) as caught:
                order()
            assert caught.value.code is ErrorCode.PERMISSION_DENIED
            assert "x:1" not in str(caught.value)
        until(lambda: status_of(session).counters.get("commands_denied") == 4)
        assert admin(session).served("features")[0].served[0].version == 1


def test_an_overheard_command_is_not_obeyed_again(
    serve: Serve, kept: ModelsConfig, admin: Admin
) -> None:
    with serve() as session:
        token = read_token(token_file(kept.memory_folder, "lab"))
        command = ModelCommand(
            ModelAction.LOAD, "lab", "features", bytes(16), time.time_ns(), bundle="x:2"
        )
        request = signed(command, token)
        session.query(endpoints.MODELS, request, service="features", timeout_s=20)
        admin(session).roll_back("features")
        with pytest.raises(RemoteError, match="already obeyed"):
            session.query(endpoints.MODELS, request, service="features", timeout_s=20)
        assert admin(session).served("features")[0].served[0].version == 1


def test_a_service_without_a_state_takes_no_commands(
    serve: Serve, make_bundle: Callable[..., Path]
) -> None:
    with serve(models=None, bundle=str(make_bundle())) as session:
        with pytest.raises(RemoteError) as caught:
            ModelAdmin(session, bytes(32)).served("features")
        assert caught.value.code is ErrorCode.PERMISSION_DENIED


def test_a_restarted_service_serves_what_was_loaded(serve: Serve, admin: Admin) -> None:
    with serve() as session:
        admin(session).load("features", "x:2")
    with serve() as session:
        assert admin(session).served("features")[0].served[0].version == 2


def test_a_bundle_that_is_gone_degrades_the_service_until_another_is_loaded(
    serve: Serve, kept: ModelsConfig, admin: Admin, until: Until
) -> None:
    with serve() as session:
        admin(session).load("features", "x:2")
    shutil.rmtree(kept.repository_folder / "x" / "2")
    with serve() as session:
        until(lambda: status_of(session).state is ServiceState.DEGRADED)
        status = status_of(session)
        assert status.last_error is not None
        assert "'x:2' is not in the repository" in status.last_error.message
        with pytest.raises(RemoteError, match="no bundle serves"):
            session.query(endpoints.MODEL, ServiceRequest(), service="features")
        admin(session).load("features", "x:1")
        until(lambda: status_of(session).state is ServiceState.READY)
        assert status_of(session).models == ("x:1",)


def test_no_frame_is_lost_and_no_estimate_mixed_while_bundles_change(
    serve: Serve,
    kept: ModelsConfig,
    admin: Admin,
    make_frame: Frames,
    make_tare: Callable[..., Tare],
    until: Until,
) -> None:
    """Every frame gets exactly the estimate that one of the two bundles makes of it."""
    tare = make_tare()
    runtimes = {
        found.sha256: load(found, "features")
        for found in (read_bundle(kept.repository_folder / "x" / version) for version in "12")
    }
    with serve(delivery="every") as session:
        session.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
        session.publisher(TARE, sensor="finger").put(tare)
        estimates = session.subscriber(FEATURES, delivery=Delivery.QUEUE)
        sender = session.publisher(ELECTRODES, sensor="finger", lossless=True)
        operator, done = admin(session), threading.Event()
        served: Counter[bytes] = Counter()
        first, second = runtimes

        def wait_for_a_frame_of(bundle: bytes) -> None:
            before = served[bundle]
            until(lambda: served[bundle] > before)

        def change() -> None:
            try:
                for _ in range(4):
                    operator.load("features", "x:2")
                    wait_for_a_frame_of(second)
                    operator.roll_back("features")
                    wait_for_a_frame_of(first)
            finally:
                done.set()

        changing = threading.Thread(target=change)
        changing.start()
        for number in itertools.count(1):  # however long the changes take
            frame = make_frame(number)
            sender.put(frame)
            got = estimates.next(20.0)
            served[got.message.bundle_sha256] += 1
            wanted = estimate(frame, tare, runtimes[got.message.bundle_sha256])
            assert got.payload == codec.FEATURE_ESTIMATE.encode(wanted)  # type: ignore[arg-type]
            if done.is_set():
                break
            time.sleep(0.005)
        changing.join(60)
        assert min(served[first], served[second]) >= 4, "both served while frames came"
