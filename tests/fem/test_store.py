"""What goes into a store comes out; what is not a store, or not whole, is named."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from palpate.errors import ConfigError, DatasetError
from palpate_fem.config import FingertipParameters
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.service.biotac import biotac
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.files import StoreMismatchError, StoreTakenError
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter, export

sample: Any = importlib.import_module("stored_sample")
indenter_outline: Callable[[str], Outline] = sample.indenter_outline
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

ID = "sphere_medium/03/normal"
FLOAT32 = 6e-8
"""Fields are kept as float32: half a unit in the last of 24 bits."""


@pytest.fixture(scope="module")
def tip() -> StoredFingertip:
    return sample_fingertip(divisions=4)


@pytest.fixture(scope="module")
def press(tip: StoredFingertip) -> IndentationResult:
    return sample_trajectory(tip, steps=6)


@pytest.fixture(scope="module")
def whole_store(
    tip: StoredFingertip, press: IndentationResult, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A store of two trajectories, one with another ending."""
    path = tmp_path_factory.mktemp("store") / "sweep.sim"
    with StoreWriter(path, tip, outline=indenter_outline, command="test") as store:
        store.write(ID, press)
        short = replace(
            press,
            steps=press.steps[:3],
            outcome=IndentationOutcome.DIVERGED,
            reason="at 1.2 mm",
            travel_m=1e-3,
        )
        store.write("sphere_medium/03/angled", short, sensor="lab-2")
    return path


@pytest.fixture
def path(whole_store: Path, tmp_path: Path) -> Path:
    """A copy of it to write to and to break."""
    return Path(shutil.copytree(whole_store, tmp_path / "sweep.sim"))


def _assert_same(
    read: IndentationResult, written: IndentationResult, *, stress: bool = False
) -> None:
    for name in ("indenter", "outcome", "reason", "travel_m", "seconds"):
        assert getattr(read, name) == getattr(written, name), name
    np.testing.assert_array_equal(read.path, written.path)
    assert len(read.steps) == len(written.steps)
    for one, other in zip(read.steps, written.steps, strict=True):
        for name in ("pose", "force", "torque", "centre_of_pressure"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert one.fluid_pressure_pa == other.fluid_pressure_pa
        assert one.contact_area_m2 == other.contact_area_m2
        assert one.convergence == other.convergence
        for name in ("displacement", "indenter_force", "core_force"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=FLOAT32, err_msg=name
            )
            assert getattr(one, name).dtype == np.float64
        if stress:
            np.testing.assert_allclose(one.stress, other.stress, rtol=FLOAT32)
        else:
            assert one.stress.shape == (0, 6)


def test_round_trip(path: Path, tip: StoredFingertip, press: IndentationResult) -> None:
    store = SimulationStore.open(path)
    assert store.ids() == ["sphere_medium/03/angled", ID]
    _assert_same(store.trajectory(ID), press)
    summary = store.summary("sphere_medium/03/angled")
    assert (summary.sensor, summary.outcome, summary.complete) == ("lab-2", "diverged", False)
    np.testing.assert_array_equal(summary.force, press.forces[:3])
    read = store.fingertip()
    assert read.key == tip.key
    assert read.mesh.sha256 == tip.mesh.sha256
    assert read.mesh.name == tip.mesh.name
    assert read.parameters == tip.parameters
    assert read.settings == tip.settings
    assert not read.differences(tip)
    np.testing.assert_array_equal(read.mesh.mirror, tip.mesh.mirror)
    outline = store.outline(ID)
    assert outline is not None
    assert outline[0].shape[1:] == (3,)
    assert store.check() == 2
    assert not list(path.rglob("*.part"))


def test_stress_is_kept_on_request(
    tip: StoredFingertip, press: IndentationResult, tmp_path: Path
) -> None:
    with StoreWriter(tmp_path / "s.sim", tip, stress=True) as store:
        store.write(ID, press)
        _assert_same(store.trajectory(ID), press, stress=True)
        assert store.outline(ID) is None


def test_trajectory_without_any_step(
    tip: StoredFingertip, press: IndentationResult, tmp_path: Path
) -> None:
    nothing = replace(
        press, steps=(), outcome=IndentationOutcome.DIVERGED, reason="before the first pose"
    )
    with StoreWriter(tmp_path / "s.sim", tip, stress=True) as store:
        store.write(ID, nothing)
        _assert_same(store.trajectory(ID), nothing)
        assert store.summary(ID).force.shape == (0, 3)
        np.testing.assert_array_equal(store.summary(ID).path, press.path)


def test_resuming_runs_only_what_is_not_done(
    path: Path, tip: StoredFingertip, press: IndentationResult
) -> None:
    cancelled = replace(press, steps=press.steps[:1], outcome=IndentationOutcome.CANCELLED)
    with StoreWriter(path, tip) as store:
        assert store.done() == set(store.ids())
        store.write("cube/00/normal", cancelled)
        assert "cube/00/normal" in store.ids()
        assert "cube/00/normal" not in store.done(), "what was cancelled is run again"
        store.write("cube/00/normal", press)
        assert "cube/00/normal" in store.done()
        with pytest.raises(StoreTakenError, match=f"{ID} is done"):
            store.write(ID, press)
    assert len(SimulationStore.open(path).ids()) == 3


def test_a_sweep_does_not_go_on_in_two_stores_that_were_copied_into_one(
    path: Path, tip: StoredFingertip, press: IndentationResult, tmp_path: Path
) -> None:
    """Their trajectories are of two fingertips; the one of the other is named."""
    softer = replace(tip, parameters=replace(tip.parameters, shear_modulus_pa=1e5))
    with StoreWriter(tmp_path / "softer.sim", softer) as store:
        store.write("cube/07/normal", press)
    shutil.copytree(
        tmp_path / "softer.sim" / "trajectories", path / "trajectories", dirs_exist_ok=True
    )
    with (
        StoreWriter(path, tip, shared=True) as store,
        pytest.raises(DatasetError, match=r"cube/07/normal\.h5: run on another fingertip"),
    ):
        store.done()


def test_failed_simulation_leaves_no_trace(path: Path, tip: StoredFingertip) -> None:
    before = sorted(path.rglob("*"))
    with StoreWriter(path, tip) as store, pytest.raises(ZeroDivisionError), store.claim("a/b"):
        raise ZeroDivisionError
    assert sorted(file for file in path.rglob("*") if file.name != "a") == before
    assert len(SimulationStore.open(path).ids()) == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tip: replace(tip, parameters=FingertipParameters(friction_coefficient=0.3)),
         r"friction_coefficient 0.3 is not 0.186"),
        (lambda tip: replace(tip, parameters=FingertipParameters(fluid_volume_m3=4e-7)),
         r"fluid_volume_m3 4e-07 is not None"),
        (lambda tip: replace(tip, settings={**tip.settings, "solver": "other"}), "solver other"),
        (lambda tip: sample_fingertip(divisions=5), r"mesh sample 5 x 2 \(.*divisions 5 is not 4"),
        (lambda tip: replace(tip, pressurised_nodes=tip.pressurised_nodes + 1e-6), "1.* um away"),
        (lambda tip: replace(tip, pressurised_nodes=tip.pressurised_nodes * np.nan), "nan um away"),
        (lambda tip: replace(tip, core_vertices=tip.core_vertices * 0.9), "the core is not"),
        (lambda tip: replace(tip, core_vertices=tip.core_vertices[:-1]), "the core is not"),
        (lambda tip: replace(tip, core_faces=tip.core_faces[:, [0, 2, 1]]), "the core is not"),
        (lambda tip: replace(tip, fluid_volume_m3=1.1 * tip.fluid_volume_m3), "fluid volume of"),
    ],
)  # fmt: skip
def test_another_fingertip_is_refused(
    path: Path, tip: StoredFingertip, change: Callable[[Any], Any], words: str
) -> None:
    with pytest.raises(StoreMismatchError, match=words):
        StoreWriter(path, change(tip))
    StoreWriter(path, tip).close()  # the refused one holds no lock
    # NumPy's numbers are numbers, and the last bits of a pressurised shape may differ by machine.
    same = replace(
        tip,
        settings={**tip.settings, "divisions": np.int64(4)},  # type: ignore[dict-item]
        pressurised_nodes=tip.pressurised_nodes + 1e-12,
        core_vertices=tip.core_vertices + 1e-12,
        fluid_volume_m3=tip.fluid_volume_m3 * (1.0 + 1e-9),
    )
    StoreWriter(path, same).close()


def test_trajectories_without_their_fingertip_are_not_adopted(
    path: Path, tip: StoredFingertip
) -> None:
    (path / "fingertip.h5").unlink()
    other = replace(tip, parameters=replace(tip.parameters, shear_modulus_pa=1e5))
    with pytest.raises(StoreMismatchError, match=r"fingertip\.h5"):
        StoreWriter(path, other)
    StoreWriter(path, tip).close()  # its own fingertip is written again
    assert SimulationStore.open(path).check() == 2


@pytest.mark.parametrize(
    "name", ["", "/a", "a/", "a//b", "../a", "a/../b", ".hidden", "a b", "ä", "a\n", "x" * 201]
)
def test_ids_stay_inside_the_store(path: Path, tip: StoredFingertip, name: str) -> None:
    with StoreWriter(path, tip) as store, pytest.raises(ConfigError, match="no id"):
        store.claim(name)
    with pytest.raises(ConfigError, match="no id"):
        SimulationStore.open(path).summary(name)


@pytest.mark.parametrize("name", ["sphere_medium", "sphere_medium/03", f"{ID}/again"])
def test_no_trajectory_inside_another(
    path: Path, tip: StoredFingertip, press: IndentationResult, name: str
) -> None:
    with StoreWriter(path, tip) as store, pytest.raises(DatasetError, match="inside another"):
        store.write(name, press)


def test_export_is_the_same_store(
    path: Path, tip: StoredFingertip, press: IndentationResult
) -> None:
    single = path.with_suffix(".h5")
    seen: list[tuple[int, int]] = []
    assert export(SimulationStore.open(path), single, progress=lambda *at: seen.append(at)) == 2
    assert seen == [(0, 2), (1, 2)]
    store = SimulationStore.open(single)
    assert store.ids() == SimulationStore.open(path).ids()
    _assert_same(store.trajectory(ID), press)
    assert store.fingertip().key == tip.key
    assert store.check() == 2
    assert store.done() == set(store.ids())
    with pytest.raises(DatasetError, match="one file already"):
        export(store, path.with_name("again.h5"))
    with pytest.raises(DatasetError, match="no 'cube'"):
        export(SimulationStore.open(path), path.with_name("again.h5"), ids=["cube"])
    assert sorted(path.parent.iterdir()) == sorted([path, single]), "it leaves nothing behind"


def test_export_replaces_nothing(path: Path) -> None:
    """Not even what appears while it copies."""
    single = path.with_suffix(".h5")

    def write_another(*_: int) -> None:
        single.write_bytes(b"mine")

    with pytest.raises(ConfigError, match="is there already"):
        export(SimulationStore.open(path), single, progress=write_another)
    assert single.read_bytes() == b"mine"
    assert sorted(path.parent.iterdir()) == sorted([path, single])
    with pytest.raises(ConfigError, match="is there already"):
        export(SimulationStore.open(path), single)


def test_export_onto_a_full_disk(path: Path) -> None:
    program = """
import resource, signal, sys
from pathlib import Path
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import export
from palpate_fem.store.files import StoreDiskError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
try:
    export(SimulationStore.open(Path(sys.argv[1])), Path(sys.argv[2]))
except StoreDiskError as error:
    print(error)
"""
    single = path.with_name("single.h5")
    run = subprocess.run(
        [sys.executable, "-c", program, path, single], capture_output=True, text=True, check=False
    )
    assert "cannot write" in run.stdout, run.stderr
    assert "kept" not in run.stdout, "an export begins anew"
    assert run.returncode == 0, run.stderr
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_measured_trajectories_need_poses_and_forces_only(tmp_path: Path) -> None:
    file_path = tmp_path / "measured.h5"
    with h5py.File(file_path, "w") as file:
        file.attrs["schema"] = "palpate.simulations"
        file.attrs["schema_version"] = 1
        file.attrs["frame"] = (
            "sensor frame: x distal, y lateral, z dorsal; force is the force on the BioTac"
        )
        group = file.create_group("trajectories/cube/01")
        group.attrs["indenter"], group.attrs["sensor"] = "cube", "lab-1"
        group["pose"], group["force"] = np.zeros((5, 7)), np.ones((5, 3))
    store = SimulationStore.open(file_path)
    summary = store.summary("cube/01")
    assert (summary.indenter, summary.sensor, summary.complete) == ("cube", "lab-1", True)
    assert np.isnan(summary.fluid_pressure_pa).all()
    np.testing.assert_array_equal(summary.path, summary.pose)
    assert store.check() == 1
    with pytest.raises(DatasetError, match="measured trajectories has no fields"):
        store.trajectory("cube/01")
    with pytest.raises(DatasetError, match="fingertip"):
        store.fingertip()


def test_settings_keep_the_names_that_stores_have() -> None:
    """A store of before goes on only if the names of all settings are those that it holds."""
    tip = biotac(edge_m=1e-3, layers=1)(FingertipParameters(), lambda _: None).describe()
    assert sorted(tip.settings) == [
        "contact.complement",
        "contact.margin_m",
        "contact.mortar",
        "contact.stiffness",
        "contact.tangential_stiffness",
        "force_limit_n",
        "newton.creep_iterations",
        "newton.gap_tolerance_m",
        "newton.iterations",
        "newton.keep_elastic",
        "newton.keep_factor",
        "newton.largest_move_m",
        "newton.linear_tolerance",
        "newton.mortar_updates",
        "newton.patience",
        "newton.tolerance",
        "newton.traction_tolerance",
        "newton.volume_tolerance",
        "predict",
        "smallest_increment",
        "solver",
        "volume_barrier",
    ]
