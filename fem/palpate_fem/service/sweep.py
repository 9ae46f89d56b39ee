"""A sweep into a store: what is there already is not run again."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from palpate_fem.indenter.outline import outline_of
from palpate_fem.result import IndentationResult
from palpate_fem.service.batch import Batch, BatchReport, OnReport, Plan
from palpate_fem.store.files import StoreTakenError
from palpate_fem.store.writer import Place, StoreWriter


def sweep_into_store(
    batch: Batch,
    plans: Sequence[Plan],
    path: Path,
    *,
    stop: threading.Event,
    on_report: OnReport | None = None,
    stress: bool = False,
    command: str = "",
) -> tuple[BatchReport, int]:
    """Run what a store does not hold yet; each trajectory is on the disk as soon as it has ended.

    Several sweeps, of one command line or of several, may fill one store at the same time. Each
    trajectory carries the outline of its indenter, for pictures.

    Args:
        batch: Runs them; closed by whoever made it.
        plans: All that the store is to hold.
        path: The store, ``NAME.sim``; made if it is not there.
        stop: Set it to end early; what runs then is not kept.
        on_report: Called whenever something has happened.
        stress: Whether to keep stress.
        command: What runs it, for people.

    Returns:
        How it went, and how many were there already.

    Raises:
        DatasetError: The store is another fingertip's, damaged, in use, or the disk refuses.
        RemoteError: The solver does not start.
    """
    fingertip = batch.fingertip(stop)
    if fingertip is None:
        return BatchReport(len(plans), stopped=True), 0
    with StoreWriter(
        path, fingertip, shared=True, outline=outline_of, stress=stress, command=command
    ) as store:
        done = store.done()
        left = [plan for plan in plans if plan.name not in done]
        places: dict[str, Place] = {}

        def claimed() -> Iterator[Plan]:
            for plan in left:
                with contextlib.suppress(StoreTakenError):  # another process is at it, or was
                    places[plan.name] = store.claim(plan.name)
                    yield plan

        def keep(plan: Plan, trajectory: IndentationResult) -> None:
            with places.pop(plan.name) as place:
                place.write(trajectory)

        try:
            report = batch.run(
                claimed(), len(left), stop=stop, on_trajectory=keep, on_report=on_report
            )
        finally:
            for place in places.values():
                place.close()  # lets go of what was not written
    return report, len(plans) - len(left)
