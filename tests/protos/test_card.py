"""A model card says what the manifest says, for every task and for bundles of any age."""

from __future__ import annotations

from dataclasses import replace

import pytest

from palpate.files.bundle import read_bundle
from palpate.files.card import model_card
from palpate_services.inference.repository import resolve


@pytest.mark.parametrize("name", ["features-twin", "field-twin", "synthesis-twin"])
def test_a_card_holds_every_tensor_metric_and_digest(name: str) -> None:
    bundle = read_bundle(resolve(name))
    manifest = bundle.manifest
    card = model_card(manifest, bundle.sha256)
    assert card.startswith(f"# {name} {manifest.version}\n")
    wanted = [bundle.sha256.hex(), manifest.training_data_sha256, manifest.trained_on]
    wanted += [f"`{tensor.name}`" for tensor in (*manifest.inputs, *manifest.outputs)]
    wanted += [f"`{metric}`" for metric in manifest.metrics]
    assert [word for word in wanted if word not in card] == []


def test_units_of_metrics_are_those_of_people() -> None:
    bundle = read_bundle(resolve("field-twin"))
    metrics = {
        "nodal_all_m": 2.5e-5,
        "nodal_all_m_above_8n": 7.1e-5,
        "force_angle_median_rad": 0.0723,
        "skill_all": 0.9,
    }
    card = model_card(replace(bundle.manifest, metrics=metrics), bundle.sha256)
    for row in (
        "| `nodal_all_m` | 0.025 | mm |",
        "| `nodal_all_m_above_8n` | 0.071 | mm |",
        "| `force_angle_median_rad` | 0.0723 | rad |",
        "| `skill_all` | 0.9 |  |",
    ):
        assert row in card


def test_a_bundle_that_does_not_say_where_it_was_trained_has_a_card() -> None:
    bundle = read_bundle(resolve("features-virtual"))
    card = model_card(replace(bundle.manifest, training_range=None), bundle.sha256)
    assert "Not known" in card
