"""A virtual station with its page, in a browser: for the page's test and its picture."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib import image

from palpate.config import endpoint_host_port
from palpate_deploy.station.host import free_endpoint

STOP_S = 90.0

TAB = (1500, 1150)

SKIN = ((70, 420), (1010, 1490))
"""Rows and columns where the live view alone shows the estimated skin, in a tab of ``TAB``."""

_PROFILE = """
station = "lab"
processes = ["router", "gateway", "features", "field", "synthesis", "recorder"]
[router]
listen = ["{router}"]
[[gateway.sensors]]
name = "finger"
driver = "virtual"
options = {{ seed = 7, unit = "biotac-2" }}
[features]
bundle = "features-twin"
[recorder]
out = "{folder}/runs"
rrd = false
[web]
listen = "127.0.0.1:{port}"
"""


@dataclass(frozen=True)
class WebStation:
    """A station that runs: the address of its page, and its process."""

    address: str
    process: subprocess.Popen[bytes]

    def stop(self) -> None:
        """Stop it, as Ctrl-C does."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


@contextmanager
def web_station(folder: Path) -> Iterator[WebStation]:
    """The profile ``virtual`` on free ports, with ``palpate up --web``."""
    router, page = free_endpoint(), free_endpoint()
    _, port = endpoint_host_port(page)
    profile = folder / "lab.toml"
    text = _PROFILE.format(router=router, folder=folder, port=port)
    profile.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "palpate_deploy", "up", "--web", "--profile", str(profile)]
    with (folder / "up.log").open("wb") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    station = WebStation(f"http://127.0.0.1:{port}", process)
    try:
        yield station
    finally:
        station.stop()


def coloured(picture: bytes) -> float:
    """Share of the pixels of the estimated skin's picture that have a colour, not a grey."""
    pixels = _skin_of(picture)
    return float(np.mean(pixels.max(axis=2) - pixels.min(axis=2) > 0.25))


def shades(picture: bytes) -> int:
    """How many different colours the estimated skin's picture has."""
    return len(np.unique((255 * _skin_of(picture)).astype(np.uint8).reshape(-1, 3), axis=0))


def _skin_of(picture: bytes) -> npt.NDArray[np.float32]:
    """The estimated skin in a picture of a tab of ``TAB``, whatever its scale."""
    pixels: npt.NDArray[np.float32] = image.imread(io.BytesIO(picture))[..., :3]
    scale = pixels.shape[1] / TAB[0]
    rows, columns = (slice(*(round(scale * end) for end in ends)) for ends in SKIN)
    return pixels[rows, columns]
