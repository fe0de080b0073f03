from __future__ import annotations

import math
from dataclasses import astuple
from functools import cache

import pytest
import torch

from ahoy_core.avatar import AvatarInfo, CoarseConfig, CoarseResult, train_coarse
from ahoy_core.avatar.coarse import textured_template, weigh_head
from ahoy_core.avatar.losses import LossWeights, canonical_weight
from ahoy_core.avatar.render import render
from ahoy_core.avatar.supervision import canonical_views, observed_frames
from tests.avatar.scenes import TINY, body, coarse_inputs, dressed, with_frames

INFO = AvatarInfo(body=body().name)


@cache
def _trained() -> CoarseResult:
    return train_coarse(coarse_inputs(), TINY, INFO)


def _short(**changes: object) -> CoarseConfig:
    return TINY.model_copy(update={"steps": 2, **changes})


def test_step_zero_is_the_textured_template():
    inputs = coarse_inputs(count=1)
    result = train_coarse(inputs, _short(steps=1, learning_rate=1e-30), INFO)
    start = textured_template(inputs, TINY.map_size)
    assert torch.allclose(result.avatar.means, start.means, atol=1e-6)
    assert torch.allclose(result.avatar.colors, start.colors, atol=1e-6)
    assert torch.allclose(result.avatar.opacities, start.opacities, atol=1e-6)


def test_training_lowers_the_loss_and_raises_the_held_out_score():
    rows, score = _trained().losses, _trained().held_out
    first, last = (sum(row.total for row in part) / len(part) for part in (rows[:5], rows[-5:]))
    assert last < 0.6 * first
    assert score is not None
    assert score.psnr_after > score.psnr_before + 3


def test_the_same_seed_gives_the_same_avatar_bit_for_bit():
    again = train_coarse(coarse_inputs(), TINY, INFO)
    for name in ("means", "quats", "scales", "opacities", "colors", "skin_weights"):
        assert torch.equal(getattr(again.avatar, name), getattr(_trained().avatar, name)), name
    assert [astuple(row)[:2] for row in again.losses] == [astuple(row)[:2] for row in _trained().losses]


def test_another_seed_gives_another_avatar():
    other = train_coarse(coarse_inputs(), _short(seed=1), INFO).avatar
    assert not torch.equal(other.colors, train_coarse(coarse_inputs(), _short(), INFO).avatar.colors)


def test_the_held_out_frame_is_never_trained_on():
    inputs = coarse_inputs()
    frames = inputs.frames.clone()
    held_out = _trained().held_out
    assert held_out is not None
    frames[held_out.frame] = 0.0
    result = train_coarse(with_frames(inputs, frames=frames), _short(check_every=100), INFO)
    plain = train_coarse(inputs, _short(check_every=100), INFO)
    assert [row.total for row in result.losses] == [row.total for row in plain.losses]


def test_a_frame_with_nan_is_dropped_and_reported():
    inputs = coarse_inputs()
    frames = inputs.frames.clone()
    frames[2, 0, 5, 5] = math.nan
    pose = inputs.pose.clone()
    pose[4] = math.inf
    kept, notes = observed_frames(with_frames(inputs, frames=frames, pose=pose), limit=48)
    assert [frame.number for frame in kept] == [0, 1, 3, 5]
    assert any("frames 2 " in note and "picture" in note for note in notes)
    assert any("frames 4 " in note and "pose" in note for note in notes)
    result = train_coarse(with_frames(inputs, frames=frames, pose=pose), _short(), INFO)
    assert all(math.isfinite(row.total) for row in result.losses)


def test_masks_empty_in_all_but_one_frame():
    inputs = coarse_inputs()
    masks = torch.zeros_like(inputs.masks)
    masks[3] = inputs.masks[3]
    result = train_coarse(with_frames(inputs, masks=masks), _short(), INFO)
    assert result.held_out is None
    assert any("frames 0-2, 4-5 not used: the mask is empty" in note for note in result.notes)
    assert torch.equal(result.avatar.training_poses, inputs.pose[3:4])
    assert torch.isfinite(result.avatar.means).all()


def test_no_usable_frame_leaves_the_canonical_views():
    inputs = coarse_inputs()
    result = train_coarse(with_frames(inputs, used=torch.zeros(6, dtype=torch.bool)), _short(), INFO)
    assert any("canonical views alone" in note for note in result.notes)
    assert all(row.observed == 0 and row.canonical > 0 for row in result.losses)


def test_black_frames_give_a_finite_avatar():
    inputs = coarse_inputs()
    result = train_coarse(with_frames(inputs, frames=torch.zeros_like(inputs.frames)), _short(), INFO)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.isfinite(getattr(result.avatar, name)).all(), name


def test_empty_pixels_are_away_from_the_visible_person_and_from_the_fitted_body():
    inputs = coarse_inputs(count=2)
    body_only = torch.zeros_like(inputs.masks)
    body_only[0, 8:20, 30:36] = 1.0  # a part of the body behind something, beside what is seen
    confidence = torch.tensor([0.5, 1.0])
    (first, second), _ = observed_frames(with_frames(inputs, silhouettes=body_only, confidence=confidence), limit=9)
    seen = first.weight[0] > 0.05
    assert float(first.empty[0][seen].max()) == 0
    assert set(first.empty.unique().tolist()) == {0.0, 0.5}
    assert set(second.empty.unique().tolist()) == {0.0, 1.0}
    # Cut to the same box, the hidden part is where the two differ in more than the person's own turn.
    alone = observed_frames(with_frames(inputs, silhouettes=body_only * 0, confidence=confidence), limit=9)[0][0]
    assert int((alone.empty > first.empty).sum()) > 0 and not bool((alone.empty < first.empty).any())


def test_training_clears_what_lies_beside_the_person():
    """Frames of a slimmer person: alpha beside it goes down, and further with the term for empty pixels."""
    inputs = coarse_inputs()
    slim = with_frames(inputs, masks=inputs.masks * 0, silhouettes=inputs.masks * 0)
    middle = inputs.masks.shape[2] // 2
    slim.masks[:, :, middle - 4 : middle + 4] = inputs.masks[:, :, middle - 4 : middle + 4]
    weights = LossWeights(canonical=0.0)
    spilled = []
    for empty in (0.0, 1.0):
        config = _short(steps=12, weights=weights.model_copy(update={"empty": empty}))
        avatar = train_coarse(slim, config, INFO).avatar
        frame = observed_frames(slim, 1)[0][0]
        posed = avatar.pose(inputs.body, slim.pose[frame.number], slim.transl[frame.number])
        shown = render(posed.means, posed.covars, posed.opacities, posed.colors, frame.camera).alphas[0]
        spilled.append(float((shown * frame.empty).sum()))
    assert spilled[1] < 0.9 * spilled[0]


def test_a_canonical_view_with_nan_is_left_out_and_reported():
    inputs = coarse_inputs(count=1)
    views = inputs.views.clone()
    views[2, 1, 0, 0] = math.nan
    supervision, notes = canonical_views(with_frames(inputs, views=views), LossWeights())
    assert notes == ["canonical view 2 not used: not finite"]
    assert float(supervision.weight[2].abs().max()) == 0
    assert float(supervision.weight[1].min()) > 0
    assert torch.isfinite(supervision.target).all()


def test_seen_canonical_pixels_outweigh_filled_ones_and_those_beside_the_body_count_least():
    coverage, alpha = torch.zeros(3, 1), torch.tensor([[1.0], [1.0], [0.0]])
    coverage[0] = 1.0
    weight = canonical_weight(coverage, alpha, LossWeights(filled=0.25, outside=0.125))
    assert weight.tolist() == [[1.0], [0.25], [0.125]]


def test_the_head_weighs_more_in_the_canonical_views_and_the_rest_as_before():
    inputs = coarse_inputs(count=1)
    views, _ = canonical_views(inputs, LossWeights())
    ratio = weigh_head(views, dressed(), 4.0).weight[:, 0] / views.weight[:, 0]
    rows = torch.nonzero(views.alpha[0, 0].amax(1) > 0.5)[:, 0]
    top, height = int(rows[0]), int(rows[-1] - rows[0])
    middle = views.alpha.shape[3] // 2
    assert float(ratio[0, top + height // 16, middle]) > 3.5
    assert torch.allclose(ratio[:, top + height // 4 :], torch.ones(1), atol=1e-3)


def test_a_hopeless_held_out_frame_stops_training_and_keeps_the_best_network():
    inputs = coarse_inputs()
    inverted = with_frames(inputs, frames=inputs.frames.clone())
    held_out = _trained().held_out
    assert held_out is not None
    inverted.frames[held_out.frame] = 0.5
    config = TINY.model_copy(update={"check_every": 2, "patience": 2})
    result = train_coarse(inverted, config, INFO)
    assert len(result.losses) < TINY.steps
    assert any("stopped at step" in note for note in result.notes)
    assert result.held_out is not None
    assert result.held_out.psnr_after >= result.held_out.psnr_before


def test_progress_counts_every_step():
    seen: list[tuple[int, int]] = []
    train_coarse(coarse_inputs(count=1), _short(), INFO, lambda step, steps, loss: seen.append((step, steps)))
    assert seen == [(1, 2), (2, 2)]


def test_inputs_that_do_not_fit_together_are_refused():
    inputs = coarse_inputs(count=2)
    with pytest.raises(ValueError, match="expected 2 rows of masks"):
        with_frames(inputs, masks=inputs.masks[:1])
    with pytest.raises(ValueError, match="silhouettes as the masks"):
        with_frames(inputs, silhouettes=inputs.masks[:, :-1])
    with pytest.raises(ValueError, match="channel-first"):
        with_frames(inputs, frames=inputs.frames.permute(0, 2, 3, 1))
    with pytest.raises(ValueError, match="canonical views"):
        with_frames(inputs, views=inputs.views[:, :3])
