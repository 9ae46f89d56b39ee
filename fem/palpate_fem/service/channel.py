"""Processes of our own, and the channel between them: large arrays go through shared memory.

A result of 20 steps has 20 MB. Written into shared memory, of which only the descriptor is sent, it
costs each end 8 ms, where a pipe costs 30 to 60. The memory has no name, so nothing is left behind
when all processes are killed.
"""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import logging
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

_log = logging.getLogger(__name__)

SMALL_BYTES = 1 << 16
"""Arrays below this size are sent as they are."""

_ALIGNMENT = 64
_END_WAIT_S = 5.0
_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


class Channel:
    """One end of a socket that carries Python values both ways; one thread sends, one receives.

    Args:
        descriptor: Of the socket; the channel closes it.
    """

    def __init__(self, descriptor: int) -> None:
        self._connection = Connection(descriptor)
        self._socket = socket.fromfd(descriptor, socket.AF_UNIX, socket.SOCK_STREAM)

    def send(self, message: object) -> None:
        """Send a value that can be pickled.

        Raises:
            OSError: The other end is closed, or there is no memory.
        """
        large: list[pickle.PickleBuffer] = []

        def is_small(buffer: pickle.PickleBuffer) -> bool:
            if buffer.raw().nbytes < SMALL_BYTES:
                return True
            large.append(buffer)
            return False

        head = pickle.dumps(message, protocol=5, buffer_callback=is_small)
        views = [buffer.raw() for buffer in large]
        memory = _shared(views) if views else None
        try:
            sizes = [view.nbytes for view in views]
            self._connection.send_bytes(pickle.dumps((sizes, head), protocol=5))
            if memory is not None:
                socket.send_fds(self._socket, [b"m"], [memory])
        finally:
            if memory is not None:
                os.close(memory)

    def receive(self) -> Any:
        """The next value; its arrays are the receiver's own.

        Raises:
            EOFError: The other end is closed.
            OSError: Likewise.
            MemoryError: There is no memory; the next value cannot be received either.
        """
        sizes, head = pickle.loads(self._connection.recv_bytes())
        if not sizes:
            return pickle.loads(head)
        _, descriptors, _, _ = socket.recv_fds(self._socket, 1, 1)
        if not descriptors:
            raise EOFError
        places = _places(sizes)
        try:
            # Not mapped: a mapping would keep a descriptor open for as long as the value is kept.
            memory = np.empty(places[-1] + sizes[-1], np.uint8).data
            done = 0
            while done < len(memory):
                more = os.preadv(descriptors[0], [memory[done:]], done)
                if not more:
                    raise EOFError
                done += more
        finally:
            os.close(descriptors[0])
        return pickle.loads(
            head,
            buffers=[memory[at : at + size] for at, size in zip(places, sizes, strict=True)],
        )

    def shut(self) -> None:
        """Let nothing pass any more: who receives at either end finds the other closed."""
        with contextlib.suppress(OSError):  # it is
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close this end."""
        self._socket.close()
        self._connection.close()


def _places(sizes: Sequence[int]) -> list[int]:
    """Where each array begins."""
    places, at = [], 0
    for size in sizes:
        places.append(at)
        at += -(-size // _ALIGNMENT) * _ALIGNMENT
    return places


def _shared(views: Sequence[memoryview]) -> int:
    """Descriptor of new memory without a name that holds these arrays."""
    if sys.platform == "linux":
        memory = os.memfd_create("palpate")
    else:
        with tempfile.TemporaryFile() as file:
            memory = os.dup(file.fileno())
    try:
        for view, at in zip(views, _places([view.nbytes for view in views]), strict=True):
            while view:
                done = os.pwrite(memory, view, at)
                view, at = view[done:], at + done
    except BaseException:
        os.close(memory)
        raise
    return memory


class Outbox:
    """Sends messages in order from a thread of its own, so that nobody waits who has one.

    Args:
        channel: Where they go.
        on_broken: Called once, from that thread, when a message cannot be sent: the other end is
            closed, or memory or descriptors have run out.
    """

    def __init__(self, channel: Channel, on_broken: Callable[[], None] = lambda: None) -> None:
        self._channel, self._on_broken = channel, on_broken
        self._messages: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._send, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: object) -> None:
        """Send a message, which must not be None."""
        self._messages.put(message)

    def close(self) -> None:
        """Wait until all is sent, or the other end is closed."""
        self._messages.put(None)
        self._thread.join()

    def _send(self) -> None:
        while (message := self._messages.get()) is not None:
            try:
                self._channel.send(message)
            except Exception as error:
                if not isinstance(error, OSError):  # a defect, e.g. what cannot be pickled
                    sys.excepthook(type(error), error, error.__traceback__)
                self._on_broken()
                return


class ChildProcess:
    """A process that runs a module of ours, and ends with this one.

    Not ``multiprocessing.Process``: that imports the caller's main script again in the child, so
    the script would have to be written for it (``if __name__ == "__main__"``). The child ends when
    its socket closes, which the kernel does for a process that was killed.

    Args:
        module: Its ``main`` calls `channel_to_parent`.
        first: First message to it.
        threads: Threads that its libraries may use.
        on_message: Called with this object and each message, from a thread of its own.
        on_gone: Called with this object once, from that thread, when it has ended.

    Raises:
        OSError: There is no memory for it, or there are too many processes, threads or descriptors.
    """

    def __init__(
        self,
        module: str,
        first: object,
        *,
        threads: int,
        on_message: Callable[[Any, Any], None],
        on_gone: Callable[[Any], None],
    ) -> None:
        self._killed = False
        self._on_message = on_message
        self._on_gone = on_gone
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                env={**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))},
            )
        self._channel = Channel(ours.detach())
        # A message that cannot be sent would be waited for without end: the process is ended.
        self._reader = threading.Thread(target=self._read, name=f"child {self.pid}", daemon=True)
        try:
            self._outbox = Outbox(self._channel, self._channel.shut)
            self.send(first)
            self._reader.start()
        except RuntimeError as error:  # of threading
            self._process.kill()
            self._process.wait()
            self._channel.shut()
            raise OSError(errno.EAGAIN, "no thread can be started") from error

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def send(self, message: object) -> None:
        """Send it a message; lost if it has ended, of which the reader tells."""
        self._outbox.put(message)

    def kill(self) -> None:
        """End it now."""
        self._killed = True
        self._process.kill()

    def join(self) -> None:
        """Wait until it has ended."""
        self._reader.join(_END_WAIT_S)

    def how_it_ended(self) -> str:
        """The end of an error message, e.g. ``ended with exit status 7``."""
        status = self._process.poll()
        if self._killed:
            return "was ended because it did not stop by itself"
        if status is None:
            return "lost its connection"
        if status >= 0:
            return f"ended with exit status {status}"
        name = signal.Signals(-status).name
        hint = " (out of memory?)" if -status == signal.SIGKILL else ""
        return f"was ended by {name}{hint}"

    def _read(self) -> None:
        while True:
            try:
                self._on_message(self, self._channel.receive())
            except (EOFError, OSError):
                break
            except Exception:  # out of memory, or a defect: it cannot be heard any more
                _log.exception("a message of process %d is lost", self.pid)
                break
        # The status of one that has ended by itself is its own; one that still runs is of no use.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.1)
        self._process.kill()
        self._process.wait()
        self._outbox.close()
        self._channel.close()
        self._on_gone(self)


def channel_to_parent() -> Channel:
    """Prepare a process that a `ChildProcess` has started; its channel."""
    # Libraries print remarks to stdout, but a command's stdout may be JSON for machines.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    faulthandler.enable()
    # Whoever stops a command may signal its whole group. The process that started us handles that;
    # we end when it does.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return Channel(int(sys.argv[1]))
