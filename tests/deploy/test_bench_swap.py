"""``palpate bench swap`` judges every estimate by its frame, its tare and its bundle."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from palpate import clock
from palpate.bus import ReceivedMessage, Session, endpoints
from palpate.bus.tares import TareBook
from palpate.codec import FEATURE_ESTIMATE
from palpate.config import LinkConfig
from palpate.files.bundle import read_bundle
from palpate.messages import Tare
from palpate_deploy.bench.codec import bench_frame
from palpate_deploy.bench.swap import Account, Judge, goal_met
from palpate_services.inference.estimates import EstimateRefusal, estimate
from palpate_services.inference.model import load
from palpate_services.inference.repository import resolve


def test_estimates_on_a_tare_from_before_the_bench_listened_are_judged(
    link: LinkConfig, bundle: str
) -> None:
    """The tare is asked for while the gateway is there; they are judged when it is not."""
    found = read_bundle(resolve(bundle))
    runtime = load(found, "features")
    frames = [bench_frame(index) for index in range(20)]
    first = frames[0]
    tare = Tare(
        tare_id=first.tare_id,
        stamp=first.stamp,
        sensor_serial=first.sensor_serial,
        electrodes=first.electrodes.astype(np.float32),
        electrodes_sd=np.full(19, 1.5, np.float32),
        pdc=float(first.pdc),
        pac=float(first.pac.mean()),
        tac=float(first.tac),
        tdc=float(first.tdc),
        frames_averaged=100,
    )
    right, others = [estimate(frame, tare, runtime) for frame in frames], frames[1:] + frames[:1]
    seen, given = [], []
    for frame, other, answer in zip(frames, others, right, strict=True):
        assert not isinstance(answer, EstimateRefusal)
        wrong = estimate(other, tare, runtime)
        assert not isinstance(wrong, EstimateRefusal)
        made = wrong if frame is frames[4] else answer  # the fifth is that of another frame
        payload = FEATURE_ESTIMATE.encode(made)
        at_ns = frame.stamp.monotonic_ns
        seen.append(ReceivedMessage(frame, b"", "test", "finger", at_ns))
        given.append(ReceivedMessage(answer, payload, "test", "finger", at_ns))
    with Session.open(link, station="test") as gateway:
        gateway.queryable(endpoints.TARE, lambda _: tare, sensor="finger")
        with Session.open(link, station="test") as session:
            witness: Any = SimpleNamespace(frames=seen, estimates=given)
            judge = Judge(witness, {found.sha256: runtime}, TareBook(session))
    account = judge.account(0, clock.now()[0] + 1, Counter())
    assert (account.frames, account.lost, account.repeated, account.mixed) == (20, 0, 0, 1)
    assert account.bundles == {runtime.label: 20}


def test_no_frame_is_no_goal() -> None:
    """As of a gateway that hangs: it loses none."""
    account = Account(frames=300, lost=0, repeated=0, mixed=0, gap_max_s=0.02)
    assert goal_met(account, [0.01, 0.02], due=320.0)
    assert not goal_met(replace(account, frames=0), [0.01], due=320.0)
    assert not goal_met(replace(account, frames=100), [0.01], due=320.0)
    assert not goal_met(replace(account, lost=1), [0.01], due=320.0)
    assert not goal_met(account, [0.01, 0.2], due=320.0)
