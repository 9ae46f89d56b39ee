"""A store in the documented schema, written here by hand, becomes a view; a bad one is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate.files.hdf5 import SENSOR_FRAME
from palpate.files.simulation_store import choose_trajectories, is_simulation_store
from palpate_services.viewer.simulation import LONGEST_ARROW_M, DrawnSimulations, review_simulations
from palpate_services.viewer.surfaces import border_of, normals_of, shades

h5py = pytest.importorskip("h5py", reason="palpate[fem] is not installed")

STEPS = 4
"""In the view: three in the store, after an untouched one that is added."""
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
QUADS = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
"""Of the cube, outward."""
SIZE_M = 0.012


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A single file: a hollow cube for a finger, pressed by something with a shape, and without."""
    path = tmp_path / "by-hand.h5"
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = "palpate.simulations", 1
        file.attrs["frame"] = SENSOR_FRAME
        tip = file.create_group("fingertip")
        tip.create_group("parameters").attrs["friction_coefficient"] = 0.186
        tip.attrs["mesh_name"] = "cube"
        tip.attrs["fluid_pressure_pa"], tip.attrs["total_thickness_m"] = 29e3, 15.1e-3
        tip["nodes"] = tip["pressurised_nodes"] = SIZE_M * np.concatenate([CUBE, 0.7 * CUBE])
        tip["outer_faces"] = QUADS.astype(np.int32)
        tip["inner_faces"] = (QUADS + 8).astype(np.int32)
        tip["core_vertices"] = 0.5 * SIZE_M * CUBE
        tip["core_faces"] = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])
        for name, shaped in (("cube/00/normal", True), ("ring/00/normal", False)):
            _press(file.create_group(f"trajectories/{name}"), shaped=shaped)
    return path


def _press(group: Any, *, shaped: bool) -> None:
    group.attrs["indenter"], group.attrs["outcome"] = "cube", "diverged"
    group.attrs["reason"] = "at 1.2 mm"
    depth = 1e-3 * np.arange(1, STEPS)
    pushed = np.zeros((STEPS - 1, 16, 3), np.float32)
    low = np.flatnonzero(CUBE[:, 2] < 0)
    pushed[:, low, 2] = depth[:, None]
    group["displacement"], group["indenter_force"] = pushed, 100 * pushed
    group["core_force"] = np.zeros_like(pushed)
    group["force"] = (100 * pushed).sum(axis=1)
    group["path"] = np.tile([0, 0, -SIZE_M / 2, 0.6, 0.8, 0, 0], (STEPS + 2, 1))
    group["pose"] = group["path"][1:STEPS]
    group["fluid_pressure_pa"] = 29e3 + 1e6 * depth
    group["contact_area_m2"] = 1e-3 * depth
    group["centre_of_pressure"] = np.tile([0.0, 0.0, -SIZE_M / 2], (STEPS - 1, 1))
    table = np.zeros(STEPS - 1, [("iterations", "<i4"), ("seconds", "<f8")])
    table["iterations"] = 4
    group["convergence"] = table
    if shaped:
        group["indenter_vertices"] = 5e-3 * CUBE
        group["indenter_faces"] = QUADS[:, :3].astype(np.int32)


@pytest.fixture
def drawn(store: Path) -> dict[str, dict[str, list[Any]]]:
    """Components of the view, by entity and name: a value for each step."""
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    from rerun.chunk import RrdReader

    view = review_simulations(store)
    assert view == store.with_suffix(".rrd")
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(str(view)).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            values = batch.column(name).to_pylist()
            found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(values)
    return found


def test_view_shows_what_is_in_the_store(drawn: dict[str, dict[str, list[Any]]]) -> None:
    at = "/cube/00/normal"
    assert drawn[f"{at}/force/z"]["step"] == list(range(STEPS))
    force = [value[0] for value in drawn[f"{at}/force/z"]["Scalars:scalars"]]
    np.testing.assert_allclose(force, 0.4 * np.arange(STEPS), rtol=1e-6)
    assert [value[0] for value in drawn[f"{at}/newton"]["Scalars:scalars"]] == [0, 4, 4, 4]
    moved = {side: drawn[f"{at}/finger/skin/{side}"] for side in ("left", "right")}
    for sign, skin in zip((1, -1), moved.values(), strict=True):
        last = np.array(skin["Mesh3D:vertex_positions"][-1])
        outermost = last[np.argmax(sign * last[:, 1])]
        assert sign * outermost[1] == pytest.approx(SIZE_M / 2)
        # The outer cube's lower nodes have moved up past the inner cube's, which stay.
        assert last[:, 2].min() == pytest.approx(-0.7 * SIZE_M / 2)
        assert len(skin["Mesh3D:vertex_colors"][-1]) == len(last)
    # One of the moved nodes is the furthest: it has the last colour, and before it moved the first.
    colours = moved["left"]["Mesh3D:vertex_colors"]
    assert max(colours[-1]) == shades(np.ones(1))[0]
    assert set(colours[0]) == {shades(np.zeros(1))[0]}


def test_view_shows_contact_only_where_there_is_some(
    drawn: dict[str, dict[str, list[Any]]],
) -> None:
    at = "/cube/00/normal/finger"
    assert [len(value) for value in drawn[f"{at}/patch"]["LineStrips3D:strips"]] == [0, 4, 4, 4]
    push = drawn[f"{at}/push/indenter"]
    assert [len(value) for value in push["Arrows3D:vectors"]] == [0, 4, 4, 4]
    longest = np.linalg.norm(push["Arrows3D:vectors"][-1], axis=1).max()
    assert longest == pytest.approx(LONGEST_ARROW_M)
    ends = np.array(push["Arrows3D:origins"][-1]) + push["Arrows3D:vectors"][-1]
    np.testing.assert_allclose(ends[:, 2], -SIZE_M / 2 + 3e-3, atol=1e-8)
    assert [len(value) for value in drawn[f"{at}/push/core"]["Arrows3D:vectors"]] == [0] * STEPS
    centres = drawn[f"{at}/centre_of_pressure"]["Points3D:positions"]
    assert [len(value) for value in centres] == [0, 1, 1, 1]
    # w x y z in the store, x y z w in Rerun
    turned = drawn[f"{at}/indenter"]["Transform3D:quaternion"][-1]
    np.testing.assert_allclose(turned, [[0.8, 0, 0, 0.6]], rtol=1e-6)
    assert "Mesh3D:vertex_positions" in drawn[f"{at}/indenter/shape"]
    assert "Points3D:positions" in drawn["/ring/00/normal/finger/indenter/tip"]
    (words,) = drawn["/cube/00/normal/about"]["TextDocument:text"][0]
    assert "diverged: at 1.2 mm" in words
    assert "friction_coefficient | 0.186" in words


def test_trajectory_without_steps_has_a_tab_all_the_same(store: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with h5py.File(store, "r+") as file:
        group = file["trajectories/cube/00/normal"]
        for name in set(group) - {"path", "indenter_vertices", "indenter_faces"}:
            values = group[name][:0]
            del group[name]
            group[name] = values
    seen: list[tuple[int, int]] = []
    view = review_simulations(
        store,
        tmp_path / "v.rrd",
        trajectories=["cube/*"],
        progress=lambda done, of: seen.append((done, of)),
    )
    assert view.stat().st_size > 0
    assert seen == [(0, 1)]


def test_choice_is_spread_over_all() -> None:
    ids = sorted(f"{kind}/{at:02}" for kind in ("cube", "ring", "sphere") for at in range(10))
    assert {name.split("/")[0] for name in choose_trajectories(ids, (), 3)} == {
        "cube",
        "ring",
        "sphere",
    }
    assert choose_trajectories(ids, (), 100) == ids
    assert choose_trajectories(ids, ("ring/0[12]", "cube/05"), 8) == [
        "cube/05",
        "ring/01",
        "ring/02",
    ]
    with pytest.raises(DatasetError, match="no trajectory is called 'egg'"):
        choose_trajectories(ids, ("cube/*", "egg"), 8)
    with pytest.raises(DatasetError, match="no trajectory yet"):
        choose_trajectories([], (), 8)


def _set(name: str, value: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file.attrs[name] = value

    return change


def _drop(name: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_set("schema", "palpate.features"), "expected 'palpate.simulations'"),
        (_set("schema_version", 2), "version 2.*update palpate"),
        (_drop("fingertip"), "fingertip.*measured trajectories has no fields"),
        (_drop("trajectories/cube/00/normal/displacement"), "displacement"),
        (lambda path: path.write_bytes(path.read_bytes()[:3000]), "truncated"),
        (Path.unlink, "no such store"),
    ],
)
def test_broken_store_is_named(store: Path, change: Callable[[Path], None], words: str) -> None:
    pytest.importorskip("rerun")
    change(store)
    with pytest.raises(DatasetError, match=words) as caught:
        review_simulations(store)
    assert str(store) in str(caught.value)
    assert not store.with_suffix(".rrd").exists(), "nothing is drawn of a broken store"


def test_folder_that_is_no_store(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no fingertip\.h5 in it"):
        DrawnSimulations.open(tmp_path)


def test_view_that_cannot_be_written(store: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"cannot write .*view\.rrd"):
        review_simulations(store, tmp_path / "file" / "view.rrd")


def test_an_interrupted_review_leaves_the_view_that_is_there(store: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    view = tmp_path / "view.rrd"
    view.write_bytes(b"good")

    def interrupted(drawn: int, total: int) -> None:
        if drawn == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        review_simulations(store, view, progress=interrupted)
    assert view.read_bytes() == b"good"
    assert sorted(tmp_path.iterdir()) == [store, view]


def test_stores_are_told_from_records(store: Path, tmp_path: Path) -> None:
    record = tmp_path / "record.mcap"
    record.write_bytes(b"\x89MCAP0\r\n")
    assert is_simulation_store(store)
    assert is_simulation_store(tmp_path)
    assert not is_simulation_store(record)
    assert not is_simulation_store(tmp_path / "none")


def test_surface_of_a_cube() -> None:
    triangles = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]]).astype(np.int32)
    assert not len(border_of(triangles))
    assert len(border_of(triangles[:6])) > 0
    outward = normals_of(CUBE.astype(np.float32), triangles)
    assert (np.einsum("ij,ij->i", outward, CUBE) > 0.5).all()
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, rtol=1e-6)
