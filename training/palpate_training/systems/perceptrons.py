"""Fully connected networks: the paper's, Wettels and Loeb 2011, Su 2015."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from palpate_training.learning.fit import FeaturesFitConfig, fit_quantity
from palpate_training.learning.networks import predict
from palpate_training.systems.samples import Estimate, Quantity, Samples, System, error_of

PAPER_CONFIG = FeaturesFitConfig(epochs=60, patience=20)
"""The paper's layers; it states neither activation nor learning rate."""

SMALL_CONFIG = replace(PAPER_CONFIG, activation="tanh", epochs=40, patience=10)
WETTELS_WIDTHS = (10, 20, 40)
SU_WIDTHS = (10, 20, 38, 64)
"""Neurons of a hidden layer; not published, so that the validation rows choose."""


def fit_perceptron(
    config: FeaturesFitConfig,
    choices: Sequence[Sequence[int]],
    quantity: Quantity,
    train: Samples,
    validation: Samples,
    seed: int,
) -> Estimate:
    """The best, by the validation rows, of networks with these hidden layers."""
    seen = validation.tared, validation.truth(quantity)
    nets = [
        fit_quantity(
            train.tared,
            train.truth(quantity),
            seen,
            config=replace(config, widths=widths),
            seed=seed,
        )
        for widths in choices
    ]
    best = nets[int(np.argmin([error_of(predict(net, seen[0]), seen[1]) for net in nets]))]
    return lambda samples: predict(best, samples.tared)


PERCEPTRONS = (
    System(
        "MLP (the paper's)",
        "Narang et al. 2021, section on tactile features",
        partial(fit_perceptron, PAPER_CONFIG, [PAPER_CONFIG.widths]),
        ("location", "force", "centre", "normal"),
        seeded=True,
    ),
    System(
        "Wettels 2011: MLP",
        "Wettels and Loeb, ROBIO 2011",
        partial(fit_perceptron, SMALL_CONFIG, [(width,) for width in WETTELS_WIDTHS]),
        ("force",),
        seeded=True,
    ),
    System(
        "Su 2015: 2-layer MLP",
        "Su et al., Humanoids 2015",
        partial(fit_perceptron, SMALL_CONFIG, [(width,) for width in SU_WIDTHS]),
        ("force",),
        seeded=True,
    ),
    System(
        "Su 2015: 4-layer MLP",
        "Su et al., Humanoids 2015",
        partial(fit_perceptron, SMALL_CONFIG, [(width,) * 3 for width in SU_WIDTHS]),
        ("force",),
        seeded=True,
    ),
)
