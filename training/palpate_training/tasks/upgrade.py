"""An older bundle with what newer ones say: its training range, and of a field its coefficients.

The weights stay what they are, so do its answers and its metrics. The data set should be the one
that it was trained on; where that is gone, one of the same experiment, and the range says so. A
bundle that knows its rows is refused: bounds of errors hold with the distances that they were
learned with, and presses are known to be held out by the rows that were trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import BundleError, ConfigError, DatasetError
from palpate.files.bundle import Bundle, read_bundle, write_bundle
from palpate.files.tasks import tensors_of
from palpate.files.training_range import KnownInputs
from palpate.process import require
from palpate_training.datasets.experiment import MixedDataset, read_mixed
from palpate_training.datasets.features import open_dataset, press_of
from palpate_training.learning.export import (
    PARITY_MAX,
    basis_of,
    refuse_existing,
    run_onnx,
    version_of,
)
from palpate_training.learning.ranges import known_inputs
from palpate_training.learning.splits import Rows
from palpate_training.tasks.features import features_range
from palpate_training.tasks.fields import FieldFitConfig, field_range, seen_rows
from palpate_training.tasks.synthesis import synthesis_range

_OTHER_DATA = "like those it was trained on, not the same: "


def upgrade_bundle(old: Path, data: Path, out: Path, *, units: Sequence[str] = ()) -> bytes:
    """Write a bundle again with the range of all rows of a data set; returns its digest.

    Args:
        old: Folder of the bundle.
        data: Data set of features, or a mixed one, as its training takes it.
        out: Folder to write; must not exist. A number is the version.
        units: Specimens of a mixed data set that it was trained on; empty = all.

    Raises:
        BundleError: It breaks its contract, knows its training rows already, ``out`` exists, or the
            rows are of another fingertip.
        DatasetError: The data set breaks its schema.
        ConfigError: Specimens are named for a bundle of features.
    """
    refuse_existing(out)
    bundle = read_bundle(old)
    _check_older(bundle)
    known: KnownInputs | None = None
    if bundle.manifest.task == "features":
        if units:
            raise ConfigError(
                "--units is for mixed data sets; features take all rows", remedy="leave it out"
            )
        presses = open_dataset(data)
        found = features_range(presses, np.arange(len(presses)))
        known = known_inputs(presses.tared_counts, press_of(presses))
    else:
        mixed = read_mixed(data)
        rows = _rows_of(mixed, units)
        _check_mesh(bundle, mixed)
        if bundle.manifest.task == "field":
            bundle = with_coefficients(bundle)
            seen, groups = seen_rows(mixed, rows, FieldFitConfig(), seed=0)
            known = known_inputs(seen, groups)
            contact = any(one.name == "contact_force" for one in bundle.manifest.outputs)
            found = field_range(mixed, rows, seen, contact=contact)
        else:
            found = synthesis_range(mixed, rows)
    if found.data_sha256 != bundle.manifest.training_data_sha256:
        found = replace(found, source=_OTHER_DATA + found.source)
    return write_bundle(
        out,
        model=bundle.model,
        golden=bundle.golden,
        manifest=replace(
            bundle.manifest,
            training_range=found,
            version=version_of(out, bundle.manifest.version),
        ),
        mesh=bundle.mesh,
        known_inputs=known,
    )


def _check_older(bundle: Bundle) -> None:
    """Refuse a bundle that has all that an upgrade adds."""
    manifest = bundle.manifest
    # Synthesis is told the ends of its values alone.
    has_range = manifest.task == "synthesis" and manifest.training_range is not None
    if has_range or bundle.known_inputs is not None:
        raise BundleError(
            f"{bundle.folder} knows already what it was trained on",
            remedy="keep it as it is; bounds of its errors are added by palpate train intervals",
        )


def _rows_of(data: MixedDataset, units: Sequence[str]) -> Rows:
    """All rows of some specimens; none are named = all rows."""
    known = data.experiment.unit_names
    unknown = [unit for unit in units if unit not in known]
    if unknown:
        raise DatasetError(
            f"the data set has no unit {', '.join(unknown)}",
            remedy=f"choose from {', '.join(known)}",
        )
    wanted = [known.index(unit) for unit in units or known]
    rows: Rows = np.flatnonzero(np.isin(data.experiment.row_unit, wanted))
    return rows


def with_coefficients(bundle: Bundle) -> Bundle:
    """A field bundle whose graph also gives the coefficients that it computes on its way.

    Raises:
        BundleError: The graph has no product with its modes.
    """
    manifest = bundle.manifest
    if any(tensor.name == "coefficients" for tensor in manifest.outputs):
        return bundle
    width = manifest.outputs[0].shape[1]
    model, modes = _exposed(bundle.model, width)
    names = {tensor.name for tensor in manifest.outputs} | {"coefficients"}
    inputs, outputs = tensors_of("field", width // 3, optional=names, modes=modes)
    together, _ = run_onnx(model, "electrodes", bundle.golden["electrodes"])
    answers = dict(zip([tensor.name for tensor in outputs], together, strict=True))
    for name, wanted in bundle.golden.items():
        off = np.abs(answers.get(name, wanted) - wanted).max()
        if not off <= PARITY_MAX * np.abs(wanted).max():
            raise BundleError(
                f"{bundle.folder}: {name} of its golden vectors is not what it gives",
                remedy="restore the bundle from where it was made; do not edit bundles",
            )
    return replace(
        bundle,
        model=model,
        golden={**bundle.golden, "coefficients": answers["coefficients"]},
        manifest=replace(
            manifest,
            inputs=inputs,
            outputs=outputs,
            basis=basis_of(model, {tensor.name: tensor for tensor in outputs}),
        ),
    )


def _exposed(model: bytes, width: int) -> tuple[bytes, int]:
    """The graph with the output ``coefficients`` in its place, and their number.

    They are what is multiplied with the modes, whose rows are fields of so many values.
    """
    onnx: Any = require("onnx", extra="training")
    graph = (loaded := onnx.load_from_string(model)).graph
    sizes = {one.name: tuple(one.dims) for one in graph.initializer}
    cast = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "Cast"}
    for node in graph.node:
        if node.op_type != "MatMul":
            continue
        size = sizes.get(cast.get(node.input[1], node.input[1]), ())
        if len(size) != 2 or size[1] != width:
            continue
        name = node.input[0]
        for other in graph.node:
            other.input[:] = ["coefficients" if one == name else one for one in other.input]
            other.output[:] = ["coefficients" if one == name else one for one in other.output]
        batch = graph.output[0].type.tensor_type.shape.dim[0]
        output = onnx.helper.make_tensor_value_info(
            "coefficients", onnx.TensorProto.FLOAT, [batch.dim_param or None, size[0]]
        )
        graph.output.append(output)
        onnx.checker.check_model(loaded, full_check=True)
        return bytes(loaded.SerializeToString(deterministic=True)), int(size[0])
    raise BundleError(
        "the graph multiplies nothing with modes, so it has no coefficients",
        remedy="train the bundle anew: palpate train field",
    )


def _check_mesh(bundle: Bundle, data: MixedDataset) -> None:
    if bundle.manifest.mesh_sha256 != data.mesh.sha256:
        raise BundleError(
            f"{bundle.folder} is for the mesh {bundle.manifest.mesh_sha256[:12]}, the data set has "
            f"{data.mesh.sha256[:12]}",
            remedy="take the data set that it was trained on",
        )
