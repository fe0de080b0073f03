"""Two rendered people walk past each other before the real networks: nobody becomes the other."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ahoy_core.perceive.landmarks import run_landmarks
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.people import find_people

FRAMES, HEIGHT, WIDTH = 22, 256, 448
HIPS = (23, 24)


def sprites(folder: Path) -> list[NDArray[np.float64]]:
    """The captured person alone, RGBA, in the frames that have it."""
    paths = sorted((folder / "gt").glob("front_*.png"))
    return [np.asarray(cv2.imread(str(p), cv2.IMREAD_UNCHANGED))[..., [2, 1, 0, 3]].astype(np.float64) for p in paths]


@pytest.fixture(scope="module")
def passing(shared_dir: Path) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Frames [T,H,W,3], and where the middle of each person is, [T,2] in x; the second one passes in front."""
    cast = [sprites(shared_dir / "captures" / name) for name in "ab"]
    frames, places = [], []
    for t in range(FRAMES):
        share = t / (FRAMES - 1)
        canvas = np.full((HEIGHT, WIDTH, 3), 150.0)
        canvas[200:] = 90.0
        middles = []
        for people, shift in zip(cast, (share * 192, (1 - share) * 192), strict=True):
            sprite = people[t % len(people) if t % 16 < 8 else 7 - t % 8]
            x = round(shift)
            alpha = sprite[..., 3:] / 255
            canvas[:, x : x + 256] = alpha * sprite[..., :3] + (1 - alpha) * canvas[:, x : x + 256]
            middles.append(x + float(np.average(np.arange(256), weights=sprite[..., 3].sum(0))))
        frames.append(canvas.round().astype(np.uint8))
        places.append(middles)
    return np.stack(frames), np.array(places)


@pytest.mark.shared
def test_people_who_cross_are_two_and_stay_themselves(
    passing: tuple[NDArray[np.uint8], NDArray[np.float64]], networks: Networks
) -> None:
    frames, places = passing
    people = find_people(networks, frames, np.zeros(FRAMES, int))[:2]
    assert len(people) == 2
    owners = []
    for person in people:
        early, late = min(person.rois), person.last
        who = int(np.abs(places[early] - person.rois[early].cx).argmin())
        assert int(np.abs(places[late] - person.rois[late].cx).argmin()) == who
        assert late > FRAMES - 4 and early < 4
        owners.append(who)
    assert sorted(owners) == [0, 1]


@pytest.mark.shared
@pytest.mark.parametrize("number", [0, 1])
def test_landmarks_follow_the_chosen_one_and_are_silent_while_they_are_covered(
    passing: tuple[NDArray[np.uint8], NDArray[np.float64]], networks: Networks, number: int
) -> None:
    frames, places = passing
    track = run_landmarks(networks, frames, subject=number, passes=1)
    hips = track.landmarks[:, list(HIPS), 0].mean(1)
    apart = np.abs(places[:, 0] - places[:, 1]) > 40
    told = np.flatnonzero(track.found & apart)
    who = np.abs(places[told] - hips[told, None]).argmin(1)
    assert len(set(who.tolist())) == 1
    assert track.found[apart].mean() > 0.8
