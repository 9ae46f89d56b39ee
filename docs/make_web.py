"""Draw ``docs/pictures/web.png``: the page of a virtual station while its finger is touched.

``python docs/make_web.py``; needs Chromium, and takes about a minute.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # where tests/ is

from tests.deploy.browser import Browser, chromium
from tests.deploy.web_station import coloured, web_station

PICTURE = Path(__file__).parent / "pictures" / "web.png"

_SIZE = (1500, 1250)
_PATIENCE_S = 300.0
_TOUCHED = 0.02
"""Share of coloured pixels in the skin's part of the page from which on it is surely touched."""

_BUSY_S = 40.0
"""Curves of so many seconds are in the picture [s]."""


def main() -> None:
    """Draw it; an exit with a message if it cannot be drawn."""
    program = chromium()
    if program is None:
        sys.exit("there is no Chromium")
    deadline_s = time.monotonic() + _PATIENCE_S
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        with (
            web_station(Path(folder)) as station,
            Browser(program, Path(folder) / "chromium", size=_SIZE) as browser,
        ):
            while not browser.evaluate("document.getElementById('whole') !== null"):
                browser.open(f"{station.address}/#with-live-view")
                time.sleep(1.0)
            time.sleep(_BUSY_S)
            picture = browser.picture()
            while coloured(picture) < _TOUCHED:
                if time.monotonic() > deadline_s:
                    sys.exit("the skin takes no colour")
                time.sleep(0.3)
                picture = browser.picture()
    PICTURE.write_bytes(picture)


if __name__ == "__main__":
    main()
