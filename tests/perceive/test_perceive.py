"""The whole stage on real networks."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.perceive.landmarks import MIRROR, run_landmarks
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.overlay import contact_sheet
from ahoy_core.perceive.perceive import NoPersonError, PerceiveConfig, Perception, perceive
from storage_schema.artifacts import ARTIFACTS

QUICK = PerceiveConfig(passes=1, iterations=4)


def read(path: Path, count: int, step: int = 1) -> NDArray[np.uint8]:
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return np.stack(frames[: count * step : step])


def run(
    frames: NDArray[np.uint8], body: PackagedBody, networks: Networks, config: PerceiveConfig = QUICK
) -> Perception:
    times, shots = np.arange(len(frames)) / 15.0, np.zeros(len(frames), np.int32)
    return perceive(frames, times, shots, None, body, networks, config)


@pytest.fixture(scope="module")
def clip(shared_dir: Path) -> NDArray[np.uint8]:
    return read(shared_dir / "captures" / "a" / "front.mp4", 8, 6)


def test_a_picture_without_people_is_an_error_that_says_so(body: PackagedBody, networks: Networks) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (3, 96, 128, 3), dtype=np.uint8)
    with pytest.raises(NoPersonError, match="at least one of 3 frames"):
        run(frames, body, networks)


def test_arrays_of_other_shapes_are_refused(body: PackagedBody, networks: Networks) -> None:
    frames = np.zeros((2, 32, 32, 3), np.uint8)
    with pytest.raises(ValueError, match=r"pts and shots \[2\]"):
        perceive(frames, np.zeros(3), np.zeros(2, int), None, body, networks, QUICK)
    with pytest.raises(ValueError, match="uint8"):
        run_landmarks(networks, frames.astype(np.float32))
    with pytest.raises(ValidationError, match="stride"):
        PerceiveConfig(stride=0)


def test_mirroring_landmarks_twice_changes_nothing() -> None:
    np.testing.assert_array_equal(MIRROR[MIRROR], np.arange(39))
    assert MIRROR[11] == 12 and MIRROR[32] == 31 and MIRROR[0] == 0


@pytest.mark.shared
def test_the_result_is_the_declared_artifact_and_progress_reaches_its_end(
    clip: NDArray[np.uint8], body: PackagedBody, networks: Networks
) -> None:
    seen: list[tuple[int, int, str]] = []
    times, shots = np.arange(len(clip)) / 2.5, np.zeros(len(clip), np.int32)
    result = perceive(clip, times, shots, None, body, networks, QUICK, lambda *step: seen.append(step))
    letters: dict[str, int] = {}
    for blob in ARTIFACTS["perceive"]:
        for name, array in blob.arrays.items():
            value = getattr(result, name)
            assert str(value.dtype) == array.dtype, name
            assert value.ndim == len(array.shape), name
            for size, letter in zip(value.shape, array.shape, strict=True):
                assert size == (letters.setdefault(letter, size) if isinstance(letter, str) else letter), name
    assert json.loads(json.dumps(result.notes))["fov_from"] == "assumed"
    assert seen[-1][0] == seen[-1][1] and [s[0] for s in seen] == sorted(s[0] for s in seen)
    assert all(np.isfinite(getattr(result, f.name)).all() for f in dataclasses.fields(result) if f.name != "notes")
    sheet = contact_sheet(clip, result, body, columns=2, tiles=3)
    assert sheet.dtype == np.uint8 and sheet.shape == (960, 1920, 3)


@pytest.mark.shared
def test_the_mask_lies_on_the_visible_person(
    shared_dir: Path, clip: NDArray[np.uint8], body: PackagedBody, networks: Networks
) -> None:
    result = run(clip, body, networks)
    ious = []
    for t in range(len(clip)):
        path = shared_dir / "captures" / "a" / "vis" / f"{6 * t:03d}.png"
        truth = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) > 127
        ours = result.visible[t] > 127
        ious.append((truth & ours).sum() / (truth | ours).sum())
    # .88 was measured over all frames; a misplaced crop or a mirrored mask falls far below.
    assert np.mean(ious) > 0.75
    assert result.used.all() and 0.2 < result.notes["occluded_mean"] < 0.6


@pytest.mark.shared
def test_a_mirrored_clip_gives_mirrored_landmarks(clip: NDArray[np.uint8], networks: Networks) -> None:
    plain = run_landmarks(networks, clip[:2], passes=2)
    turned = run_landmarks(networks, np.ascontiguousarray(clip[:2, :, ::-1]), passes=2)
    back = turned.landmarks[:, MIRROR[:33], :2] * [-1, 1] + [clip.shape[2], 0]
    apart = np.linalg.norm(plain.landmarks[..., :2] - back, axis=-1)[plain.visibility > 0.9]
    # The crops differ a little; exchanged sides would be tens of pixels off.
    assert np.median(apart) < 2.0


@pytest.mark.shared
def test_frames_without_the_person_are_named_and_get_poses_in_between(
    clip: NDArray[np.uint8], body: PackagedBody, networks: Networks
) -> None:
    frames = clip.copy()
    frames[2:4] = 128
    result = run(frames, body, networks)
    assert result.used.tolist() == [True, True, False, False, True, True, True, True]
    assert result.notes["frames_without_person"] == [[2, 3]]
    assert not result.visible[2:4].any() and not result.box[2].any() and not result.joint_confidence[2].any()
    low, high = sorted((float(result.transl[1, 0]), float(result.transl[4, 0])))
    assert low - 1e-5 <= result.transl[2, 0] <= high + 1e-5


@pytest.mark.shared
def test_a_stride_leaves_frames_out_and_one_frame_is_enough(
    clip: NDArray[np.uint8], body: PackagedBody, networks: Networks
) -> None:
    strided = run(clip, body, networks, QUICK.model_copy(update={"stride": 4}))
    assert strided.used.tolist() == [True, False, False, False] * 2
    assert strided.notes["frames_left_out_by_stride"] == 6 and strided.notes["frames_without_person"] == []
    assert run(clip[:1], body, networks).used.tolist() == [True]
