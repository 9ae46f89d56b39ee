"""The robot's client for asyncio."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, cast

import pytest
from tests.protos.robot_client import (
    CALLS,
    LIVE_S,
    Finger,
    WaitUntil,
    public_names,
    simulation_request,
)

from palpate import AsyncClient, Client
from palpate.bus import Cancellation, Session, endpoints
from palpate.client.aio import _AT_ONCE
from palpate.config import LinkConfig
from palpate.errors import (
    ConfigError,
    LinkError,
    SensorChanged,
    StaleError,
    StreamTimeout,
)
from palpate.messages import (
    FeatureRequest,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SynthesisRequest,
    Tare,
    TareRequest,
)


def test_every_method_of_the_client_is_there_for_asyncio() -> None:
    assert public_names(Client) - {"close"} <= public_names(AsyncClient)


@pytest.mark.parametrize("name", ["alive", "features", "tare"])
def test_an_async_client_whose_session_is_closed_says_so(
    link: LinkConfig, examples: dict[str, Any], name: str
) -> None:
    async def call() -> object:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            robot.sync.close()
            return await cast("Coroutine[Any, Any, object]", CALLS[name](robot, examples))

    with pytest.raises(LinkError, match="closed"):
        asyncio.run(call())


def test_an_async_client_streams_asks_and_leaves_the_loop_free(
    link: LinkConfig, finger: Finger, examples: dict[str, Any]
) -> None:
    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            seen: list[int] = []
            async for estimate in robot.stream_features("finger", max_age_s=LIVE_S):
                seen.append(estimate.source.sequence)
                if len(seen) == 3:
                    break
            assert seen == sorted(set(seen))
            estimate = await robot.features("finger", max_age_s=LIVE_S)
            assert estimate.force.tolist() == examples["FeatureEstimate"].force.tolist()
            with pytest.raises(LinkError, match="no gateway has a BioTac of this name"):
                await robot.tare("nobody")
            with pytest.raises(ConfigError):
                await robot.features("*")
            turns = 0

            async def count() -> None:
                nonlocal turns
                while True:
                    await asyncio.sleep(0.005)
                    turns += 1

            counting = asyncio.create_task(count())
            with pytest.raises(StreamTimeout):
                await robot.next_features("nobody", timeout_s=0.5)
            counting.cancel()
            assert turns >= 3, "the loop ran while the call waited"
        with pytest.raises(LinkError, match="async with"):
            await robot.features("finger")

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_an_async_stream_says_that_it_is_silent_and_goes_on(
    link: LinkConfig, finger: Finger
) -> None:
    async def scene() -> None:
        async with (
            AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot,
            robot.stream_features("finger", max_age_s=LIVE_S, timeout_s=0.3) as stream,
        ):
            await anext(stream)
            finger.silent = True
            with pytest.raises(StreamTimeout):
                [_ async for _ in stream]
            finger.silent = False
            while True:
                try:
                    await anext(stream)
                except StreamTimeout:
                    continue
                break
            await stream.aclose()
            with pytest.raises(StopAsyncIteration):
                await anext(stream)

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_an_async_stream_delivers_nothing_that_grew_old_while_its_task_was_busy(
    link: LinkConfig, finger: Finger
) -> None:
    async def scene() -> None:
        async with (
            AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot,
            robot.stream_features("finger", max_age_s=0.2, timeout_s=2.0) as stream,
        ):
            await anext(stream)
            while not stream.counters["skipped"]:  # one waits for the task
                await asyncio.sleep(0.01)
            finger.silent = True
            await asyncio.sleep(0.5)  # and is too old now
            before = finger.sequence
            with pytest.raises(StaleError):
                await anext(stream)
            finger.silent = False
            assert (await anext(stream)).source.sequence > before
            assert stream.counters["stale"] > 0

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_an_async_stream_tells_of_another_sensor_though_its_task_is_slow(
    link: LinkConfig, finger: Finger
) -> None:
    async def scene() -> None:
        async with (
            AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot,
            robot.stream_features("finger", max_age_s=LIVE_S) as stream,
        ):
            await anext(stream)
            finger.serial = "BT-OTHER"
            skipped = stream.counters["skipped"]
            while stream.counters["skipped"] < skipped + 20:  # enough to push it out
                await asyncio.sleep(0.05)
            with pytest.raises(SensorChanged):
                await anext(stream)
            assert (await anext(stream)).sensor_serial == "BT-OTHER"

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_a_stream_whose_first_reader_gives_up_is_opened_once(
    link: LinkConfig, finger: Finger, wait_until: WaitUntil
) -> None:
    def threads() -> list[threading.Thread]:
        return [one for one in threading.enumerate() if one.name == "palpate callback"]

    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            stream = robot.stream_features("finger", max_age_s=LIVE_S, depth=50)
            for _ in range(3):
                reading = asyncio.create_task(anext(stream))
                await asyncio.sleep(0)
                reading.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await reading
            together = await asyncio.gather(anext(stream), anext(stream))
            sequences = [estimate.source.sequence for estimate in together]
            async for estimate in stream:
                sequences.append(estimate.source.sequence)
                if len(sequences) == 50:
                    break
            assert sequences == sorted(set(sequences)), "each comes once"
            assert len(threads()) == 1
            # One that is closed before it is open leaves nothing behind.
            late = robot.stream_features("finger", max_age_s=LIVE_S)
            reading = asyncio.create_task(anext(late))
            await asyncio.sleep(0)
            await late.aclose()
            with pytest.raises(StopAsyncIteration):
                await reading
            await stream.aclose()
            await asyncio.to_thread(wait_until, lambda: not threads(), timeout_s=LIVE_S)

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


async def _begun(
    ask: Callable[[], Coroutine[Any, Any, object]], begun: threading.Event
) -> asyncio.Task[object]:
    """A question that has reached its service, which may not be known here at first."""
    while True:
        asking = asyncio.create_task(ask())
        while not asking.done():
            if begun.is_set():
                return asking
            await asyncio.sleep(0.01)
        assert isinstance(asking.exception(), LinkError)


def test_cancelling_a_task_ends_its_question_and_its_stream(
    link: LinkConfig, finger: Finger, examples: dict[str, Any], wait_until: WaitUntil
) -> None:
    begun, go = threading.Event(), threading.Event()

    def handler(_: TareRequest) -> Tare:
        begun.set()
        go.wait(LIVE_S)
        tare: Tare = examples["Tare"]
        return tare

    async def scene(session: Session) -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            asking = await _begun(lambda: robot.tare("slow", timeout_s=600.0), begun)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking

            async def listen() -> None:
                async for _ in robot.stream_features("nobody", timeout_s=None):
                    raise AssertionError

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0.1)
            listening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await listening

    with Session.open(link) as session:
        session.queryable(endpoints.TARE, handler, sensor="slow")
        asyncio.run(asyncio.wait_for(scene(session), 3 * LIVE_S))
        go.set()
    wait_until(
        lambda: not [one for one in threading.enumerate() if one.name.startswith("palpate c")],
        timeout_s=LIVE_S,
    )


def test_calls_that_take_all_threads_are_cancelled() -> None:
    begun: list[Cancellation] = []
    cancelled: list[bool] = []

    def call() -> None:
        cancellation = Cancellation.current()
        assert cancellation is not None
        begun.append(cancellation)
        cancelled.append(cancellation.cancelled.wait(LIVE_S))

    async def scene() -> None:
        robot = AsyncClient()
        calls = [asyncio.create_task(robot.in_thread(call)) for _ in range(_AT_ONCE)]
        while len(begun) < _AT_ONCE:
            await asyncio.sleep(0.01)
        for one in calls:
            one.cancel()
        while len(cancelled) < _AT_ONCE:
            await asyncio.sleep(0.01)
        await robot.aclose()

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))
    assert all(cancelled), "none ends by its own time"


@pytest.mark.parametrize("name", ["next_features", "features"])
def test_waits_for_estimates_that_are_cancelled_give_their_threads_back(
    link: LinkConfig, finger: Finger, name: str
) -> None:
    """Each kept its thread until its own time, and after 32 of them every call hung."""

    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=60 * LIVE_S) as robot:

            def wait() -> Coroutine[Any, Any, object]:
                if name == "features":
                    return robot.features("nobody")
                return robot.next_features("nobody", timeout_s=60 * LIVE_S)

            waits = [asyncio.create_task(wait()) for _ in range(_AT_ONCE)]
            await asyncio.sleep(0.2)
            for one in waits:
                one.cancel()
            estimate = await robot.features("finger", max_age_s=LIVE_S)
            assert estimate.source.sequence > 0

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_a_stream_ends_whose_client_is_closed_underneath(link: LinkConfig, finger: Finger) -> None:
    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            stream = robot.stream_features("finger", max_age_s=LIVE_S)
            await anext(stream)
            await asyncio.to_thread(robot.sync.close)
            [_ async for _ in stream]
            assert stream.closed
            with pytest.raises(StopAsyncIteration):
                await anext(stream)

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_a_client_whose_calls_take_all_threads_opens_streams_and_can_be_closed(
    link: LinkConfig, finger: Finger
) -> None:
    goes_on = threading.Event()

    async def scene() -> None:
        async with AsyncClient(link.connect[0]) as robot:
            begun: list[None] = []

            def call() -> None:
                begun.append(None)
                goes_on.wait(LIVE_S)

            calls = [asyncio.create_task(robot.in_thread(call)) for _ in range(_AT_ONCE)]
            while len(begun) < _AT_ONCE:
                await asyncio.sleep(0.01)
            await anext(robot.stream_features("finger", max_age_s=LIVE_S))
            await robot.aclose()
            assert not any(one.done() for one in calls), "none had to end before"
            calls[0].cancel()
            with pytest.raises(asyncio.CancelledError):
                await calls[0]
            goes_on.set()
            await asyncio.gather(*calls[1:])

    asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_a_simulation_reports_into_the_loop_and_is_stopped_with_its_task(
    link: LinkConfig, wait_until: WaitUntil
) -> None:
    """The answering side only knows the caller's token, as the finite-element service does."""
    gone, begun = threading.Event(), threading.Event()

    def simulate(request: SimulationRequest, answer: Any) -> None:
        for done in range(3):
            progress = SimulationProgress(request.request_id, done, 3, 0.1)
            answer.send(
                SimulationReply(request.request_id, bytes(32), (), progress=progress, more=True)
            )
        if request.request_id == "endless":
            begun.set()
            return
        answer.send(SimulationReply(request.request_id, bytes(32), ()))
        answer.end()

    async def scene() -> None:
        loop = asyncio.get_running_loop()
        steps: list[int] = []

        def on_progress(progress: SimulationProgress) -> None:
            assert asyncio.get_running_loop() is loop
            steps.append(progress.steps_done)

        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            request = simulation_request()
            while not steps:
                with suppress(LinkError):  # the service is not known here yet
                    await robot.simulate(request, on_progress=on_progress)
            assert steps == [0, 1, 2]
            endless = dataclasses.replace(request, request_id="endless")
            asking = await _begun(lambda: robot.simulate(endless, timeout_s=600.0), begun)
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            assert await asyncio.to_thread(gone.wait, LIVE_S), "the service hears of it"

    with Session.open(link) as session:
        session.watch_callers(lambda *_: gone.set() if begun.is_set() else None)
        session.stream_queryable(endpoints.SIMULATE, simulate, sensor="twin")
        asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_functions_of_a_call_are_called_in_the_loop(
    link: LinkConfig, examples: dict[str, Any]
) -> None:
    part = examples["SynthesisReply"]

    def synthesise(_: SynthesisRequest, answer: Any) -> None:
        answer.send(part)
        answer.send(dataclasses.replace(part, more=False))
        answer.end()

    def estimate(_: FeatureRequest, answer: Any) -> None:
        answer.send(examples["FeatureEstimate"], timings=examples["StageTimings"])
        answer.end()

    async def scene() -> None:
        loop = asyncio.get_running_loop()
        told: list[str] = []

        def tell(what: object) -> None:
            assert asyncio.get_running_loop() is loop
            told.append(type(what).__name__)

        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            await robot.synthesise_from(examples["FieldFrame"], on_step=tell)
            await robot.estimate_features("finger", examples["ElectrodeFrame"], on_timings=tell)
        assert told == ["SynthesisReply", "StageTimings"]

    with Session.open(link) as session:
        session.stream_queryable(
            endpoints.SYNTHESISE_FROM, synthesise, service="synthesis", instance="one"
        )
        session.stream_queryable(
            endpoints.ESTIMATE_FEATURES, estimate, service="features", instance="one"
        )
        asyncio.run(asyncio.wait_for(scene(), 3 * LIVE_S))


def test_joining_without_a_router_fails_and_may_be_cancelled(
    free_port: int, wait_until: WaitUntil
) -> None:
    async def scene() -> None:
        with pytest.raises(LinkError, match="no router"):
            async with AsyncClient(f"tcp/127.0.0.1:{free_port}", timeout_s=0.2):
                pass
        joining = asyncio.create_task(
            AsyncClient(f"tcp/127.0.0.1:{free_port}", timeout_s=1.0).__aenter__()
        )
        await asyncio.sleep(0.1)
        joining.cancel()
        with pytest.raises(asyncio.CancelledError):
            await joining

    asyncio.run(asyncio.wait_for(scene(), LIVE_S))
    wait_until(
        lambda: not [one for one in threading.enumerate() if one.name.startswith("palpate c")],
        timeout_s=LIVE_S,
    )


def test_one_that_could_not_join_or_has_left_may_join_again(
    link: LinkConfig, free_port: int, finger: Finger
) -> None:
    """Its threads had ended: a RuntimeError about futures was all that it said."""

    async def scene() -> None:
        lonely = AsyncClient(f"tcp/127.0.0.1:{free_port}", timeout_s=0.2)
        for _ in range(2):
            with pytest.raises(LinkError, match="no router"):
                async with lonely:
                    pass
        robot = AsyncClient(link.connect[0], timeout_s=LIVE_S)
        for _ in range(2):
            async with robot:
                await robot.features("finger", max_age_s=LIVE_S)
                await anext(robot.stream_features("finger", max_age_s=LIVE_S))
            with pytest.raises(LinkError, match="async with"):
                await robot.features("finger")

    asyncio.run(asyncio.wait_for(scene(), 5 * LIVE_S))


@pytest.mark.parametrize("depth", [0, -1])
def test_a_stream_that_would_keep_nothing_is_refused(link: LinkConfig, depth: int) -> None:
    async def scene() -> None:
        async with AsyncClient(link.connect[0], timeout_s=LIVE_S) as robot:
            with pytest.raises(ConfigError, match="keeps nothing"):
                robot.stream_features("finger", depth=depth)

    asyncio.run(asyncio.wait_for(scene(), LIVE_S))
