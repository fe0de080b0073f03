"""Silhouettes, refined masks and what a still camera gives away."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.perceive.guided import guided_filter
from ahoy_core.perceive.masks import frame_masks, mask_box, near_body, refine, silhouette
from ahoy_core.perceive.static import hold_static

K = np.array([[300.0, 0, 100], [0, 300.0, 120], [0, 0, 1]])


def test_a_square_plate_has_the_silhouette_that_its_corners_say() -> None:
    corners = np.array([[-0.5, 3.0, -0.5], [0.5, 3.0, -0.5], [0.5, 3.0, 0.5], [-0.5, 3.0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mask = silhouette(corners, faces, K, 240, 200)
    # 1 m at 3 m with a focal length of 300 pixels: 100 pixels, 50 to 150 and 70 to 170. Edges are one sample wide.
    assert mask[71:169, 51:149].min() == 255
    assert mask[:69].max() == 0 and mask[:, :49].max() == 0 and mask[172:].max() == 0 and mask[:, 152:].max() == 0
    assert silhouette(corners, faces[:, ::-1], K, 240, 200).max() == 0, "triangles seen from inside were drawn"


def test_a_body_behind_the_camera_has_no_silhouette(body: PackagedBody) -> None:
    for depth, empty in ((3.0, False), (-3.0, True)):
        transl = torch.tensor([[0.0, depth, -0.9]])
        posed = body(torch.zeros(1, body.n_joints, 3), body.default_betas[None], transl)
        mask = silhouette(posed.vertices[0].numpy(), body.faces.numpy(), K, 240, 200)
        assert (mask.max() == 0) == empty


def test_the_guided_filter_is_its_definition_at_a_pixel() -> None:
    draw = np.random.default_rng(0)
    guide, mask = draw.random((9, 9, 3), dtype=np.float32), draw.random((9, 9), dtype=np.float32)
    radius, eps = 2, 1e-2
    slopes, offsets = [], []
    for y in range(2, 7):
        for x in range(2, 7):
            window = np.s_[y - 2 : y + 3, x - 2 : x + 3]
            colours, values = guide[window].reshape(-1, 3).astype(float), mask[window].ravel().astype(float)
            centred = colours - colours.mean(0)
            slope = np.linalg.solve(
                centred.T @ centred / 25 + eps * np.eye(3), centred.T @ (values - values.mean()) / 25
            )
            slopes.append(slope)
            offsets.append(values.mean() - slope @ colours.mean(0))
    expected = np.mean(slopes, 0) @ guide[4, 4] + np.mean(offsets)
    # Float32 sums of products.
    assert guided_filter(guide, mask, radius, eps)[4, 4] == pytest.approx(expected, abs=1e-4)


def test_refining_makes_a_soft_edge_step_where_the_picture_steps() -> None:
    frame = np.full((80, 80, 3), 40, np.uint8)
    frame[:, 40:] = 200
    truth = np.zeros((80, 80), np.float32)
    truth[:, 42:] = 1
    soft = np.asarray(cv2.GaussianBlur(truth, (0, 0), 3), dtype=np.float32)
    refined = refine(frame, soft, crop_size=512.0).astype(float) / 255
    steps = np.diff(refined[40, 30:55])
    assert steps.argmax() == 9, "the steepest place is not between the columns 39 and 40"
    assert steps.max() > 3 * np.diff(soft[40]).max()


def test_an_empty_mask_stays_empty_and_its_box_is_zero() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (40, 30, 3), dtype=np.uint8)
    assert refine(frame, np.zeros((40, 30), np.float32), 100.0).max() == 0
    masks = frame_masks(np.zeros((40, 30), np.uint8), np.zeros((40, 30), np.uint8))
    assert masks.visible.max() == 0 and not masks.box.any() and masks.occluded == 0.0


def test_what_is_far_from_the_body_is_not_this_person() -> None:
    amodal = np.zeros((200, 300), np.uint8)
    amodal[20:180, 40:90] = 255
    near = near_body(amodal)
    assert near[100, 60] == 1.0 and near[100, 95] == 1.0 and near[100, 200] == 0.0
    soft = np.full((200, 300), 255, np.uint8)
    assert frame_masks(soft, amodal).box[2] < 115


def test_occlusion_is_the_hidden_share_of_the_silhouette() -> None:
    amodal = np.zeros((100, 100), np.uint8)
    amodal[20:60, 20:40] = 255
    soft = amodal.copy()
    soft[40:] = 0
    masks = frame_masks(soft, amodal)
    assert masks.occluded == pytest.approx(0.5)
    np.testing.assert_array_equal(masks.box, [20, 20, 40, 40])
    np.testing.assert_array_equal(mask_box(amodal), [20, 20, 40, 60])


def test_furniture_that_was_taken_for_the_person_now_and_then_is_given_back() -> None:
    draw = np.random.default_rng(0)
    frames = np.clip(draw.normal(100, 1.5, (12, 40, 60, 3)), 0, 255).astype(np.uint8)
    masks = np.zeros((12, 40, 60), np.uint8)
    for t in range(12):
        frames[t, 10:30, 3 * t : 3 * t + 10] = 220
        masks[t, 10:30, 3 * t : 3 * t + 10] = 255
    masks[4:6, 30:36, 10:50] = 255
    held = hold_static(frames, masks, np.zeros(12, int))
    # Beside the person only: the comparison is smoothed, so their own edge reaches a few pixels out.
    assert held[4, 31:35, 28:48].max() == 0
    assert held[4, 12:28, 14:20].min() == 255, "the moving person was cut"
    assert bool((held <= masks).all())


def test_a_person_who_never_moves_keeps_their_mask_and_a_short_clip_is_left_alone() -> None:
    frames = np.full((10, 30, 30, 3), 90, np.uint8)
    masks = np.zeros((10, 30, 30), np.uint8)
    masks[:, 10:20, 10:20] = 255
    np.testing.assert_array_equal(hold_static(frames, masks, np.zeros(10, int)), masks)
    masks[2] = 0
    np.testing.assert_array_equal(hold_static(frames[:4], masks[:4], np.zeros(4, int)), masks[:4])


def desk_scene(moving: bool, frames: int = 16) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A striped person behind a plain desk, whose mask always spills 6 pixels over it: frames, masks, the truth."""
    draw = np.random.default_rng(0)
    clip = np.full((frames, 60, 60, 3), 150, np.uint8)
    masks, truth = np.zeros((frames, 60, 60), np.uint8), np.zeros((frames, 60, 60), np.uint8)
    stripes = draw.integers(0, 120, (60, 20, 3), np.uint8)
    for t in range(frames):
        left = 20 + (round(4 * np.sin(t)) if moving else 0)
        clip[t, 10:, left : left + 20] = stripes[10:]
        clip[t, 40:] = (60, 64, 70)
        masks[t, 10:46, left : left + 20] = 255
        truth[t, 10:40, left : left + 20] = 255
    noisy = clip.astype(int) + draw.integers(-2, 3, clip.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), masks, truth


def test_a_mask_that_always_spills_over_a_desk_ends_at_the_desk() -> None:
    frames, masks, truth = desk_scene(moving=True)
    held = hold_static(frames, masks, np.zeros(len(frames), int))
    assert held[:, 41:].max() == 0
    # The row at the desk's edge is half of either.
    assert float((held[:, :39] == truth[:, :39]).mean()) > 0.995
    before = float((masks == truth).mean())
    assert before < 0.97


def test_the_rim_of_a_shelf_a_few_pixels_wide_is_scenery_too() -> None:
    frames, masks, truth = desk_scene(moving=True)
    frames[:, 40:43], frames[:, 43:46] = (175, 120, 80), (120, 80, 50)  # lit from above, and its shaded front
    frames[:, 46:, ::5] = (20, 15, 30)
    held = hold_static(frames, masks, np.zeros(len(frames), int))
    # Of its first two rows smoothing makes something that moves, where the person is darker than the wood.
    assert held[:, 43:].max() == 0
    assert float((held[:, :39] == truth[:, :39]).mean()) > 0.995


def test_a_person_who_stands_still_behind_a_desk_is_left_whole() -> None:
    frames, masks, _ = desk_scene(moving=False)
    np.testing.assert_array_equal(hold_static(frames, masks, np.zeros(len(frames), int)), masks)


def test_a_desk_that_is_mostly_taken_for_the_person_is_not_called_scenery() -> None:
    frames, masks, _ = desk_scene(moving=True)
    masks[:, 40:] = 255
    held = hold_static(frames, masks, np.zeros(len(frames), int))
    assert held[:, 44:].min() == 255


def test_a_screen_before_a_belly_is_scenery_though_most_of_it_is_taken_for_the_person() -> None:
    frames, masks, truth = desk_scene(moving=True)
    frames[:, 20:34, 4:50] = (40, 42, 45)
    masks[:, 20:34, 14:46] = 255
    truth[:, 20:34] = 0
    held = hold_static(frames, masks, np.zeros(len(frames), int))
    assert held[:, 21:33].max() == 0
    assert float((held[:, 10:19] == truth[:, 10:19]).mean()) > 0.995


def test_a_foot_that_stands_still_is_not_scenery_though_its_masks_rim_flickers() -> None:
    frames, masks, _ = desk_scene(moving=True)
    frames[:, 50:57, 25:36] = (30, 30, 35)
    masks[:, 50:57, 25:36] = 255
    masks[::2, 50, 25:36] = masks[::2, 56, 25:36] = 0
    held = hold_static(frames, masks, np.zeros(len(frames), int))
    assert held[:, 51:56, 25:36].min() == 255


def test_hidden_parts_are_as_wide_as_clothes_and_visible_edges_stay() -> None:
    body = np.zeros((300, 200), np.uint8)
    body[20:280, 80:120] = 255
    visible = np.where(np.arange(300)[:, None] < 150, body, 0).astype(np.uint8)
    masks = frame_masks(visible, body)
    np.testing.assert_array_equal(masks.amodal[:150], body[:150])
    widths = (masks.amodal[160:270] > 127).sum(axis=1)
    # 0.6% of 260 pixels are 1.56: one more pixel on either side is covered by half or more.
    assert widths.min() == widths.max() == 40 + 2
    assert frame_masks(visible, np.zeros_like(body)).amodal.max() == 255, "what is visible belongs to the person"
