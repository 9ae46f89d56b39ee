"""The scripts of the page, run by Node beside a server that fails: what a person sees of it."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

import pytest

from palpate.census import ProcessReport
from palpate.messages import SensorState, SensorStatus, ServiceState, Status
from palpate_deploy.station.observation import ObservedProcess
from palpate_deploy.station.web.snapshot import PROCESSES_MOST, as_json, snapshot

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="node not installed")

PATIENCE_S = 120.0
PAGE = files("palpate_deploy.station.web") / "page"

VIEWER = """
{ // names of its own
const [script, base] = process.argv.slice(1);
const said = [], parts = [];
const element = { set textContent(text) { said.push(text); }, hidden: false };
let loads = 0;
const ask = globalThis.fetch;
globalThis.fetch = (address, options) => ask(base + address, options);
globalThis.location = { search: "" };
globalThis.document = {
  getElementById: () => element,
  createElement: () => ({}),
  body: { append: (one) => setTimeout(loads++ ? one.onload : one.onerror, 0) },
};
globalThis.wasm_bindgen = async ({ module_or_path }) => parts.push(module_or_path.byteLength);
wasm_bindgen.WebHandle = class {
  async start() {}
  open_channel() {}
  has_panicked() { return false; }
  panic_message() { return ""; }
  send_rrd_to_channel(_, data) {
    parts.push(new TextDecoder().decode(data));
    if (parts.length === 3) end();
  }
};
const end = () => { console.log(JSON.stringify({ said, parts })); process.exit(0); };
console.error = end; // the viewer has ended
require("vm").runInThisContext(require("fs").readFileSync(script, "utf8"));
}
"""

PAGE_OF = """
{
const [script, status] = process.argv.slice(1);
const made = () => ({
  textContent: "", cells: [], classList: { toggle() {} }, addEventListener() {}, setAttribute() {},
  append(...more) { this.cells.push(...more); },
  replaceChildren(...all) { this.cells = all; },
});
const elements = {};
globalThis.fetch = () => new Promise(() => {});
globalThis.location = { hash: "" };
globalThis.addEventListener = () => {};
globalThis.document = {
  getElementById: (id) => elements[id] ??= made(), createElement: made, body: made(),
};
require("vm").runInThisContext(require("fs").readFileSync(script, "utf8"));
show(JSON.parse(status));
const rows = elements.sensors.cells.map((row) => row.cells.map((cell) => cell.textContent));
console.log(JSON.stringify({ whole: elements.whole.textContent, rows }));
process.exit(0);
}
"""


def run(program: str, *arguments: str) -> dict[str, Any]:
    """What a program of Node prints."""
    done = subprocess.run(
        ["node", "-e", program, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


class Failing(BaseHTTPRequestHandler):
    """Cuts the second answer for the view and the first ones for the viewer in the middle."""

    asked: Counter[str]

    def do_GET(self) -> None:
        self.asked[self.path] += 1
        cut = self.asked[self.path] == 1 and self.path != "/api/view?after="
        place = {"/api/view?after=": "a", "/api/view?after=a": "b"}.get(self.path, "")
        body = (place or "wasm").encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body) + 1000 * cut))
        self.send_header("Palpate-Place", place)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def failing() -> Iterator[str]:
    handler = type("FailingOnce", (Failing,), {"asked": Counter()})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_live_view_outlives_answers_that_are_cut_in_the_middle(failing: str) -> None:
    found = run(VIEWER, str(PAGE / "live.js"), failing)
    assert found["parts"] == [len("wasm"), "a", "b"]
    assert "The station does not answer." in found["said"]
    assert "re_viewer.js cannot be loaded." in found["said"]
    assert found["said"][-1] == ""


def shown(*statuses: Status) -> dict[str, Any]:
    """What the page shows of processes with these statuses."""
    observed = [
        ObservedProcess(ProcessReport(one.service, one.instance, True, True, one), 0.4, {})
        for one in statuses
    ]
    plain = snapshot("lab", observed, router=True, own=("web", "web"))
    return run(PAGE_OF, str(PAGE / "page.js"), as_json({**plain, "live": False}).decode())


def gateway(name: str, **gauges: float) -> Status:
    states = (SensorStatus(name, SensorState.LIVE, 1),)
    return Status(
        "gateway", name, ServiceState.READY, 2, 1, 60.0, "1", {}, gauges, sensor_states=states
    )


def test_only_a_finger_can_be_not_tared() -> None:
    found = shown(
        gateway("thumb", warm_up=0.0, tare_age_s=61.0),
        gateway("ring", warm_up=1.0),
        gateway("force", publish_p50_s=1e-3),
    )
    heads, *rows = found["rows"]
    ages = {row[0]: row[heads.index("tare age")] for row in rows}
    assert ages == {"thumb": "1:01", "ring": "not tared", "force": "–"}
    assert found["whole"] == "3 of 3 processes well"


def test_processes_that_are_not_shown_are_counted() -> None:
    found = shown(*[gateway(f"g{number}") for number in range(PROCESSES_MOST + 3)])
    assert found["whole"] == "67 of 67 processes well, 3 not shown"
