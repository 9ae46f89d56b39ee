"""The files of Rerun's viewer for browsers: they are inside its program, which serves them once."""

from __future__ import annotations

import contextlib
import gzip
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path

from palpate.heartbeat import without_watch

_log = logging.getLogger(__name__)

VIEWER_FILES = ("re_viewer.js", "re_viewer_bg.wasm")
"""The names of the files: the program (43 MB) and its loader."""

START_S = 60.0
"""How long Rerun's program may take until it serves [s]; on an idle machine half a second."""

AGAIN_S = 10.0
"""After a failure the next attempt begins so much later at the earliest [s]."""

_POLL_S = 0.2
_ANSWER_S = 60.0
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
_LEVEL = 5  # of gzip: 43 MB become 13 MB within two seconds


class ViewerFiles:
    """The files of Rerun's viewer, compressed with gzip; fetched in a thread at the first question.

    Rerun's program listens on loopback meanwhile, for a second or two, and then ends. It finds a
    home without settings, in which it has been told to report nothing to its makers.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._files: Mapping[str, bytes] | None = None
        self._problem = ""
        self._thread: threading.Thread | None = None
        self._failed_s = float("-inf")

    def find(self, name: str) -> bytes | None:
        """A file, compressed with gzip; None while it is being fetched, see ``problem``.

        Raises:
            KeyError: There is no file of this name.
        """
        if name not in VIEWER_FILES:
            raise KeyError(name)
        with self._lock:
            if self._files is not None:
                return self._files[name]
            if self._thread is None and time.monotonic() - self._failed_s >= AGAIN_S:
                self._thread = threading.Thread(target=self._fetch, name="viewer", daemon=True)
                self._thread.start()
        return None

    @property
    def problem(self) -> str:
        """Why the last attempt that has ended failed; empty = none has. Questions try again."""
        with self._lock:
            return self._problem

    def _fetch(self) -> None:
        files, problem = None, ""
        try:
            files = fetch_viewer_files()
        except Exception as error:  # whatever it is, the page goes on without a live view
            problem = f"Rerun's viewer cannot be served: {error}"
            _log.warning("%s", problem)
        with self._lock:
            self._files, self._problem, self._thread = files, problem, None
            self._failed_s = time.monotonic()


def fetch_viewer_files() -> dict[str, bytes]:
    """Let Rerun's program serve the files of its viewer; each is compressed with gzip.

    Raises:
        OSError: It does not serve; the text says why.
    """
    with tempfile.TemporaryDirectory() as folder, _served(Path(folder)) as address:
        found = {}
        for name in VIEWER_FILES:
            with _DIRECT.open(f"{address}/{name}", timeout=_ANSWER_S) as answer:
                found[name] = gzip.compress(answer.read(), _LEVEL)
        return found


@contextlib.contextmanager
def _served(home: Path) -> Iterator[str]:
    # -P: no module may come from the working directory.
    command = [sys.executable, "-P", "-m", "rerun_cli"]
    environment = {**without_watch(os.environ), "HOME": str(home), "XDG_CONFIG_HOME": str(home)}
    log = home / "log"
    subprocess.run(
        [*command, "analytics", "disable"],
        env=environment,
        capture_output=True,
        timeout=START_S,
        check=False,
    )
    page, data = _free_port(), _free_port()
    places = ("--bind", "127.0.0.1", "--web-viewer-port", str(page), "--port", str(data))
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*command, "--serve-web", *places],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        address = f"http://127.0.0.1:{page}"
        _wait_for(address, process, log)
        yield address
    finally:
        # A Python that starts the program and waits for it: the group is both.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, 9)
        process.wait()


def _wait_for(address: str, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline_s = time.monotonic() + START_S
    while True:
        try:
            _DIRECT.open(address, timeout=_ANSWER_S).close()
        except OSError:
            if process.poll() is not None or time.monotonic() > deadline_s:
                said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
                raise OSError(said[-1] if said else "its program does not start") from None
            time.sleep(_POLL_S)
        else:
            return


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
