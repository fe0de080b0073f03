"""Who is who over time."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ahoy_core.perceive import people
from ahoy_core.perceive.appearance import appearance, unlikeness
from ahoy_core.perceive.crop import Roi
from ahoy_core.perceive.detection import Detection
from ahoy_core.perceive.people import subject_sheet, subjects, worthwhile
from ahoy_core.perceive.tracking import NoPersonError, Track, belongs_to_another, choose, link

RED, BLUE = np.eye(8, dtype=np.float32)[:2]


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


@pytest.mark.parametrize("hidden", [0, 3])
def test_two_who_walk_past_each_other_are_not_swapped(hidden: int) -> None:
    """The one behind is not detected for a while, and the order of the detections says nothing."""
    detections, looks = [], []
    for t in range(21):
        both = [(person(20 + 4 * t), RED), (person(100 - 4 * t), BLUE)]
        if abs(t - 10) < hidden:
            both = both[:1]
        both = both[::-1] if t % 2 else both
        detections.append([d for d, _ in both])
        looks.append([look for _, look in both])
    people = link(detections, np.zeros(21, int), looks)
    assert len(people) == 2
    for track in people:
        start, end = track.rois[0].cx, track.rois[20].cx
        assert (start, end) in ((20.0, 100.0), (100.0, 20.0))


def test_two_who_turn_round_behind_each_other_are_told_apart_by_their_looks() -> None:
    """They meet, one vanishes, and each goes back to where they came from: motion alone would swap them."""
    away = [4.0 * abs(t - 10) for t in range(21)]
    detections, looks = [], []
    for t, d in enumerate(away):
        both = [(person(60 - d), RED), (person(60 + d), BLUE)]
        both = both[:1] if abs(t - 10) < 3 else both
        detections.append([d for d, _ in both])
        looks.append([look for _, look in both])
    people = link(detections, np.zeros(21, int), looks)
    assert sorted((p.rois[0].cx, p.rois[20].cx) for p in people) == [(20.0, 20.0), (100.0, 100.0)]


def test_people_are_known_again_after_a_cut_wherever_they_stand() -> None:
    shot = np.array([0] * 4 + [1] * 4)
    detections = [[person(20.0), person(90.0)]] * 4 + [[person(25.0), person(95.0)]] * 4
    looks = [[RED, BLUE]] * 4 + [[BLUE, RED]] * 4
    people = link(detections, shot, looks)
    assert sorted((p.rois[0].cx, p.rois[7].cx) for p in people) == [(20.0, 95.0), (90.0, 25.0)]
    assert choose(people, shot, None) is people[0] and choose(people, shot, 1) is people[1]


def test_a_stranger_after_a_cut_is_another_person() -> None:
    shot = np.array([0, 0, 1, 1])
    people = link([[person(10.0)]] * 4, shot, [[RED]] * 2 + [[BLUE]] * 2)
    assert [sorted(p.rois) for p in people] == [[0, 1], [2, 3]]


def test_a_followed_crop_that_slips_onto_somebody_else_is_noticed() -> None:
    mine, other = Track({0: Roi(10, 50, 50, 0)}), Track({0: Roi(90, 50, 50, 0), 1: Roi(60, 50, 50, 0)})
    assert belongs_to_another(Roi(58, 50, 50, 0), mine, [mine, other], 1)
    assert not belongs_to_another(Roi(12, 50, 50, 0), mine, [mine, other], 1)
    # Where the subject was found as well, the nearer of the two decides, and neither is accused when they are one heap.
    assert belongs_to_another(Roi(90, 50, 50, 0), mine, [mine, other], 0)
    assert not belongs_to_another(Roi(14, 50, 50, 0), mine, [mine, other], 0)
    heap = Track({0: Roi(12, 50, 50, 0)})
    assert not belongs_to_another(Roi(11, 50, 50, 0), mine, [mine, heap], 0)


def test_no_person_and_a_subject_that_is_not_there_are_clear_errors() -> None:
    with pytest.raises(NoPersonError, match="at least one of 3 frames, got none"):
        choose(link([[], [], []], np.zeros(3, int)), np.zeros(3, int), None)
    with pytest.raises(NoPersonError, match=r"from 0 to 0, got 4.*--list-subjects"):
        choose(link([[person(10.0)]], np.zeros(1, int)), np.zeros(1, int), 4)


def dressed_figure(shirt: tuple[int, int, int], light: float = 1.0) -> NDArray[np.uint8]:
    frame = np.full((80, 80, 3), 90, np.uint8)
    frame[28:50, 30:50] = shirt
    frame[50:75, 30:50] = (60, 60, 120)
    return np.clip(frame * light, 0, 255).astype(np.uint8)


def test_looks_are_the_same_in_other_light_and_differ_by_clothes() -> None:
    red, dim, green = dressed_figure((200, 40, 40)), dressed_figure((200, 40, 40), 0.85), dressed_figure((40, 170, 60))
    looks = [appearance(frame, person(40.0)) for frame in (red, dim, green)]
    assert unlikeness(looks[0], looks[0]) == pytest.approx(0.0, abs=1e-3)
    assert unlikeness(looks[0], looks[1]) < 0.5 < unlikeness(looks[0], looks[2])
    outside = appearance(red, person(500.0))
    assert np.isfinite(outside).all() and float(np.linalg.norm(outside)) == pytest.approx(1.0, abs=1e-5)


def test_the_sheet_shows_a_row_for_each_person_and_passers_by_are_not_worth_an_avatar() -> None:
    people = link([[person(20.0), person(150.0, half=60.0)]] * 8 + [[person(150.0, half=60.0)]] * 40, np.zeros(48, int))
    rows = subjects(people, np.zeros(48, int))
    assert [(r.number, r.frames, r.first, r.last) for r in rows] == [(0, 48, 0, 47), (1, 8, 0, 7)]
    assert worthwhile(people) == [0]
    sheet = subject_sheet(np.zeros((48, 100, 200, 3), np.uint8), people)
    assert sheet.shape == (512, 1024, 3) and sheet.dtype == np.uint8


def test_somebody_whom_a_tile_shows_with_a_smaller_head_is_not_somebody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a wide picture the whole frame and a tile see the same person, whose heads overlap too little to be merged."""
    width, height = 200, 100
    small_head = np.array([58.5, 10.0, 61.5, 14.0])

    def seen(networks: object, frame: NDArray[np.uint8]) -> list[Detection]:
        if frame.shape[1] == width:
            return [person(60.0)]
        there = Detection(small_head, person(60.0, half=18.0).keypoints, 0.8)
        return [there] if frame[0, 0, 0] == 0 else [person(70.0)]  # the tile on the right shows another, at 170

    monkeypatch.setattr(people, "detect", seen)
    frames = np.zeros((8, height, width, 3), np.uint8)
    frames[:, :, width - height :] = 1
    found = people.find_people(None, frames, np.zeros(8, int))  # type: ignore[arg-type]
    assert sorted(round(track.rois[0].cx) for track in found) == [60, 170]
