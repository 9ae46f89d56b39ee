"""From a described contact to electrodes: the shipped synthesis bundle asks the real solver.

Both rooms agree on the mesh only here: services/README.md names the option that this test sets.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("warp", reason="palpate[fem] is not installed")
pytest.importorskip("onnxruntime", reason="palpate[services] is not installed")

from palpate.client import Client
from palpate.config import LinkConfig
from palpate.messages import ContactDescription, SimulationOutcome
from palpate_fem.service.config import FemConfig
from palpate_fem.service.node import run
from palpate_services.config import SynthesisServiceConfig
from palpate_services.inference.services import run_estimating

EDGE_M = 0.6e-3
"""Edge of the shipped bundle's mesh [m]."""

PATIENCE_S = 240.0
"""The solver needs seconds; a busy host may need minutes."""


@pytest.fixture
def robot(link: LinkConfig) -> Iterator[Client]:
    stop = threading.Event()
    fem = FemConfig(workers=1, threads=1, options={"edge_m": EDGE_M})
    nodes = [
        threading.Thread(target=run, args=(fem, link, "lab", stop)),
        threading.Thread(target=run_estimating, args=(SynthesisServiceConfig(), link, "lab", stop)),
    ]
    for node in nodes:
        node.start()
    try:
        with Client(link.connect[0], timeout_s=10.0) as client:
            yield client
    finally:
        stop.set()
        for node in nodes:
            node.join(timeout=30)


@pytest.mark.essential
def test_the_shipped_services_feel_a_contact_that_was_only_described(robot: Client) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while sum(a.ready for a in robot.alive()) < 2:
        assert time.monotonic() < deadline, "solver or synthesis service did not become ready"
        time.sleep(0.1)
    press = ContactDescription("sphere_medium", location=(-0.006, 0.0, -0.009), force_n=2.0)
    reply = robot.synthesise_from(press, timeout_s=PATIENCE_S)
    assert reply.outcome is SimulationOutcome.COMPLETE
    assert reply.stopped_because == ""
    assert reply.step is not None
    assert reply.estimate is not None
    force = reply.step.force
    assert np.linalg.norm(force) == pytest.approx(2.0, rel=1e-3)
    assert force[2] > 0.9 * 2.0  # the pad is pushed towards the nail
    assert reply.estimate.bundle_name == "synthesis-twin"
    # Between E17 and E18 the skin comes nearer; the fluid goes to the sides, on both alike.
    counts = reply.estimate.tared_counts
    assert counts[16] < -40
    assert counts[17] < -15
    left, right = counts[[0, 3, 5]], counts[[10, 13, 15]]
    assert min(left.min(), right.min()) > 100
    np.testing.assert_allclose(left, right, rtol=0.1)
