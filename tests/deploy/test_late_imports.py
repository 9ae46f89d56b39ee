"""A service that serves imports nothing more: an import may take longer than several frames."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate_deploy.station.status import ask_status

PATIENCE_S = 90.0

CUSTOMIZATION = """
import gc, sys

class NotesImports:
    def find_spec(self, name, path=None, target=None):
        with open("FILE", "a") as notes:
            print(gc.get_freeze_count() > 0, name, *sys.argv[1:3], file=notes)

sys.meta_path.insert(0, NotesImports())
"""


@pytest.fixture
def imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a process that is started notes what it imports, and whether it served by then."""
    notes = tmp_path / "imports.txt"
    folder = tmp_path / "customization"
    folder.mkdir()
    text = CUSTOMIZATION.replace("FILE", str(notes))
    (folder / "sitecustomize.py").write_text(text, encoding="utf-8")
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    return notes


def test_gateway_and_service_import_nothing_once_they_serve(
    imports: Path,
    up: subprocess.Popen[bytes],
    station: tuple[Path, LinkConfig],
    wait_until: Callable[[Callable[[], bool], float, str], float],
) -> None:
    """Their first report imported NumPy's masked arrays, for percentiles: up to 3 frames lost."""
    _, link = station

    def have_reported() -> bool:
        with Session.open(link, station="test") as session:
            gauges = [gauge for status in ask_status(session) for gauge in status.gauges]
        return {"latency_p50_s"} <= set(gauges) and any("publish_p50_s" in name for name in gauges)

    wait_until(have_reported, PATIENCE_S, "gateway and service have reported")
    noted = [line.split() for line in imports.read_text(encoding="utf-8").splitlines()]
    assert any(words[2:] == ["run", "features"] for words in noted)  # it notes
    late = {(name, *process) for serves, name, *process in noted if serves == "True"}
    # The virtual finger needs random numbers, before its first frame.
    assert {words for words in late if not words[0].startswith("numpy.random")} == set()
