"""Fields recorded and drawn: few enough, on their own skin, and counted where nobody knows it."""

from __future__ import annotations

import dataclasses
import importlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import Session
from palpate.bus.topics import FIELD, FIELD_TRUTH, SYNTHESIS
from palpate.config import LinkConfig
from palpate.errors import ConfigError
from palpate.files.record import read_record
from palpate.messages import ElectrodeFrame, FeatureEstimate, Stamp, SynthesisEstimate, Tare
from palpate_services.config import RecorderConfig
from palpate_services.inference.repository import MeshLibrary, Repository
from palpate_services.recorder.service import run_recorder
from palpate_services.viewer.timeline import FieldThinner, SensorTimeline

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]


def stamp_at(stamp: Stamp, time_s: float) -> Stamp:
    return dataclasses.replace(
        stamp, sequence=1 + round(100 * time_s), wall_ns=10**18 + round(time_s * 1e9)
    )


def synthesis_of(stamp: Stamp) -> SynthesisEstimate:
    counts = np.arange(19, dtype=np.float32)
    return SynthesisEstimate(stamp, "BT-TEST", bytes(32), bundles.skin().sha256, counts)


def test_at_most_five_fields_a_second_are_drawn(make_frame: Frames) -> None:
    stamp, thinner = make_frame().stamp, FieldThinner()
    rows = [
        thinner.row(bundles.truth(stamp_at(stamp, at / 20), depth_m=1e-4 * at)) for at in range(40)
    ]
    drawn = [at for at, row in enumerate(rows) if row is not None]
    assert drawn == list(range(0, 40, 4))
    row = rows[4]
    assert row is not None
    np.testing.assert_array_equal(row.displacement, bundles.pressed(4e-4))


def test_a_field_that_looks_the_same_is_not_drawn_again(make_frame: Frames) -> None:
    """Compared with what is on the screen, so that a slow drift is followed all the same."""
    stamp, thinner = make_frame().stamp, FieldThinner()
    rows = [
        thinner.row(bundles.truth(stamp_at(stamp, float(at)), depth_m=8e-6 * at))
        for at in range(10)
    ]
    assert [at for at, row in enumerate(rows) if row is not None] == [0, 3, 6, 9]
    other = bundles.truth(stamp_at(stamp, 11.0), depth_m=8e-6 * 9, mesh="another")
    assert thinner.row(other) is not None


def test_scene_keeps_truth_estimate_and_synthesis_apart(make_frame: Frames) -> None:
    scene, stamp = SensorTimeline(), stamp_at(make_frame().stamp, 0.0)
    assert not scene.has_fields
    scene.add(bundles.truth(stamp, 1e-3))
    scene.add(bundles.guess(stamp, 2e-3))
    scene.add(synthesis_of(stamp))
    assert scene.has_fields
    rows = scene.take()
    for name, depth_m in (("truth", 1e-3), ("estimate", 2e-3)):
        (row,) = rows[f"field/{name}"]
        np.testing.assert_array_equal(row.displacement, bundles.pressed(depth_m))
    assert [row.values[18] for row in rows["synthesised"]] == [18.0]
    assert {"field", "field_truth", "synthesis"} <= SensorTimeline.TOPICS


def test_library_knows_packaged_meshes_and_those_it_is_told_of(tmp_path: Path) -> None:
    models = tmp_path / "models"
    bundles.write(models / "field-a" / "1", "field")
    bundles.write(tmp_path / "mine", "synthesis", mesh=bundles.skin("mine"))
    bundles.write(models / "field-b" / "1", "field", mesh=bundles.skin("broken"))
    (models / "field-b" / "1" / "mesh.npz").write_bytes(b"broken")
    library = MeshLibrary([str(tmp_path / "mine")], Repository(None, packaged=models))
    for name in ("skin", "mine"):
        found = library.find(bundles.skin(name).sha256)
        assert found is not None
        np.testing.assert_array_equal(found.nodes, bundles.skin().nodes)
    assert library.find(bundles.skin("broken").sha256) is None
    assert library.find(bytes(32)) is None
    with pytest.raises(ConfigError, match="bundle 'no-such'"):
        MeshLibrary(["no-such"], Repository(None, packaged=models))


def test_recorder_refuses_a_bundle_that_is_not_there(tmp_path: Path) -> None:
    config = RecorderConfig(out=tmp_path, bundles=("no-such",))
    with pytest.raises(ConfigError, match="bundle 'no-such'"):
        run_recorder(config, LinkConfig(), "lab", threading.Event())


def columns_of(view: Path) -> dict[str, dict[str, list[Any]]]:
    """Entity -> component -> its values in the file."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(str(view)).stream():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def values_of(columns: dict[str, list[Any]], component: str) -> list[Any]:
    (name,) = [name for name in columns if name.endswith(component)]
    return [value for value in columns[name] if value is not None]


def test_recorded_and_drawn(
    link: LinkConfig,
    make_frame: Frames,
    make_tare: Callable[..., Tare],
    tmp_path: Path,
    until: Until,
) -> None:
    pytest.importorskip("rerun")
    from palpate_services.viewer.record_view import review

    mine = str(bundles.write(tmp_path / "mine", "field"))
    stop = threading.Event()
    config = RecorderConfig(
        out=tmp_path / "runs", bundles=(mine,), min_free_bytes=0, field_rate_hz=0
    )
    node = threading.Thread(target=run_recorder, args=(config, link, "lab", stop))
    node.start()
    stamp = make_frame().stamp
    try:
        with Session.open(link) as session:
            until(lambda: any(a.ready for a in session.alive()))
            truths = session.publisher(FIELD_TRUTH, sensor="finger", lossless=True)
            guesses = session.publisher(FIELD, sensor="finger", lossless=True)
            counts = session.publisher(SYNTHESIS, sensor="finger", lossless=True)
            for at in range(10):
                now = stamp_at(stamp, at / 4)
                truths.put(bundles.truth(now, depth_m=1e-4 * at))
                guesses.put(bundles.guess(now, depth_m=2e-4 * at))
                counts.put(synthesis_of(now))
            guesses.put(bundles.guess(stamp_at(stamp, 9.0), mesh="unknown"))
            recorded = {"recorded_field_truth": 10, "recorded_field": 11, "recorded_synthesis": 10}
            found: dict[str, int] = {}

            def came() -> bool:
                from palpate.client import Client

                with Client(link.connect[0]) as robot:
                    for status in robot.status():
                        found.update(status.counters)
                return recorded.items() <= found.items() and found.get("view_no_mesh") == 1

            until(came)
    finally:
        stop.set()
        node.join(timeout=15)
    (record,) = (tmp_path / "runs").glob("*.mcap")
    kept = [item.address.topic for item in read_record(record)]
    assert (kept.count("field_truth"), kept.count("field"), kept.count("synthesis")) == (10, 11, 10)
    mesh = bundles.skin()
    skin = np.unique(mesh.outer_faces)
    for view in (
        record.with_suffix(".rrd"),
        review(record, tmp_path / "again.rrd", bundles=[mine]),
    ):
        drawn = columns_of(view)
        for name, each_m in (("truth", 1e-4), ("estimate", 2e-4)):
            columns = drawn[f"/finger/field/{name}/{mesh.sha256.hex()[:8]}"]
            positions = values_of(columns, "vertex_positions")
            assert len(positions) == 10
            wanted = mesh.nodes[skin] + bundles.pressed(9 * each_m)[skin]
            np.testing.assert_allclose(np.array(positions[9]), wanted, atol=1e-9)
            colours = values_of(columns, "vertex_colors")
            assert len(set(colours[0])) == 1  # nothing has moved: one colour
            assert len(set(colours[9])) > 1
            (triangles,) = values_of(columns, "triangle_indices")
            np.testing.assert_array_equal(skin[np.array(triangles)], mesh.outer_faces)
        assert len(values_of(drawn["/finger/synthesised"], "Scalars:scalars")) == 10
        entities = [entity for entity in drawn if entity.startswith("/finger/field/")]
        assert len(entities) == 2


def test_a_field_with_other_nodes_than_its_mesh_is_counted(
    make_frame: Frames, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    from palpate_services.viewer.record_view import RerunView

    meshes = MeshLibrary([str(bundles.write(tmp_path / "mine", "field"))])
    field = bundles.truth(stamp_at(make_frame().stamp, 0.0))
    with RerunView(tmp_path / "view.rrd", title="view", meshes=meshes) as view:
        view.add("finger", dataclasses.replace(field, displacement=field.displacement[:-1]))
        view.flush()
        assert dict(view.counters) == {"view_wrong_mesh": 1}


def test_a_force_is_drawn_where_it_acts(make_frame: Frames) -> None:
    """At the centre of pressure of a bundle that knows it, else at the contact location."""
    place, centre = np.full(3, 0.002, np.float32), np.full(3, 0.001, np.float32)
    older = FeatureEstimate(
        make_frame().stamp, "BT", bytes(32), 5, True, place, place, place, place
    )
    newer = dataclasses.replace(older, centre_of_pressure=centre, centre_of_pressure_sd=place)
    timeline = SensorTimeline()
    timeline.add(older)
    timeline.add(newer)
    rows = timeline.take()
    assert [row.at[0] for row in rows["arrow/estimate"]] == [place[0], centre[0]]
    assert [row.values[0] for row in rows["location/estimate"]] == [place[0], place[0]]
