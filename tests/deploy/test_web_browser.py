"""The page of a virtual station as a person sees it: in headless Chromium."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest
from tests.deploy.browser import Browser, chromium
from tests.deploy.web_station import TAB, WebStation, coloured, shades, web_station

pytest.importorskip("waitress", reason="waitress not installed (extra web)")
pytest.importorskip("rerun", reason="rerun-sdk not installed (extra services)")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="chromium not installed"),
]

PATIENCE_S = 240.0
WaitUntil = Callable[[Callable[[], bool], float, str], float]


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    program = chromium()
    assert program is not None
    with Browser(program, tmp_path / "chromium", size=TAB, scale=0.5) as opened:
        yield opened


@pytest.fixture
def station(tmp_path: Path) -> Iterator[WebStation]:
    with web_station(tmp_path) as running:
        yield running


def text(browser: Browser, element: str) -> str:
    return str(browser.evaluate(f"document.getElementById('{element}')?.innerText ?? ''"))


def open_when_served(browser: Browser, address: str, element: str, wait_until: WaitUntil) -> None:
    def there() -> bool:
        browser.open(address)
        return bool(browser.evaluate(f"document.getElementById('{element}') !== null"))

    wait_until(there, PATIENCE_S, f"{address} is served")


def test_a_person_sees_a_station_that_runs_and_is_told_when_it_does_not(
    station: WebStation, browser: Browser, wait_until: WaitUntil
) -> None:
    open_when_served(browser, station.address, "whole", wait_until)
    wait_until(lambda: "live" in text(browser, "sensors").split(), PATIENCE_S, "finger is live")
    wait_until(lambda: "8 of 8 processes well" in text(browser, "whole"), PATIENCE_S, "all well")
    sensor = text(browser, "sensors").splitlines()[1]
    assert sensor.split()[0] == "finger"
    assert "recording to" in text(browser, "recordings")
    assert "features-twin:" in text(browser, "processes")
    assert text(browser, "alarm") == ""
    # Links from process to process outlive the router: nothing of what is below is old.
    with urlopen(f"{station.address}/api/status", timeout=PATIENCE_S) as answer:
        status = json.dumps(json.load(answer) | {"router": False})
    said, kind = browser.evaluate(
        f"(show({status}), [at('alarm').textContent, document.body.className])"
    )
    assert said.startswith("What is below still comes, but the router is gone.")
    assert "old" not in kind
    station.stop()
    wait_until(lambda: "does not answer" in text(browser, "alarm"), PATIENCE_S, "it is told")


def test_the_skin_takes_colour_when_it_is_touched_and_loses_it_afterwards(
    station: WebStation, browser: Browser, wait_until: WaitUntil
) -> None:
    open_when_served(browser, f"{station.address}/live", "say", wait_until)
    wait_until(lambda: text(browser, "say") == "", PATIENCE_S, "the first picture is there")
    seen: list[float] = []
    most_shades = 0

    def touched_and_not() -> bool:
        nonlocal most_shades
        picture = browser.picture()
        seen.append(coloured(picture))
        most_shades = max(most_shades, shades(picture))
        later = seen[seen.index(max(seen)) :]
        return max(seen) > 0.1 and min(later) < 0.01

    wait_until(touched_and_not, PATIENCE_S, f"the skin takes and loses colour: {seen}")
    assert most_shades > 300  # a shaded body, no blank picture
    asked = " ".join(browser.console)
    assert "EvalError" not in asked
