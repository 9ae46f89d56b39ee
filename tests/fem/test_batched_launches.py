"""A launch that is used again does what a new one would do."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from tests.fem.batched_cases import DEVICE

from palpate_fem.batched import launches
from palpate_fem.batched.kernels import copy_lane, gather_load
from palpate_fem.batched.launches import Launches, Listed, Sequences


def ints(*values: int) -> wp.array:
    return wp.array(np.array(values, np.int32), dtype=wp.int32, device=DEVICE)


def vectors(seed: int, lanes: int = 2, size: int = 3) -> wp.array:
    values = np.random.default_rng(seed).normal(size=(4, lanes, size))
    return wp.array(values, dtype=wp.float64, device=DEVICE)


def test_lists_dimensions_and_numbers_may_change() -> None:
    launch, source = Launches(DEVICE), vectors(1)
    for listed, lane, to, size in (
        ((0, 2), 0, 1, 3),
        ((1,), 0, 1, 3),
        ((3, 0), 1, 0, 2),
        ((0, 2), 0, 1, 3),
    ):
        out = wp.zeros_like(source)
        launch(copy_lane, (len(listed), size), [ints(*listed), source, lane], [out, to])
        wanted = np.zeros(source.shape)
        for slot in listed:
            wanted[slot, to, :size] = source.numpy()[slot, lane, :size]
        np.testing.assert_array_equal(out.numpy(), wanted)


def test_a_list_that_was_changed_in_place_is_read_anew() -> None:
    launch, source, out = Launches(DEVICE), vectors(2), vectors(3)
    listed = ints(1)
    launch(copy_lane, (1, 3), [listed, source, 0], [out, 0])
    listed.assign(np.array([2], np.int32))
    launch(copy_lane, (1, 3), [listed, source, 0], [out, 0])
    np.testing.assert_array_equal(out.numpy()[1:3, 0], source.numpy()[1:3, 0])


@pytest.mark.parametrize("sign", [1.0, 0.0, -2.0])
def test_numbers_of_warps_own_tell_launches_apart(sign: float) -> None:
    launch, field = Launches(DEVICE), vectors(4)
    rows = wp.array(field.numpy()[:, 0], dtype=wp.float64, device=DEVICE)
    for factor in (3.0, sign):
        out = wp.zeros((4, 1, 3), dtype=wp.float64, device=DEVICE)
        free = ints(0, 1, 2)
        launch(gather_load, (1, 3), [ints(0), free, 1, wp.float64(factor), rows], [out, 0])
        np.testing.assert_array_equal(out.numpy()[0, 0], factor * rows.numpy()[0])


def test_nothing_is_launched_for_an_empty_list() -> None:
    Launches(DEVICE)(copy_lane, (0, 3), [ints(), vectors(1), 0], [vectors(2), 0])


def test_no_more_are_kept_than_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launches, "KEPT", 3)
    launch, source = Launches(DEVICE), vectors(5)
    outs = [vectors(k) for k in range(8)]
    for out in outs:
        launch(copy_lane, (1, 3), [ints(2), source, 1], [out, 0])
        np.testing.assert_array_equal(out.numpy()[2, 0], source.numpy()[2, 1])
    assert len(launch._kept) <= 3


def test_a_sequence_reads_its_arguments_each_time() -> None:
    """On a GPU the first run of so many slots compiles, the second makes a graph for others."""
    launch, run, source, out = Launches(DEVICE), Sequences(DEVICE), vectors(4), vectors(5)
    one_element = (1, 0, 0)  # of each slot, so it has the slot's number

    def copy(slots: wp.array, of: wp.array, lane: int, to: int) -> None:
        launch(copy_lane, (len(slots), 3), [slots, of, lane], [out, to])

    def twice(listed: Listed, others: Listed, of: wp.array, lane: int, to: int) -> None:
        copy(listed.slots, of, lane, to)
        run(copy, others.elements, of, lane, 1 - to)

    for seed in range(5):
        source.assign(vectors(10 + seed))
        for slots, others in (([2], []), ([0, 3], [1]), ([3, 1], [0]), ([1], [0, 3])):
            for lane, to in ((0, 1), (1, 0), (1, 1)):
                out.zero_()
                lists = [Listed(np.array(some), one_element, launch) for some in (slots, others)]
                run(twice, *lists, source, lane, to)
                wanted = np.zeros(source.shape)
                wanted[slots, to] = source.numpy()[slots, lane]
                wanted[others, 1 - to] = source.numpy()[others, lane]
                np.testing.assert_array_equal(out.numpy(), wanted)
