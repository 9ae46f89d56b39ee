"""Bad bundles: each is refused by a typed error, soon, and without much memory."""

from __future__ import annotations

import io
import threading
import tracemalloc
from pathlib import Path

import pytest
from rich.console import Console

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from tests.hostile import trial
from tests.hostile.bundles import CASES, write_good

from palpate.config import LinkConfig
from palpate.errors import BundleError, ConfigError, printable
from palpate.files.bundle import read_bundle
from palpate_deploy.station.logs import cell
from palpate_services.config import FeaturesServiceConfig
from palpate_services.inference import trial as trial_module
from palpate_services.inference.repository import PACKAGED, resolve, ships
from palpate_services.inference.services import run_estimating
from palpate_services.inference.trial import proven

# These have to be run before they show what they are.
RUN = (
    "Loop that never ends",
    "100 GB at load",
    "2 GB folded at load",
    "100 GB at run",
    "2 GB at run",
    "weights in /etc/hostname",
    "graphs nested 5,000 deep",
    "model of random bytes",
    "golden of another model",
)
MEMORY_BYTES = 300 << 20
"""The largest file allowed, expanded, and a copy of it."""


@pytest.mark.parametrize("name", [name for name in CASES if name not in RUN])
def test_a_bad_bundle_is_refused_before_it_runs(name: str, tmp_path: Path) -> None:
    CASES[name](tmp_path / "b")
    tracemalloc.start()
    try:
        with pytest.raises((BundleError, ConfigError)) as caught:
            read_bundle(resolve(str(tmp_path / "b")))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < MEMORY_BYTES
    assert str(tmp_path) in caught.value.problem  # the file is named
    assert caught.value.remedy
    assert printable(str(caught.value)) == str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Loop that never ends", "did not finish its golden vectors within"),
        ("100 GB at load", "needs more than 192 MiB of memory"),
        ("2 GB folded at load", "needs more than 192 MiB of memory"),
        ("100 GB at run", "needs more than 192 MiB of memory"),
        ("2 GB at run", "needs more than 192 MiB of memory"),
        ("weights in /etc/hostname", "keeps weights in another file"),
        ("graphs nested 5,000 deep", "does not load"),
        ("model of random bytes", "does not load"),
        ("golden of another model", "deviates from golden"),
    ],
)
def test_a_bad_model_is_refused_by_its_trial(name: str, says: str, tmp_path: Path) -> None:
    CASES[name](tmp_path / "b")
    with pytest.raises(BundleError, match=says):
        proven(read_bundle(tmp_path / "b"), "features", limit_s=2.0)


def test_every_bad_bundle_is_in_one_of_the_two_tests() -> None:
    assert set(RUN) < set(CASES)
    assert len(CASES) >= 23


@pytest.mark.slow
def test_a_good_bundle_passes_its_trial_and_is_the_one_that_was_read(tmp_path: Path) -> None:
    write_good(tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    assert proven(bundle, "features") is bundle
    with pytest.raises(BundleError, match="not 'field'"):
        proven(bundle, "field")
    CASES["golden of another model"](tmp_path / "b")  # exchanged after it was read
    with pytest.raises(BundleError, match=r"deviates|exchanged"):
        proven(bundle, "features")


@pytest.mark.slow
def test_a_bundle_that_is_exchanged_for_another_good_one_is_noticed(tmp_path: Path) -> None:
    write_good(tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    manifest = tmp_path / "b" / "manifest.json"
    manifest.write_bytes(manifest.read_bytes().replace(b'"nothing"', b'"something"'))
    with pytest.raises(BundleError, match="exchanged while it was tried"):
        proven(bundle, "features")


@pytest.mark.slow
def test_a_service_does_not_start_with_a_model_that_never_ends(
    tmp_path: Path,
) -> None:
    CASES["Loop that never ends"](tmp_path / "b")
    config = FeaturesServiceConfig(bundle=str(tmp_path / "b"))
    with pytest.raises(BundleError, match="did not finish its golden vectors"):
        run_estimating(config, LinkConfig(), "lab", threading.Event())


def test_what_ships_is_trusted_like_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{trial_module.__name__}.subprocess.run", None)  # a trial would fail
    bundle = read_bundle(resolve("features-virtual"))
    assert proven(bundle, "features") is bundle
    assert not ships(tmp_path)
    assert not ships(PACKAGED / ".." / "elsewhere")
    (tmp_path / "link").symlink_to(PACKAGED)
    assert ships(tmp_path / "link" / "features-virtual" / "1")


@pytest.mark.slow
def test_the_command_says_what_is_wrong_and_sends_no_control_character(tmp_path: Path) -> None:
    CASES["ANSI escapes in a text"](tmp_path / "b\x1b[31m")
    answer = trial.run("model", "verify", str(tmp_path / "b\x1b[31m"))
    assert answer.error == BundleError.__name__
    assert not answer.traceback
    assert "\x1b" not in answer.says + answer.printed
    assert "\x07" not in answer.says + answer.printed
    assert r"\x1b[2J" in answer.says


def test_printable_shows_what_would_act() -> None:
    assert printable("plain, ü and 指") == "plain, ü and 指"
    assert printable("\x1b[2J\x07\x9b1m\u202e\ud800\n") == r"\x1b[2J\x07\x9b1m\u202e\ud800\n"
    assert printable("two\nlines", keep="\n") == "two\nlines"


def test_a_cell_of_a_table_has_neither_controls_nor_markup() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    console.print(cell("[red]no\x1b]0;owned\x07[/] and [link=x]"), highlight=False)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert shown == "[red]no\\x1b]0;owned\\x07[/] and [link=x]\n"
