"""What is lost, late, repeated, or a new run of the robot's program."""

from __future__ import annotations

from itertools import count

import pytest

from palpate.messages import Pose, RobotPoseFrame
from palpate_gateway.pose.track import PoseTrack, PoseVerdict

HERE = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
NEW, DROPPED, RESTARTED = PoseVerdict.NEW, PoseVerdict.DROPPED, PoseVerdict.RESTARTED


def frame(sequence: int, time_ms: int | None = None, run: int = 7) -> RobotPoseFrame:
    time_ns = (4 * sequence if time_ms is None else time_ms) * 1_000_000
    return RobotPoseFrame("arm", sequence, time_ns, HERE, run)


def take(track: PoseTrack, *frames: RobotPoseFrame) -> list[PoseVerdict]:
    return [track.take(one) for one in frames]


def counted(track: PoseTrack) -> dict[str, int]:
    return {name: n for name, n in track.counters.items() if n}


def test_in_order() -> None:
    track = PoseTrack()
    assert take(track, *(frame(i) for i in range(500, 520))) == [NEW] * 20
    assert counted(track) == {}, "what was told before anybody listened is not lost"


def test_holes_are_counted_and_told() -> None:
    track = PoseTrack()
    missed = []
    for one in (frame(1), frame(2), frame(5), frame(6), frame(16)):
        assert track.take(one) is NEW
        missed.append(track.missed_before)
    assert missed == [0, 0, 2, 0, 9]
    assert counted(track) == {"lost_poses": 11}


def test_a_hole_is_not_more_than_a_stamp_can_say() -> None:
    track = PoseTrack()
    take(track, frame(1), frame(1 << 40))
    assert track.missed_before == 0xFFFF_FFFF
    assert track.counters["lost_poses"] == (1 << 40) - 2


def test_one_pose_told_several_times_is_one_reading() -> None:
    track = PoseTrack()
    told = [frame(1, 4), frame(2, 4), frame(3, 4), frame(5, 4), frame(6, 8), frame(6, 8)]
    assert take(track, *told) == [NEW, DROPPED, DROPPED, DROPPED, NEW, DROPPED]
    assert counted(track) == {"repeated_poses": 4, "lost_poses": 1}
    assert track.missed_before == 1, "the hole was before the pose that came through"


@pytest.mark.parametrize("run", [0, 7])
def test_late_ones_are_dropped(run: int) -> None:
    track = PoseTrack()
    take(track, frame(1, run=run), frame(2, run=run), frame(6, run=run))
    late = [frame(i, run=run) for i in (3, 4, 5)]  # another path of the network was slower
    assert take(track, *late, frame(7, run=run)) == [DROPPED] * 3 + [NEW]
    assert counted(track) == {"lost_poses": 3, "late_poses": 3}


def test_a_program_that_tells_its_run_is_known_at_once() -> None:
    track = PoseTrack()
    take(track, frame(1000), frame(1001))
    assert track.take(frame(1, run=8)) is RESTARTED
    track.begin()
    assert take(track, frame(2, run=8), frame(3, run=8)) == [NEW, NEW]


def test_of_two_programs_with_one_name_the_later_one_counts() -> None:
    track = PoseTrack()
    take(track, frame(1), frame(2))
    assert track.take(frame(1, run=8)) is RESTARTED
    track.begin()
    both = [frame(3), frame(2, run=8), frame(4), frame(3, run=8)]
    assert take(track, *both) == [DROPPED, NEW, DROPPED, NEW]
    assert counted(track) == {"poses_of_old_runs": 2}


def _until_restarted(track: PoseTrack, frames: list[RobotPoseFrame]) -> int:
    for number in count(1):
        verdict = track.take(frames.pop(0))
        if verdict is RESTARTED:
            return number
        assert verdict is DROPPED
    raise AssertionError


def test_a_program_that_tells_no_run_and_whose_clock_goes_on() -> None:
    track = PoseTrack()
    take(track, frame(1000, run=0))
    assert track.take(frame(1, 5000, run=0)) is RESTARTED


def test_a_program_that_tells_no_run_and_whose_clock_begins_anew() -> None:
    track = PoseTrack()
    take(track, frame(1000, run=0))
    assert _until_restarted(track, [frame(i, run=0) for i in range(1, 30)]) == 10
    track.begin()
    assert track.take(frame(11, run=0)) is NEW


def test_a_clock_that_went_back_is_told_as_a_new_run_once_that_is_certain() -> None:
    track = PoseTrack()
    take(track, frame(1, 10_000), frame(2, 10_004))
    assert _until_restarted(track, [frame(i, 4 * i) for i in range(3, 40)]) == 10


def test_one_wrong_time_is_left_out() -> None:
    track = PoseTrack()
    told = [frame(1, 100), frame(2, 104), frame(3, 8), frame(4, 112), frame(5, 116)]
    assert take(track, *told) == [NEW, NEW, DROPPED, NEW, NEW]
    assert counted(track) == {"wrong_times": 1, "lost_poses": 1}
