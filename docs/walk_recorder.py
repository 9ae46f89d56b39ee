"""Record which product file calls which, while a flag file exists.

``make_walks.py`` starts every process of a station with this module in its ``sitecustomize``; each
then writes ``<pid>.json`` into the folder ``WALK_FOLDER``: thread -> call paths from file to
file, in the order of their first call.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("protos", "gateway", "services", "fem", "training", "deploy")
_PREFIXES = tuple(f"{ROOT / room}{os.sep}" for room in ROOMS)

_IDLE_S = 0.004
"""A thread is recorded from its first wake-up after a pause of this length, so that its paths begin
where its work on a frame begins [s]."""

CallPath = tuple[str, ...]
"""Product files from the start of a thread to a call, from outside to inside."""


class WalkRecorder:
    """Call paths of all threads of this process that start after :meth:`install`."""

    def __init__(self) -> None:
        self.active = False
        self._paths: dict[str, dict[CallPath, int]] = {}
        self._file_of: dict[str, str | None] = {}
        self._last_s: dict[str, float] = {}
        self._begun: set[str] = set()
        self._start_s = 0.0

    def install(self) -> None:
        """Watch this thread, and all that start from now on."""
        threading.setprofile(self._on_event)
        sys.setprofile(self._on_event)

    def clear(self) -> None:
        """Forget what was recorded."""
        for kept in (self._paths, self._last_s, self._begun):
            kept.clear()
        self._start_s = time.monotonic()

    def paths(self) -> dict[str, list[tuple[CallPath, int]]]:
        """Thread name -> call paths with their counts."""
        return {thread: list(paths.items()) for thread, paths in list(self._paths.items())}

    def _product_file(self, name: str) -> str | None:
        if name not in self._file_of:
            inside = name.startswith(_PREFIXES) and not name.endswith("_pb2.py")
            self._file_of[name] = os.path.relpath(name, ROOT) if inside else None
        return self._file_of[name]

    def _on_event(self, frame: FrameType, event: str, argument: Any) -> None:
        if not self.active or event != "call":
            return
        file = self._product_file(frame.f_code.co_filename)
        if file is None:
            return
        name = threading.current_thread().name
        now_s = time.monotonic()
        if name not in self._begun:
            if now_s - self._last_s.get(name, self._start_s) < _IDLE_S:
                self._last_s[name] = now_s
                return
            self._begun.add(name)
        path = [file]
        caller = frame.f_back
        while caller is not None:
            outer = self._product_file(caller.f_code.co_filename)
            if outer is not None and outer != path[-1]:
                path.append(outer)
            caller = caller.f_back
        while path and path[-1].startswith("deploy/"):  # the command that started the process
            path.pop()
        if not path:
            return
        thread = self._paths.setdefault(name, {})
        key = tuple(reversed(path))
        thread[key] = thread.get(key, 0) + 1


def record_this_process(folder: Path) -> None:
    """Record while ``folder/record`` exists; write the file of this process when it goes away."""
    recorder = WalkRecorder()
    recorder.install()
    flag = folder / "record"

    def follow_flag() -> None:
        while True:
            time.sleep(0.02)
            wanted = flag.exists()
            if recorder.active and not wanted:
                recorder.active = False
                entry = {"command": sys.orig_argv[1:], "threads": recorder.paths()}
                part = folder / f"{os.getpid()}.part"
                part.write_text(json.dumps(entry), encoding="utf-8")
                part.rename(folder / f"{os.getpid()}.json")
            elif wanted and not recorder.active:
                recorder.clear()
                recorder.active = True

    threading.Thread(target=follow_flag, name="walk recorder", daemon=True).start()


if "WALK_FOLDER" in os.environ:
    record_this_process(Path(os.environ["WALK_FOLDER"]))
