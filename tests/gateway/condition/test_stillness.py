from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest

from palpate.messages import ElectrodeFrame, SensorType
from palpate_gateway.condition.stillness import (
    FrameBlock,
    FrameBlocks,
    StillLimits,
    evidence_of,
    evidence_of_blocks,
)

fakes: Any = importlib.import_module("condition_fakes")
ALL = np.ones(19, np.bool_)
STILL = StillLimits()


def blocks(frames: list[ElectrodeFrame]) -> list[FrameBlock]:
    made = FrameBlocks(frames[0].sensor_type.layout, fakes.RATE_HZ)
    return [block for frame in frames if (block := made.add(frame)) is not None]


def test_blocks_say_what_whole_frames_say() -> None:
    frames = list(fakes.Finger(1).frames(0.6))
    by_blocks = evidence_of_blocks(blocks(frames), ALL)
    by_frames = evidence_of(
        np.array([frame.electrodes for frame in frames], np.float64),
        np.array([frame.pac for frame in frames], np.float64),
        np.array([frame.pdc for frame in frames], np.float64),
    )
    assert by_blocks.electrode == by_frames.electrode
    assert by_blocks.electrode_sd == pytest.approx(by_frames.electrode_sd)
    assert by_blocks.pac_sd == pytest.approx(by_frames.pac_sd)
    assert by_blocks.pdc_sd == pytest.approx(by_frames.pdc_sd)


def test_noise_is_still() -> None:
    for noise in (0.0, 0.5, 5.0):
        finger = fakes.Finger(2)
        finger.noise = noise
        for _ in range(50):
            assert evidence_of_blocks(blocks(list(finger.frames(0.6))), ALL).motion(STILL) == ""


def test_each_kind_of_movement_is_named() -> None:
    finger = fakes.Finger(3)
    frames = list(finger.frames(0.3))
    finger.offset[4] -= 100.0
    frames += finger.frames(0.3)
    motion = evidence_of_blocks(blocks(frames), ALL).motion(STILL)
    assert motion == "E5 varies by 51 counts (sd) over 60 frames, at most 25 are allowed"

    finger = fakes.Finger(3)
    finger.pac_noise = 20.0
    motion = evidence_of_blocks(blocks(list(finger.frames(0.6))), ALL).motion(STILL)
    assert motion == "PAC varies by 20 counts (sd) over 60 frames, at most 9 are allowed"

    finger = fakes.Finger(3)
    frames = []
    for _ in range(60):
        finger.pdc += 0.2
        frames.append(finger.frame())
    motion = evidence_of_blocks(blocks(frames), ALL).motion(STILL)
    assert motion.startswith("PDC varies by 3.5 counts")

    finger = fakes.Finger(3)
    frames = []
    for _ in range(60):
        finger.offset -= 0.5
        frames.append(finger.frame())
    motion = evidence_of_blocks(blocks(frames), ALL).motion(STILL)
    assert motion.startswith("electrodes shift by 20")


def test_who_looks_at_electrodes_only_sees_nothing_else() -> None:
    finger = fakes.Finger(4)
    finger.pac_noise = 100.0
    frames = []
    for _ in range(60):
        finger.pdc += 1.0
        finger.offset -= 0.5
        frames.append(finger.frame())
    limits = StillLimits(pac_sd=math.inf, pdc_sd=math.inf)
    assert evidence_of_blocks(blocks(frames), ALL).motion(limits) == ""


def test_an_electrode_that_is_left_out_moves_nothing() -> None:
    finger = fakes.Finger(5)
    frames = list(finger.frames(0.3))
    finger.fixed[6] = 0
    frames += finger.frames(0.3)
    assert "E7" in evidence_of_blocks(blocks(frames), ALL).motion(STILL)
    usable = ALL.copy()
    usable[6] = False
    assert evidence_of_blocks(blocks(frames), usable).motion(STILL) == ""


def test_invalid_words_do_not_count() -> None:
    """A wrong word now and then, as parity errors make them."""
    finger = fakes.Finger(6)
    frames = []
    for k in range(20):
        finger.fixed = {2: 17} if k % 3 == 0 else {}
        finger.invalid = (1 << 2 | 1 << LAYOUT.first_pac_bit) if k % 3 == 0 else 0
        frames.append(finger.frame())
    (block,) = blocks(frames)
    assert block.seen.tolist() == [20, 20, 13] + [20] * 16
    assert block.low[2] > 2800
    assert block.mean[2] == pytest.approx(2850.0, abs=5.0)
    assert block.pac_seen == 20 * 22 - 7
    assert block.slow_seen == (20, 20, 20)


def test_a_channel_that_never_answers_has_no_numbers() -> None:
    finger = fakes.Finger(7)
    finger.invalid = 1 << 3 | 1 << LAYOUT.pdc_bit | (LAYOUT.all_valid >> 22 << 22)
    (block,) = blocks(list(finger.frames(0.2)))
    assert block.seen[3] == 0
    assert block.pac_seen == 0
    assert block.pac_variance == 0.0
    assert block.slow_seen == (0, 20, 20)


def test_a_biotac_sp_has_more_of_everything() -> None:
    (block,) = blocks(list(fakes.Finger(8, kind=SensorType.BIOTAC_SP).frames(0.2)))
    assert block.mean.shape == (24,)
    assert block.pac_seen == 20 * 27
    assert block.tdc_mean == 1900.0


LAYOUT = SensorType.BIOTAC.layout
