"""Faults of one name that overlap."""

from __future__ import annotations

import pytest

from palpate_gateway.emulators.kms40 import Kms40Emulator


@pytest.mark.parametrize("second_s", [0.0, 1.0])
@pytest.mark.parametrize("first_s", [10.0, 0.0])
def test_a_fault_goes_on_until_the_later_of_both_ends(first_s: float, second_s: float) -> None:
    emulator = Kms40Emulator()
    emulator.inject("silence", first_s)
    emulator.inject("silence", second_s)
    lasts = max(first_s, second_s) > 0.0
    assert [emulator.faulty("silence") for _ in range(3)] == [True, lasts, lasts]
    emulator.end("silence")
    assert not emulator.faulty("silence")


def test_a_fault_that_is_over_and_was_not_asked_for_does_not_swallow_the_next() -> None:
    emulator = Kms40Emulator()
    emulator.inject("silence", 1e-9)
    emulator.inject("silence")
    assert [emulator.faulty("silence") for _ in range(2)] == [True, False]
