"""The whole stage on the synthetic person."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.texture.inputs import TextureConfig, choose_frames
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import Texture, build_texture
from storage_schema.artifacts import ARTIFACTS

from .synthetic import CapsuleBody, pictures, smooth_paint, standing

SMALL = TextureConfig(atlas_size=128, canonical_height=96, canonical_width=72)


def build(
    body: CapsuleBody, fit: dict, frames: np.ndarray, masks: np.ndarray, config: TextureConfig = SMALL
) -> Texture:
    return build_texture(frames, masks, fit, body, config, canonical=body.rest.numpy())


def red_front(points: np.ndarray) -> np.ndarray:
    return np.where(points[:, 1:2] < 0, [220.0, 30, 30], [30.0, 30, 220])


def test_the_canonical_front_shows_what_is_painted_on_the_front(body: CapsuleBody) -> None:
    fit = standing(1)
    texture = build(body, fit, *pictures(body, fit, red_front))
    for rgba in (texture.partial, texture.views[0]):
        solid = rgba[..., 3] == 255
        assert solid.sum() > 500
        assert np.median(np.abs(rgba[solid][:, :3] - np.array([220.0, 30, 30]))) < 3


def test_front_and_back_are_told_apart_when_both_are_seen(body: CapsuleBody) -> None:
    fit = standing(2)
    fit["pose"][1, 0, 2] = np.pi
    texture = build(body, fit, *pictures(body, fit, red_front))
    front, back = texture.views[0], texture.views[2]
    assert np.median(front[front[..., 3] == 255][:, 0]) > 200
    assert np.median(back[back[..., 3] == 255][:, 2]) > 200
    assert texture.notes["observed_share"] > 0.45


def test_left_and_right_views_show_their_own_sides(body: CapsuleBody) -> None:
    def sides(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, :1] > 0, [220.0, 30, 30], [30.0, 30, 220])

    fit = standing(2)
    fit["pose"][:, 0, 2] = [-np.pi / 2, np.pi / 2]
    texture = build(body, fit, *pictures(body, fit, sides))
    left, right = texture.views[1], texture.views[3]
    assert np.median(left[left[..., 3] == 255][:, 0]) > 200
    assert np.median(right[right[..., 3] == 255][:, 2]) > 200


def test_a_mirrored_video_gives_a_mirrored_person(body: CapsuleBody) -> None:
    fit = standing(1)
    fit["pose"][0, 0, 2] = 0.3
    frames, masks = pictures(body, fit, smooth_paint)
    mirrored = {**fit, "pose": fit["pose"] * np.float32([1, -1, -1])}
    plain = build(body, fit, frames, masks)
    flipped = build(body, mirrored, frames[:, :, ::-1], masks[:, :, ::-1])
    a, b = plain.partial, flipped.partial[:, ::-1]
    both = (a[..., 3] == 255) & (b[..., 3] == 255)
    assert both.sum() > 0.8 * (a[..., 3] == 255).sum() > 200
    assert np.abs(a[both].astype(int) - b[both])[:, :3].mean() < 3


def test_what_was_not_seen_is_missing_from_the_partial_front_and_present_in_the_full_one(body: CapsuleBody) -> None:
    fit = standing(1)
    frames, masks = pictures(body, fit, red_front)
    masks[:, 64:] = 0
    texture = build(body, fit, frames, masks)
    partial, full = texture.partial[..., 3], texture.views[0, ..., 3]
    assert (partial[60:] == 0).all()
    assert (full[60:] == 255).sum() > 200
    assert texture.view_coverage[0, 60:].max() == 0
    assert texture.view_coverage[0, :40].max() == 255


@pytest.mark.parametrize("tall", [128, 36])
def test_arrays_are_those_of_the_artifact(body: CapsuleBody, tall: int) -> None:
    fit = standing(1)
    fit["K"] = fit["K"] * np.float32([[tall / 128], [tall / 128], [1]])
    texture = build(body, fit, *pictures(body, fit, smooth_paint, size=tall))
    sizes: dict[str, int] = {}
    for blob, arrays in zip(ARTIFACTS["texture"], (texture.atlas_arrays(), texture.canonical_arrays()), strict=False):
        assert set(arrays) == set(blob.arrays)
        sizes.clear()
        for name, declared in blob.arrays.items():
            assert arrays[name].dtype == np.dtype(declared.dtype), name
            assert len(arrays[name].shape) == len(declared.shape), name
            for got, want in zip(arrays[name].shape, declared.shape, strict=True):
                assert got == (sizes.setdefault(want, got) if isinstance(want, str) else want), name


def test_no_used_frame_still_gives_a_complete_neutral_texture(body: CapsuleBody) -> None:
    fit = standing(2)
    frames, masks = pictures(body, fit, smooth_paint)
    fit["used"][:] = False
    texture = build(body, fit, frames, masks)
    assert texture.notes["observed_share"] == 0
    assert texture.notes["frames_rejected"] == {"no_person": [0, 1]}
    assert (texture.partial == 0).all()
    assert (texture.filled_rgb.sum(axis=2) > 0).all()


def test_a_frame_with_a_broken_fit_writes_nothing_and_the_others_do(body: CapsuleBody) -> None:
    fit = standing(2)
    frames, masks = pictures(body, fit, smooth_paint)
    fit["transl"][0] = np.nan
    texture = build(body, fit, frames, masks)
    assert texture.notes["texels_written"]["0"] == 0
    assert texture.notes["texels_written"]["1"] > 1000


def test_a_frame_fitted_beside_the_person_is_moved_back_before_it_writes(body: CapsuleBody) -> None:
    def rings(points: np.ndarray) -> np.ndarray:
        x, z = points[:, 0], points[:, 2]
        return np.stack([128 + 100 * np.sin(12 * z), 128 + 100 * np.sin(25 * x), 90 + 0 * x], axis=1)

    fit = standing(2)
    frames, masks = pictures(body, fit, rings)
    masks[0, 64:] = 0  # the lower half is seen in the second frame only
    fit["transl"][1, 0] += 2 * 4.0 / 250  # two pixels
    texels_error = []
    for reach in (4.0, 0.0):
        texture = build(body, fit, frames, masks, SMALL.model_copy(update={"align_px": reach}))
        surface = Surface.of(body)
        texels = texel_map(surface, SMALL.atlas_size)
        late = texture.source_frame.ravel()[texels.flat] == 1
        truth = rings(texels.points(body.rest.numpy(), surface.faces)).clip(0, 255)
        texels_error.append(np.abs(texture.observed_rgb.reshape(-1, 3)[texels.flat] - truth)[late].mean())
        assert ("1" in texture.notes["frame_shifts_px"]) == (reach > 0)
    assert texels_error[0] < texels_error[1] / 2


def test_progress_counts_every_frame_looked_at(body: CapsuleBody) -> None:
    fit = standing(3)
    calls: list[tuple[int, int]] = []
    frames, masks = pictures(body, fit, smooth_paint)
    build_texture(frames, masks, fit, body, SMALL, lambda *call: calls.append(call), body.rest.numpy())
    assert calls == [(done, 6) for done in range(1, 7)]  # three frames vote, three write


def test_every_frame_is_chosen_or_rejected_for_one_reason() -> None:
    used = np.array([True, True, False, True, True, True])
    confidence = np.array([0.9, 0.1, 0.9, 0.8, 0.7, 0.6])
    chosen, rejected = choose_frames(used, confidence, TextureConfig(frame_stride=2))
    assert chosen == [0, 4]
    assert rejected == {"no_person": [2], "low_confidence": [1], "stride": [3, 5]}


def test_doubtful_frames_are_taken_where_there_are_no_better_ones() -> None:
    chosen, rejected = choose_frames(np.array([True, True]), np.array([0.1, 0.2]), TextureConfig())
    assert chosen == [0, 1]
    assert rejected == {"below_min_confidence_but_taken": [0, 1]}


def test_wrong_input_is_refused_by_name(body: CapsuleBody) -> None:
    fit = standing(1)
    frames, masks = pictures(body, fit, smooth_paint)
    with pytest.raises(ValueError, match="expected frames"):
        build(body, fit, frames.astype(np.float32), masks)
    with pytest.raises(ValueError, match="expected visible masks"):
        build(body, fit, frames, masks[:, 1:])
    with pytest.raises(ValueError, match="expected pose"):
        build(body, {**fit, "pose": fit["pose"][:, :3]}, frames, masks)
    with pytest.raises(ValueError, match="expected the array 'used'"):
        build(body, {k: v for k, v in fit.items() if k != "used"}, frames, masks)


def test_the_synthetic_body_turns_its_parts_with_its_root(body: CapsuleBody) -> None:
    pose = torch.zeros(1, 6, 3)
    pose[0, 0, 2] = np.pi / 2
    turned = body(pose, torch.zeros(1, 1), torch.zeros(1, 3)).vertices[0]
    want = body.rest[:, [1, 0, 2]] * torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(turned, want, atol=1e-5, rtol=0)
