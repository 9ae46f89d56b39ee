"""What fem stores, services show: the two rooms share a schema on disk and no code."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("h5py", reason="palpate[fem] is not installed")

from palpate_deploy.cli import files as cli_files
from palpate_deploy.cli.options import PalpateGroup
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter, export
from palpate_services.viewer.simulation import DrawnSimulations

sys.path.append(str(Path(__file__).parents[1] / "fem"))
sample: Any = importlib.import_module("stored_sample")
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

NAMES = ["sphere_medium/00/angled", "sphere_medium/00/normal"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulations") / "sweep.sim"
    tip = sample_fingertip(divisions=4)
    with StoreWriter(path, tip, outline=indenter_outline) as writer:
        for name, angle in zip(NAMES, (0.5, 0.0), strict=True):
            writer.write(name, sample_trajectory(tip, steps=5, angle=angle))
    export(SimulationStore.open(path), path.with_suffix(".h5"))
    return path


@pytest.mark.parametrize("suffix", [".sim", ".h5"])
def test_services_read_what_fem_writes(store: Path, suffix: str) -> None:
    path = store.with_suffix(suffix)
    written, read = SimulationStore.open(path), DrawnSimulations.open(path)
    assert read.ids() == written.ids() == NAMES
    tip, finger = written.fingertip(), read.fingertip()
    np.testing.assert_array_equal(finger.nodes, tip.pressurised_nodes)
    np.testing.assert_array_equal(finger.core_faces, tip.core_faces)
    assert len(finger.outer) == 2 * len(tip.mesh.outer_faces)
    assert finger.facts["friction_coefficient"] == "0.186"
    for name in NAMES:
        trajectory, press = written.trajectory(name), read.trajectory(name)
        assert (press.indenter, press.outcome) == (trajectory.indenter, trajectory.outcome.value)
        # The view begins before the first step, with the untouched finger.
        np.testing.assert_array_equal(press.pose[0], trajectory.path[0])
        assert press.fluid_pressure_pa[0] == tip.fluid_pressure_pa
        assert not press.displacement[0].any()
        for at, step in enumerate(trajectory.steps, start=1):
            for field in ("pose", "force", "displacement", "indenter_force", "core_force"):
                np.testing.assert_array_equal(getattr(press, field)[at], getattr(step, field))
            np.testing.assert_array_equal(press.centre_of_pressure[at], step.centre_of_pressure)
            assert press.fluid_pressure_pa[at] == step.fluid_pressure_pa
            assert press.iterations[at] == step.convergence.iterations
        outline = written.outline(name)
        assert outline is not None
        assert press.shape is not None
        np.testing.assert_array_equal(press.shape[0], outline[0])


def test_inner_and_outer_skin_face_away_from_the_solid(store: Path) -> None:
    """Light falls on what is seen: the outer surface from outside, the inner from the cavity."""
    finger = DrawnSimulations.open(store).fingertip()
    for triangles, sign in ((finger.outer, 1), (finger.inner, -1)):
        corners = finger.nodes[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (sign * np.einsum("ij,ij->i", normal, corners.mean(axis=1)) > 0).all()


@pytest.fixture
def app() -> typer.Typer:
    """The commands about files alone, as `palpate` has them."""
    app = typer.Typer(cls=PalpateGroup, rich_markup_mode=None)
    cli_files.register(app)
    return app


@pytest.mark.parametrize("suffix", [".sim", ".h5"])
def test_review_takes_a_store_as_one_thing(
    store: Path, suffix: str, app: typer.Typer, tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    view = tmp_path / "view.rrd"
    arguments = ["review", str(store.with_suffix(suffix)), "--out", str(view), "--most", "1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert f"rerun {view}" in result.output
    assert view.stat().st_size > 0


def test_review_draws_the_store_or_the_trajectory_that_is_named(
    store: Path, app: typer.Typer, tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    pytest.importorskip("matplotlib", reason="palpate[fem] is not installed")
    picture = tmp_path / "picture.png"
    common = ["review", str(store), "--out", str(tmp_path / "view.rrd"), "--png", str(picture)]
    drawn = []
    for more in ([], ["--trajectory", "*/angled"]):
        result = CliRunner().invoke(app, [*common, *more])
        assert result.exit_code == 0, result.output
        assert ("complete" in result.output) == (not more)
        drawn.append(picture.read_bytes())
        assert drawn[-1][:4] == b"\x89PNG"
    assert drawn[0] != drawn[1]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["none.sim"], 2, "does not exist"),
        (["."], 1, "no fingertip.h5"),
        (["sweep.sim", "--trajectory", "egg"], 1, "no trajectory is called 'egg'"),
        (["some.mcap", "--trajectory", "egg"], 2, "is a record"),
    ],
)
def test_review_refuses_with_a_reason(
    store: Path,
    app: typer.Typer,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    pytest.importorskip("rerun", reason="palpate[services] is not installed")
    monkeypatch.chdir(store.parent)
    (store.parent / "some.mcap").write_bytes(b"\x89MCAP0\r\n")
    result = CliRunner().invoke(app, ["review", *arguments])
    assert result.exit_code == code, result.output
    assert words in result.output
