"""Who is who over time."""

from __future__ import annotations

import numpy as np
import pytest

from ahoy_core.perceive.detection import Detection
from ahoy_core.perceive.tracking import NoPersonError, choose, link


def person(x: float, half: float = 20.0) -> Detection:
    points = np.array([[x, 50.0], [x, 50.0 - half], [x, 40.0], [x, 30.0]])
    return Detection(np.array([x - 5, 10.0, x + 5, 20.0]), points, 0.9)


def test_two_people_passing_through_keep_their_tracks_and_the_larger_one_leads() -> None:
    detections = [[person(20 + 2 * t), person(150 - 2 * t, half=30.0)] for t in range(10)]
    tracks = link(detections, np.zeros(10, int))
    assert [len(t.rois) for t in tracks] == [10, 10]
    assert tracks[0].rois[0].cx == 150 and tracks[0].rois[9].cx == 132
    assert tracks[1].rois[9].cx == 38


def test_a_short_gap_is_bridged_and_the_crop_interpolated() -> None:
    detections = [[person(10.0)], [], [person(14.0)]]
    (track,) = link(detections, np.zeros(3, int))
    assert track.near(1).cx == pytest.approx(12.0)
    assert track.near(5).cx == pytest.approx(14.0)


def test_a_cut_ends_tracks_and_the_default_subject_goes_on_in_the_next_shot() -> None:
    shot = np.array([0, 0, 1, 1])
    tracks = link([[person(10.0)]] * 4, shot)
    assert len(tracks) == 2
    assert sorted(choose(tracks, shot, None).rois) == [0, 1, 2, 3]
    assert len(choose(tracks, shot, 0).rois) == 2


def test_no_person_and_a_subject_that_is_not_there_are_clear_errors() -> None:
    with pytest.raises(NoPersonError, match="at least one of 3 frames, got none"):
        choose(link([[], [], []], np.zeros(3, int)), np.zeros(3, int), None)
    with pytest.raises(NoPersonError, match="from 0 to 0, got 4"):
        choose(link([[person(10.0)]], np.zeros(1, int)), np.zeros(1, int), 4)
