"""An older bundle with what newer ones say: the same answers, and a range beside them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import read_bundle, write_bundle
from palpate_services.inference.repository import available, resolve
from palpate_training.cli import train_app
from palpate_training.datasets.experiment import MixedDataset, write_mixed
from palpate_training.tasks.fields import FieldFitConfig, field_bundle, tared_counts
from palpate_training.tasks.synthesis import synthesis_bundle
from palpate_training.tasks.upgrade import upgrade_bundle

onnx = pytest.importorskip("onnx")


def _aged(folder: Path, out: Path) -> Path:
    """The bundle as it was written before bundles knew ranges and coefficients."""
    bundle = read_bundle(folder)
    model = onnx.load_from_string(bundle.model)
    kept = [one for one in model.graph.output if one.name != "coefficients"]
    del model.graph.output[:]
    model.graph.output.extend(kept)
    outputs = tuple(one for one in bundle.manifest.outputs if one.name != "coefficients")
    write_bundle(
        out,
        model=model.SerializeToString(),
        golden={name: rows for name, rows in bundle.golden.items() if name != "coefficients"},
        manifest=dataclasses.replace(
            bundle.manifest, outputs=outputs, training_range=None, range_file_sha256="", basis={}
        ),
        mesh=bundle.mesh,
    )
    return out


def test_a_field_bundle_gets_range_and_coefficients_and_keeps_its_answers(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    field_bundle(mixed, tmp_path / "new", config=quick)
    old = _aged(tmp_path / "new", tmp_path / "old")
    write_mixed(tmp_path / "mixed.h5", mixed)
    upgrade_bundle(old, tmp_path / "mixed.h5", tmp_path / "2")
    new, made = read_bundle(tmp_path / "new"), read_bundle(tmp_path / "2")
    assert (new.manifest.version, made.manifest.version) == (1, 2)
    assert made.manifest.outputs == new.manifest.outputs
    assert made.manifest.metrics == new.manifest.metrics
    for name, rows in new.golden.items():
        np.testing.assert_allclose(made.golden[name], rows, atol=1e-6 * np.abs(rows).max())
    known = made.manifest.training_range
    assert known is not None
    assert not known.source.startswith("like those")  # it is the data set that it was trained on
    counts = tared_counts(mixed)
    assert known.inputs[0].low == pytest.approx(counts.min(axis=0), abs=20)
    assert made.known_inputs is not None


def test_other_data_are_called_so(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    synthesis_bundle(mixed, tmp_path / "new", unit="biotac-2", config=quick)
    old = _aged(tmp_path / "new", tmp_path / "old")
    fewer = dataclasses.replace(mixed, coefficients=mixed.coefficients * np.float32(0.5))
    write_mixed(tmp_path / "other.h5", fewer)
    upgrade_bundle(old, tmp_path / "other.h5", tmp_path / "out", units=["biotac-2"])
    known = read_bundle(tmp_path / "out").manifest.training_range
    assert known is not None
    assert known.source.startswith("like those it was trained on, not the same")
    told = CliRunner().invoke(
        train_app,
        ["upgrade", *map(str, (old, tmp_path / "other.h5", tmp_path / "cli")), "--units=biotac-2"],
    )
    assert told.exit_code == 0, told.output
    assert "is not what it was trained on" in " ".join(told.output.split())
    with pytest.raises(DatasetError, match="no unit biotac-9"):
        upgrade_bundle(old, tmp_path / "other.h5", tmp_path / "no", units=["biotac-9"])


@pytest.mark.parametrize("name", available())
def test_a_bundle_that_knows_its_rows_keeps_them(name: str, tmp_path: Path) -> None:
    """Its bounds were learned with distances from them."""
    with pytest.raises(BundleError, match="knows already what it was trained on"):
        upgrade_bundle(resolve(name), tmp_path / "like.h5", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_another_mesh_is_refused(
    mixed: MixedDataset, quick: FieldFitConfig, tmp_path: Path
) -> None:
    synthesis_bundle(mixed, tmp_path / "new", unit="biotac-2", config=quick)
    mesh = dataclasses.replace(mixed.mesh, sha256="cd" * 32)
    write_mixed(tmp_path / "other.h5", dataclasses.replace(mixed, mesh=mesh))
    old = _aged(tmp_path / "new", tmp_path / "old")
    with pytest.raises(BundleError, match="is for the mesh"):
        upgrade_bundle(old, tmp_path / "other.h5", tmp_path / "out")
    assert not (tmp_path / "out").exists()
