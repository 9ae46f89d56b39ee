"""What the default layout of a record shows, and what it keeps apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.messages import ElectrodeFrame, SensorType, Tare

pytest.importorskip("rerun", reason="palpate[services] is not installed")

from palpate_services.viewer.layout import (
    ESTIMATE_COLOUR,
    TRUTH_COLOUR,
    SensorContents,
    electrode_colours,
    electrode_shades,
    record_fixtures,
    record_layout,
)


def parts_of(layout: Any) -> list[Any]:
    """All containers and views, in order of the screen."""
    found, waiting = [], [layout.root_container]
    while waiting:
        part = waiting.pop(0)
        found.append(part)
        waiting[:0] = list(getattr(part, "contents", ())) if hasattr(part, "kind") else []
    return found


def views_of(contents: SensorContents) -> dict[str, Any]:
    """Origin -> view; no origin is shown twice."""
    parts = parts_of(record_layout({"finger": contents}))
    views = [part for part in parts if not hasattr(part, "kind")]
    found = {str(view.origin): view for view in views}
    assert len(found) == len(views)
    return found


def test_raw_and_tared_counts_are_in_plots_of_their_own() -> None:
    views = views_of(SensorContents(SensorType.BIOTAC, tared=True, fields=True))
    assert {"finger/electrodes/raw", "finger/electrodes/tared"} <= views.keys()
    assert "finger/electrodes" not in views  # which would show both
    assert "tared" in views["finger/electrodes/tared"].name
    assert "raw" in views["finger/electrodes/raw"].name


def test_tared_counts_are_in_front_as_soon_as_there_are_some() -> None:
    def tabs(tared: bool) -> list[Any]:
        contents = SensorContents(SensorType.BIOTAC, tared=tared, fields=False)
        parts = parts_of(record_layout({"finger": contents}))
        return [part for part in parts if getattr(part, "active_tab", None) is not None]

    (front,) = tabs(True)
    assert str(front.contents[front.active_tab].origin) == "finger/electrodes/tared"
    assert not tabs(False)
    views = views_of(SensorContents(SensorType.BIOTAC, tared=False, fields=False))
    assert "finger/electrodes/raw" in views
    assert "finger/electrodes/tared" not in views


def test_every_plot_names_its_unit() -> None:
    views = views_of(SensorContents(SensorType.BIOTAC, tared=True, fields=True))
    units = {
        "force/x": "[N]", "force/y": "[N]", "force/z": "[N]",
        "error/force": "[N]", "error/location_mm": "[mm]",
        "electrodes/raw": "[counts]", "electrodes/tared": "[counts]", "synthesised": "[counts]",
        "pdc": "[counts]", "pac": "[counts]",
    }  # fmt: skip
    for entity, unit in units.items():
        assert views[f"finger/{entity}"].name.endswith(unit), entity
    spaces = views.keys() - {f"finger/{entity}" for entity in units}
    assert spaces == {"finger/finger", "finger/field/truth", "finger/field/estimate"}


def test_a_running_view_is_laid_out_anew_when_the_finger_is_tared(
    make_frame: Callable[..., ElectrodeFrame],
    make_tare: Callable[..., Tare],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from palpate_services.viewer import record_view

    asked: list[SensorContents] = []

    def layout(sensors: dict[str, SensorContents]) -> Any:
        asked.append(sensors["finger"])
        return record_layout(sensors)

    monkeypatch.setattr(record_view, "record_layout", layout)
    with record_view.RerunView(tmp_path / "view.rrd", title="view") as view:
        for message in (make_frame(1), make_frame(2), make_tare(), make_frame(3), make_frame(4)):
            view.add("finger", message)
            view.flush()
    assert [contents.tared for contents in asked] == [False, True]


@pytest.mark.parametrize("kind", list(SensorType))
def test_electrodes_bear_their_numbers_in_the_colours_of_their_curves(kind: SensorType) -> None:
    count = kind.layout.electrodes
    numbers = dict(record_fixtures(kind))["finger/numbers"]
    assert numbers.labels.as_arrow_array().to_pylist() == [str(at + 1) for at in range(count)]
    packed = numbers.colors.as_arrow_array().to_pylist()
    assert [value >> 8 for value in packed] == [
        red << 16 | green << 8 | blue for red, green, blue in electrode_colours(count)
    ]


def test_an_sp_takes_the_body_of_a_finger_that_was_there_before_away() -> None:
    """That one may have been drawn by another process, in the chapter before."""
    biotac, sp = (dict(record_fixtures(kind)) for kind in SensorType)
    for body in ("finger/core", "finger/skin"):
        assert all(len(batch.as_arrow_array()) for batch in biotac[body].as_component_batches())
        assert not any(len(batch.as_arrow_array()) for batch in sp[body].as_component_batches())


def test_an_electrode_without_a_reading_is_neither_pressed_nor_at_rest() -> None:
    tared = np.array([[np.nan, 0.0, -400.0], [400.0, np.nan, 0.0]], np.float32)
    with np.errstate(all="raise"):
        (lost, rest, pressed), (lifted, also_lost, _) = electrode_shades(tared).tolist()
    assert lost == also_lost
    assert len({lost, rest, pressed, lifted}) == 4
    grey = [lost >> shift & 255 for shift in (24, 16, 8)]
    assert max(grey) - min(grey) < 20
    assert lost & 255 == 255


def test_truth_is_seen_on_both_themes_and_beside_the_estimate() -> None:
    """Rerun's legend is white on its light theme, black on its dark one."""
    truth, estimate = (np.array(colour, float) for colour in (TRUTH_COLOUR, ESTIMATE_COLOUR))
    assert np.linalg.norm(truth - 255) > 100
    assert np.linalg.norm(truth) > 100
    assert np.linalg.norm(truth - estimate) > 100
