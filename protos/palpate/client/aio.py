"""The client for asyncio: the same calls with ``await``, streams with ``async for``.

Built on ``Client``: each call runs in a thread of a pool, each stream in one of its own, so that
nothing blocks the event loop. Cancelling a task cancels its question at the service's side, too,
and stops its simulation.
"""

from __future__ import annotations

import asyncio
import functools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar

from palpate.bus import Cancellation, ReceivedMessage
from palpate.bus.zenoh_session import check_process, is_inherited
from palpate.client.robot import Client
from palpate.client.streams import Stream, Watch, check_depth
from palpate.config import TlsConfig
from palpate.errors import LinkError, PalpateError, SensorChanged, StaleError, StreamTimeout

M = TypeVar("M")
P = ParamSpec("P")
R = TypeVar("R")

_AT_ONCE = 32
"""Calls that run at the same time; more wait for a thread."""


class AsyncStream(Generic[M]):
    """A ``Stream`` for ``async for``: newest wins, errors are raised, and it goes on after them."""

    def __init__(self, client: AsyncClient, stream: Callable[[], Stream[M]], depth: int) -> None:
        self._client = client
        self._make = stream
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        self._lock = threading.Lock()
        self._items: deque[ReceivedMessage[M] | PalpateError] = deque(maxlen=depth)
        # Told once: no newer message may push it out.
        self._changed: SensorChanged | None = None
        self._skipped = 0
        self._stale = 0
        self._stream: Stream[M] | None = None
        self._watch: Watch[M] | None = None
        self._opening: asyncio.Task[None] | None = None
        self._closed = False
        self._ended = False

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._closed or self._ended

    @property
    def counters(self) -> dict[str, int]:
        """Those of the stream, and ``skipped`` messages that the task was too slow for.

        ``stale`` has those, too, that grew too old while they waited for the task.
        """
        counters = {} if self._watch is None else self._watch.counters
        stale = counters.get("stale", 0) + self._stale
        return {**counters, "stale": stale, "skipped": self._skipped}

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> M:
        """The next message; see ``Stream.__next__``."""
        check_process()
        if self._watch is None and not self._closed:
            await self._opened()
        stream = self._stream
        end_s = time.monotonic() + (math.inf if stream is None else stream.timeout_s)
        item: ReceivedMessage[M] | PalpateError | None
        stale: StaleError | None = None
        while not self._closed:
            with self._lock:
                item = None
                if self._changed is not None:
                    item, self._changed = self._changed, None
                elif self._items:
                    item = self._items.popleft()
                elif self._ended:
                    break
                else:
                    self._arrived.clear()
            if item is None:
                await self._arrived.wait()
            elif isinstance(item, PalpateError):
                raise stale if stale and isinstance(item, StreamTimeout) else item
            else:
                assert stream is not None, "its message is here"
                try:
                    stream.check_age(item)  # it has waited here
                except StaleError as error:
                    self._stale += 1
                    stale = error
                    if time.monotonic() >= end_s:
                        raise
                else:
                    return item.message
        raise StopAsyncIteration

    async def _opened(self) -> None:
        """Wait until it is open. Whoever waits may be cancelled: the opening goes on, once."""
        if self._opening is None or self._opening.done():
            self._opening = asyncio.create_task(self._open())
        await asyncio.shield(self._opening)

    async def _open(self) -> None:
        def watch() -> Watch[M]:
            self._stream = stream = self._make()

            def offer(_: M) -> None:
                if stream.newest is not None:
                    self._offer(stream.newest)

            return Watch(stream, offer, self._offer, self._end)

        self._watch = await self._client.promptly(watch)
        if self._closed:  # meanwhile
            await self._client.promptly(self._watch.close)

    def _offer(self, item: ReceivedMessage[M] | PalpateError) -> None:
        with self._lock:
            wake = not self._items
            if isinstance(item, SensorChanged):
                self._skipped += len(self._items)
                self._items.clear()  # of the one before
                self._changed = item
            else:
                self._skipped += len(self._items) == self._items.maxlen
                self._items.append(item)
        if wake:
            self._wake()

    def _end(self) -> None:
        """The client was closed: nothing comes after what waits here."""
        with self._lock:
            self._ended = True
        self._wake()

    def _wake(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._arrived.set)
        except RuntimeError:  # the loop is closed, and nobody waits any more
            self._closed = True

    async def aclose(self) -> None:
        """End the iteration."""
        if self._closed:
            return
        self._closed = True
        self._arrived.set()
        if self._watch is not None:
            await self._client.promptly(self._watch.close)
        elif self._opening is not None:
            await asyncio.wait({self._opening})  # it closes what it opens

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.aclose()


def _awaitable(
    method: Callable[Concatenate[Client, P], R],
) -> Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, R]]:
    """The same method of ``AsyncClient``."""

    @functools.wraps(method)
    async def call(client: AsyncClient, /, *args: P.args, **options: P.kwargs) -> R:
        sync = client.sync
        loop = asyncio.get_running_loop()
        for name, option in options.items():
            if name.startswith("on_") and callable(option):
                options[name] = functools.partial(loop.call_soon_threadsafe, option)
        return await client.in_thread(lambda: method(sync, *args, **options))

    return call


def _streaming(
    method: Callable[Concatenate[Client, P], Stream[M]],
) -> Callable[Concatenate[AsyncClient, P], AsyncStream[M]]:
    """The same stream of ``AsyncClient``."""

    @functools.wraps(method)
    def call(client: AsyncClient, /, *args: P.args, **options: P.kwargs) -> AsyncStream[M]:
        depth = options.get("depth", 1)
        assert isinstance(depth, int)
        check_depth(depth)
        sync = client.sync
        stream = AsyncStream(client, lambda: method(sync, *args, **options), depth)
        client.keep(stream)
        return stream

    return call


class AsyncClient:
    """A robot's view of a station, for asyncio; the methods are those of ``Client``.

    Five lines::

        async with AsyncClient() as robot:
            async for estimate in robot.stream_features("finger"):
                print(estimate.force)

    A stream stays open, with a thread that takes each message, until it or the client is closed:
    before a ``break`` write ``async with robot.stream_features("finger") as estimates:`` around the
    loop.

    Arguments are those of ``Client``; the bus is joined by ``async with``, and may be again after
    it was left or could not be joined. Functions that a method
    takes (``on_step``, ``on_progress``, ``on_timings``) are called in the event loop.
    """

    def __init__(
        self,
        connect: str | None = None,
        *,
        station: str | None = None,
        timeout_s: float = 2.0,
        tls: TlsConfig | Path | str | None = None,
    ) -> None:
        self._open = functools.partial(
            Client, connect, station=station, timeout_s=timeout_s, tls=tls
        )
        self._client: Client | None = None
        self._streams: list[AsyncStream[Any]] = []
        self._start_threads()

    features = _awaitable(Client.features)
    electrodes = _awaitable(Client.electrodes)
    field = _awaitable(Client.field)
    synthesis = _awaitable(Client.synthesis)
    next_features = _awaitable(Client.next_features)
    estimate_features = _awaitable(Client.estimate_features)
    estimate_field = _awaitable(Client.estimate_field)
    field_basis = _awaitable(Client.field_basis)
    synthesise_from = _awaitable(Client.synthesise_from)
    synthesise = _awaitable(Client.synthesise)
    tare = _awaitable(Client.tare)
    zero = _awaitable(Client.zero)
    cancel_simulation = _awaitable(Client.cancel_simulation)
    simulate = _awaitable(Client.simulate)
    robot_pose_publisher = _awaitable(Client.robot_pose_publisher)
    model = _awaitable(Client.model)
    alive = _awaitable(Client.alive)
    status = _awaitable(Client.status)
    census = _awaitable(Client.census)

    stream_features = _streaming(Client.stream_features)
    stream_electrodes = _streaming(Client.stream_electrodes)
    stream_field = _streaming(Client.stream_field)
    stream_synthesis = _streaming(Client.stream_synthesis)
    stream_wrench = _streaming(Client.stream_wrench)

    @property
    def sync(self) -> Client:
        """The client that does the work.

        Raises:
            LinkError: The bus has not been joined, or has been left.
        """
        if self._client is None:
            raise LinkError(
                "the client has not joined the bus", remedy="use it inside `async with`"
            )
        return self._client

    async def in_thread(self, work: Callable[[], R]) -> R:
        """The result of ``work``, run in a thread; cancelling cancels the question it asks."""
        check_process()  # a forked process has none of the pool's threads
        cancellation = Cancellation()

        def run() -> R:
            with cancellation:
                return work()

        future = asyncio.get_running_loop().run_in_executor(self._threads, run)
        try:
            return await future
        except asyncio.CancelledError:
            with suppress(RuntimeError):  # closed: the question ended with the client
                self._canceller.submit(cancellation.cancel)
            raise

    async def promptly(self, work: Callable[[], R]) -> R:
        """The result of ``work``, which waits for no answer, also while calls take all threads."""
        check_process()
        return await asyncio.get_running_loop().run_in_executor(self._canceller, work)

    def keep(self, stream: AsyncStream[Any]) -> None:
        """Close this stream with the client."""
        self._streams = [one for one in self._streams if not one.closed]
        self._streams.append(stream)

    async def aclose(self) -> None:
        """Leave the bus; streams end. In a forked process nothing happens."""
        if is_inherited():
            return
        for stream in self._streams:
            await stream.aclose()
        client, self._client = self._client, None
        if client is not None:
            await self.promptly(client.close)
        self._end_threads()

    def _start_threads(self) -> None:
        self._threads = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="palpate call")
        # Of its own, for what waits for no answer: calls that do may have all of the others.
        self._canceller = ThreadPoolExecutor(1, thread_name_prefix="palpate cancel")

    def _end_threads(self) -> None:
        for threads in (self._threads, self._canceller):
            threads.shutdown(wait=False)

    async def __aenter__(self) -> Self:
        self._start_threads()  # it may have failed to join before, or have left
        opening = self._threads.submit(self._open)
        try:
            self._client = await asyncio.shield(asyncio.wrap_future(opening))
        except asyncio.CancelledError:
            opening.add_done_callback(_close_client)
            raise
        finally:
            if self._client is None:
                self._end_threads()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.aclose()


def _close_client(opened: Future[Client]) -> None:
    """Leave the bus that was joined for a task that has been cancelled."""
    if opened.exception() is None:
        opened.result().close()
