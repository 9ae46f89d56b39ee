"""A bundle is served only if it keeps its contract; every refusal names the thing."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import BundleError, MissingExtraError
from palpate.files.bundle import Bundle, read_bundle
from palpate_services.inference.model import GOLDEN_TOLERANCE, Runtime, load
from palpate_services.inference.onnx_file import has_external_data
from palpate_services.inference.repository import available, resolve

onnx = pytest.importorskip("onnx")

Make = Callable[..., Path]


def test_good_bundle_answers_its_golden_vectors(bundle: Bundle) -> None:
    runtime = load(bundle, "features")
    for at, sample in enumerate(bundle.golden["electrodes"]):
        answer = runtime.run(sample)
        assert answer is not None
        for name, values in answer.items():
            np.testing.assert_allclose(values, bundle.golden[name][at], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", available())
def test_shipped_bundles_leave_room_for_processors_that_round_otherwise(name: str) -> None:
    shipped = read_bundle(resolve(name))
    session = load(shipped, shipped.manifest.task)
    takes = shipped.manifest.inputs[0].name
    for at, sample in enumerate(shipped.golden[takes]):
        answer = session.run(sample)
        assert answer is not None
        for output, values in answer.items():
            largest = np.abs(shipped.golden[output]).max()
            deviation = np.abs(values - shipped.golden[output][at]).max()
            assert deviation <= 0.2 * GOLDEN_TOLERANCE * largest, (output, at)


def test_answers_keep_their_memory(bundle: Bundle) -> None:
    runtime = load(bundle, "features")
    first = runtime.run(bundle.golden["electrodes"][0])
    assert first is not None
    before = first["force"].tobytes()
    runtime.run(bundle.golden["electrodes"][1])
    assert first["force"].tobytes() == before


def test_corrupt_onnx(make_bundle: Make) -> None:
    with pytest.raises(BundleError, match=r"test:1: model\.onnx does not load.*export"):
        load(read_bundle(make_bundle(model=b"\x00not onnx" * 50)), "features")


def test_model_replaced_after_export(make_bundle: Make) -> None:
    folder = make_bundle()
    with open(folder / "model.onnx", "ab") as model:
        model.write(b"\0")
    with pytest.raises(BundleError, match=r"model\.onnx.*digest differs"):
        read_bundle(folder)


def test_bundle_for_another_task(bundle: Bundle) -> None:
    with pytest.raises(BundleError, match="for the task 'features', not 'field'"):
        load(bundle, "field")


def test_future_contract_version(make_bundle: Make) -> None:
    with pytest.raises(BundleError, match=r"contract v2, this palpate knows v1.*upgrade"):
        read_bundle(make_bundle(contract_version=2))


@pytest.mark.parametrize(
    ("spoiled", "complaint"),
    [
        ({"width": 18}, r"electrodes float32\[-1, 18\].*electrodes float32\[-1, 19\]"),
        ({"outputs": ("force", "force_sd")}, "contact_location"),
        ({"inputs": ("counts",)}, "counts float32"),
        ({"dtype": onnx.TensorProto.DOUBLE}, "electrodes float64"),
    ],
)
def test_graph_that_differs_from_its_manifest(
    make_bundle: Make, recipe: Any, spoiled: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(BundleError, match=complaint):
        load(read_bundle(make_bundle(recipe(**spoiled))), "features")


def test_model_that_answers_nan(make_bundle: Make, recipe: Any) -> None:
    with pytest.raises(BundleError, match="'force' is NaN or infinite"):
        load(read_bundle(make_bundle(recipe(poison=True))), "features")


def test_wrong_golden_vectors(make_bundle: Make) -> None:
    with pytest.raises(BundleError, match=r"'force' deviates from golden\.npz"):
        load(read_bundle(make_bundle(golden_shift=0.01)), "features")


def test_opset_of_the_future(make_bundle: Make, recipe: Any) -> None:
    with pytest.raises(BundleError, match="does not know its opset"):
        load(read_bundle(make_bundle(recipe(opset=99))), "features")


def test_external_data_is_refused_even_where_the_file_exists(
    make_bundle: Make, recipe: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ONNX Runtime would load it: from bytes, it looks in the working directory."""
    path = tmp_path / "model.onnx"
    onnx.save(
        recipe().model(), str(path), save_as_external_data=True, location="w.bin", size_threshold=0
    )
    assert (tmp_path / "w.bin").stat().st_size > 0
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BundleError, match="keeps weights in another file"):
        load(read_bundle(make_bundle(model=path.read_bytes())), "features")


def test_external_data_hidden_in_a_constant_node(recipe: Any) -> None:
    model = recipe().model()
    assert not has_external_data(model.SerializeToString())
    tensor = onnx.numpy_helper.from_array(np.zeros((2, 2), np.float32), "hidden")
    onnx.external_data_helper.set_external_data(tensor, location="elsewhere.bin")
    inner = onnx.helper.make_graph(
        [onnx.helper.make_node("Constant", [], ["c"], value=tensor)], "inner", [], []
    )
    model.graph.node.append(onnx.helper.make_node("If", ["x"], ["y"], then_branch=inner))
    assert has_external_data(model.SerializeToString())


def test_missing_extra(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r'pip install "palpate\[services\]"'):
        load(bundle, "features")


def test_metadata_says_what_is_served(bundle: Bundle) -> None:
    metadata = load(bundle, "features").metadata()
    assert (metadata.name, metadata.version) == ("test", 1)
    assert metadata.bundle_sha256 == bundle.sha256
    assert metadata.metrics == {"force_median_error_n": 0.1}


@pytest.mark.parametrize("name", available())
def test_a_batch_has_the_bits_of_single_runs(name: str) -> None:
    """Of any size and composition: what one sensor's estimate is, no other sensor may change."""
    bundle = read_bundle(resolve(name))
    runtime = load(bundle, bundle.manifest.task)
    golden = bundle.golden[bundle.manifest.inputs[0].name]
    rng = np.random.default_rng(3)
    scale = float(np.abs(golden).max())
    samples = [
        np.asarray(
            row * np.float32(rng.uniform(0, 1)) + rng.normal(0, 0.01 * scale, row.shape), np.float32
        )
        for row in np.tile(golden, (20 // len(golden) + 1, 1))[:20]
    ]
    alone = [runtime.run(sample) for sample in samples]
    for size in range(1, len(samples) + 1):
        for one, other in zip(alone, runtime.run_all(samples[:size]), strict=False):
            assert one is not None
            assert other is not None
            assert {key: value.tobytes() for key, value in one.items()} == {
                key: value.tobytes() for key, value in other.items()
            }


def test_models_of_narrow_inputs_run_in_batches(bundle: Bundle) -> None:
    assert load(bundle, "features").batch_most > 1


def test_a_model_that_computes_a_batch_otherwise_runs_alone(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a kernel does that sums in another order: the last bit of one value differs."""
    whole = Runtime._run_batch

    def other_bits(self: Runtime, samples: Any) -> Any:
        answers = whole(self, samples)
        if len(samples) >= 4 and answers[0] is not None:
            answers[0]["force"][1] = np.nextafter(answers[0]["force"][1], np.float32(1e9))
        return answers

    monkeypatch.setattr(Runtime, "_run_batch", other_bits)
    runtime = load(bundle, "features")
    assert runtime.batch_most == 3
    samples = list(bundle.golden["electrodes"])
    for one, other in zip(map(runtime.run, samples), runtime.run_all(samples), strict=True):
        assert one is not None
        assert other is not None
        assert one["force"].tobytes() == other["force"].tobytes()


def test_one_bad_sample_spoils_no_other_of_its_batch(bundle: Bundle) -> None:
    runtime = load(bundle, "features")
    good = bundle.golden["electrodes"][0]
    first, bad, last = runtime.run_all([good, good * np.float32(np.inf), good])
    assert bad is None
    assert first is not None
    assert last is not None
    assert first["force"].tobytes() == last["force"].tobytes()
