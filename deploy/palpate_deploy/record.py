"""``palpate record``: one more recorder for a station that runs."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Mapping
from types import FrameType
from typing import Any

from palpate.bus import Session
from palpate.config import LinkConfig, parse_config
from palpate_deploy.files import print_contents
from palpate_services import recorder
from palpate_services.config import RecorderConfig


def record_station(
    link: LinkConfig, station: str, settings: Mapping[str, Any], *, duration_s: float
) -> None:
    """Record until ``duration_s`` have passed (0 = Ctrl-C), then print what was recorded.

    Raises:
        LinkError: There is no router.
        ConfigError: An unknown topic.
        RecordingError: The folder cannot be made.
    """
    config = parse_config(RecorderConfig, settings, where="command line")
    Session.open(link, station=station).close()  # say at once that there is no router
    before = set(config.out.glob("*.mcap"))
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    if duration_s:
        timer = threading.Timer(duration_s, stop.set)
        timer.daemon = True
        timer.start()
    until = f"for {duration_s:g} s" if duration_s else "until Ctrl-C"
    print(f"recording station {station} to {config.out}/ {until}", flush=True)
    recorder.run(config, link, station, stop, instance=f"record-{os.getpid()}")
    for path in sorted(set(config.out.glob("*.mcap")) - before):
        print_contents(path)
