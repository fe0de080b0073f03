from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from dataclasses import astuple, replace
from functools import cache
from pathlib import Path

import pytest
import torch

from ahoy_core.avatar import AvatarInfo, FullConfig, FullResult, load_avatar, save_avatar, train_full
from ahoy_core.avatar.corrections import Corrections, corrected_joints
from ahoy_core.avatar.deform import OffsetBounds, apply_offsets, deform, dense_weights, offset_channels
from ahoy_core.avatar.full_config import ABLATIONS, CorrectionBounds, FullWeights, Switches
from ahoy_core.avatar.full_inputs import make_plan
from ahoy_core.avatar.hallucinated import sequence_shots
from ahoy_core.avatar.head import body_shares, expression_basis, head_zone
from ahoy_core.avatar.render import Rendered
from ahoy_core.avatar.shots import at_target_resolution, shot_loss
from ahoy_core.avatar.trainer import Trainer
from ahoy_core.conventions import GREY
from ahoy_core.splat import oracle, rasterization
from tests.avatar.full_scenes import TINY_FULL, around, full_inputs, kinematics, raised, seen, sequence
from tests.avatar.scenes import body, hand_made, template, with_frames

INFO = AvatarInfo(body=body().name)


def _short(steps: int = 2, **changes: object) -> FullConfig:
    return TINY_FULL.model_copy(update={"steps": steps, **changes})


def _switched(name: str, steps: int = 2) -> FullConfig:
    return _short(steps, switches=ABLATIONS[name])


@cache
def _trained() -> FullResult:
    return train_full(full_inputs(), TINY_FULL, INFO)


def _finite(result: FullResult) -> bool:
    avatar = result.avatar
    assert avatar.posing is not None
    tensors = (avatar.means, avatar.quats, avatar.scales, avatar.opacities, avatar.colors, avatar.posing.base)
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)


def test_training_lowers_the_loss_and_raises_the_held_out_score():
    rows, score = _trained().losses, _trained().held_out
    first, last = (sum(row.body + row.observed for row in part) for part in (rows[:5], rows[-5:]))
    assert last < 0.8 * first
    assert score is not None and score.psnr_after > score.psnr_before + 1
    assert all(row.head > 0 and row.body > 0 and row.observed > 0 for row in rows)


def test_the_same_seed_gives_the_same_avatar_bit_for_bit_and_another_seed_another():
    again = train_full(full_inputs(), TINY_FULL, INFO)
    assert torch.equal(again.avatar.posing.base, _trained().avatar.posing.base)  # type: ignore[union-attr]
    assert [astuple(row)[:3] for row in again.losses] == [astuple(row)[:3] for row in _trained().losses]
    other = train_full(full_inputs(), _short(seed=1), INFO)
    assert not torch.equal(other.avatar.colors, train_full(full_inputs(), _short(), INFO).avatar.colors)


def test_a_killed_training_goes_on_to_the_same_avatar(tmp_path: Path):
    """A real kill -9 in another process, after its first checkpoint."""
    path = tmp_path / "training.pt"
    code = (
        "import torch, os, signal; torch.set_num_threads(1)\n"
        "from pathlib import Path\n"
        "from ahoy_core.avatar import train_full\n"
        "from tests.avatar.full_scenes import TINY_FULL, full_inputs\n"
        "from tests.avatar.test_full import INFO\n"
        "def step(n, steps, loss):\n"
        "    if n == 13: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"train_full(full_inputs(), TINY_FULL, INFO, step, checkpoint=Path({str(path)!r}))\n"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    killed = subprocess.run([sys.executable, "-c", code], env=environment, cwd=Path(__file__).parents[2])
    assert killed.returncode == -signal.SIGKILL and path.is_file()
    torch_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        steps: list[int] = []
        result = train_full(full_inputs(), TINY_FULL, INFO, lambda n, s, loss: steps.append(n), checkpoint=path)
        whole = train_full(full_inputs(), TINY_FULL, INFO)
    finally:
        torch.set_num_threads(torch_threads)
    assert steps == list(range(11, 21))
    for name in ("means", "quats", "scales", "opacities", "colors", "skin_weights"):
        assert torch.equal(getattr(result.avatar, name), getattr(whole.avatar, name)), name
    assert [row.total for row in result.losses] == [row.total for row in whole.losses]


def test_a_checkpoint_of_another_training_or_a_damaged_one_is_not_taken(tmp_path: Path):
    path, steps = tmp_path / "training.pt", []
    train_full(full_inputs(), _short(check_every=1), INFO, checkpoint=path)
    train_full(full_inputs(), _short(check_every=1, seed=5), INFO, lambda n, *_: steps.append(n), checkpoint=path)
    assert steps == [1, 2]
    path.write_bytes(path.read_bytes()[:100])
    train_full(full_inputs(), _short(), INFO, lambda n, *_: steps.append(n), checkpoint=path)
    assert steps == [1, 2, 1, 2]


def test_a_saved_full_avatar_poses_as_before(tmp_path: Path):
    avatar = _trained().avatar
    save_avatar(avatar, tmp_path)
    again = load_avatar(tmp_path)
    for pose in (raised(0.0), raised(0.7)):
        before, after = avatar.pose(body(), pose), again.pose(body(), pose)
        assert torch.equal(before.means, after.means) and torch.equal(before.colors, after.colors)


def test_poses_get_gaussians_of_their_own_but_turning_does_not():
    avatar = _trained().avatar
    turned = raised(0.7)
    turned[0, 2] += 1.0
    one, two, three = (avatar.pose(body(), pose) for pose in (raised(0.0), raised(0.7), turned))
    assert not torch.equal(one.colors, two.colors)
    assert torch.equal(two.colors, three.colors)
    still = avatar.pose(body(), raised(0.7), pose_strength=1.0)
    free = avatar.pose(body(), raised(1.5), pose_strength=0.0)
    held = avatar.pose(body(), raised(1.5), pose_strength=1.0)
    assert float((held.colors - still.colors).abs().mean()) < float((free.colors - still.colors).abs().mean())


@pytest.mark.parametrize("name", sorted(set(ABLATIONS) - {"A", "full"}))
def test_every_switch_changes_what_its_name_says_and_trains(name: str):
    config = _switched(name)
    plan = make_plan(full_inputs(), config)
    result = train_full(full_inputs(), config, INFO)
    row = result.losses[-1]
    assert _finite(result)
    assert len(plan.rotations) == {"C1": 1, "C": 1, "C3": 6 + 5, "B1": 1}.get(name, 3)
    assert (row.body > 0) == (name != "B1")
    assert (row.head > 0) == (name != "D")
    # Nothing moves in two steps before `correct_from`; with corrections the last step moves them.
    longer = train_full(full_inputs(), config.model_copy(update={"steps": 3, "correct_from": 0.0}), INFO)
    assert (max(longer.corrections.values()) > 0) == (name not in ("C2", "C", "B1"))


def test_head_pixels_are_left_out_of_the_body_loss_and_only_there():
    weights = FullWeights()
    split, whole = (
        sequence_shots([sequence()], kinematics(), template(), weights, head_split)[0][0]
        for head_split in (True, False)
    )
    cameras = around(3)
    relative = torch.eye(4).expand(body().n_joints, 4, 4)
    shares = body_shares(template(), relative, cameras)
    for number, (with_split, without) in enumerate(zip(split, whole, strict=True)):
        gone = (with_split.weight == 0) & (without.weight > 0)
        head = float((shares[number, 0] > 0.5).sum())
        assert head <= float(gone.sum()) < 4 * head
        assert torch.equal(with_split.weight[~gone], without.weight[~gone])
    keeps = replace(sequence(), keeps_head=True)
    (kept,) = sequence_shots([keeps], kinematics(), template(), weights, True)[0]
    assert all(torch.equal(a.weight, b.weight) for a, b in zip(kept, whole, strict=True))


def test_a_hallucinated_pixel_weighs_little_where_the_video_showed_the_surface():
    covered = replace(sequence(), coverage=torch.ones_like(sequence().coverage))
    weights = FullWeights(covered=0.05)
    plain, seen_before = (
        sequence_shots([s], kinematics(), template(), weights, False)[0][0][0] for s in (sequence(), covered)
    )
    assert torch.allclose(seen_before.weight, 0.05 * plain.weight)


def test_hallucination_does_not_move_a_colour_that_the_video_shows():
    """Two teachers disagree on a colour; with coverage 1 the video's wins."""
    inputs = full_inputs(with_faces=False)
    lying = replace(sequence(), frames=1 - sequence().frames, coverage=(sequence().alphas > 0.5).float())  # type: ignore[operator]
    config = _short(60, switches=Switches(head_split=False, corrections=False))
    errors = []
    for coverage in (1.0, 0.0):
        lie = replace(lying, coverage=coverage * lying.coverage)
        result = train_full(replace(inputs, sequences=(lie,)), config, INFO)
        assert result.held_out is not None
        errors.append(result.held_out.psnr_after)
    assert errors[0] > errors[1] + 2


def test_low_resolution_is_compared_after_the_same_area_filter():
    """The loss of the truth is 0 against its own area-filtered picture, and not against a resampled one."""
    small, full = sequence(factor=2), seen(raised(0.0), around(3))
    (shots,), _ = sequence_shots([small], kinematics(), template(), FullWeights(), False)
    shot = shots[0]
    x0, y0 = (round(float(a - b)) for a, b in zip(around(3).Ks[0, :2, 2], shot.camera.Ks[0, :2, 2], strict=True))
    box = (slice(0, 1), slice(None), slice(y0, y0 + shot.camera.height), slice(x0, x0 + shot.camera.width))
    rendered = Rendered(full.images[box].clamp(0, 1), full.alphas[box])
    assert shot.factor == 2
    assert float(shot_loss(at_target_resolution(rendered, 2), shot, FullWeights())) < 1e-4
    strided = Rendered(rendered.images[..., ::2, ::2], rendered.alphas[..., ::2, ::2])
    assert float(shot_loss(strided, shot, FullWeights())) > 1e-2


def test_tone_changes_the_person_and_leaves_what_is_behind():
    corrections = Corrections(torch.tensor([False]), corrected_joints(body()), CorrectionBounds())
    corrections.tone.data.fill_(1.0)
    rendered = seen(raised(0.0), around(1))
    toned = at_target_resolution(rendered, 1, corrections.tones(torch.tensor([0])))
    empty = rendered.alphas[0, 0] == 0
    assert torch.allclose(toned.images[0][:, empty], torch.tensor(GREY))
    assert float((toned.images - rendered.images).abs().max()) > 0.1


def test_a_nan_frame_of_a_sequence_is_dropped_and_reported():
    frames = sequence().frames.clone()
    frames[1, 0, 3, 3] = math.nan
    broken = replace(sequence(), frames=frames)
    result = train_full(replace(full_inputs(), sequences=(broken,)), _short(), INFO)
    assert any("frame 1 not used" in note and "not finite" in note for note in result.notes)
    assert _finite(result) and all(math.isfinite(row.total) for row in result.losses)


def test_a_sequence_of_nothing_but_nan_leaves_the_observed_frames():
    broken = replace(sequence(), pose=torch.full_like(sequence().pose, math.nan))
    result = train_full(replace(full_inputs(), sequences=(broken,)), _short(), INFO)
    assert all(row.body == 0 and row.observed > 0 for row in result.losses)


def test_masks_empty_in_all_but_one_frame():
    inputs = full_inputs()
    masks = torch.zeros_like(inputs.observed.masks)
    masks[3] = inputs.observed.masks[3]
    alone = replace(inputs, observed=with_frames(inputs.observed, masks=masks), sequences=())
    result = train_full(alone, _short(), INFO)
    assert result.held_out is None and _finite(result)
    assert any("frames 0-2, 4-5 not used" in note for note in result.notes)
    assert result.avatar.pose(body(), raised(0.5)).means.isfinite().all()


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_black_and_saturated_frames_give_a_finite_avatar(value: float):
    inputs = full_inputs()
    observed = with_frames(inputs.observed, frames=torch.full_like(inputs.observed.frames, value))
    flat = replace(sequence(), frames=torch.full_like(sequence().frames, value))
    assert _finite(train_full(replace(inputs, observed=observed, sequences=(flat,)), _short(4), INFO))


def test_four_identical_views_train():
    one = sequence(views=1)
    same = replace(
        one,
        **{
            name: getattr(one, name).expand(4, *[-1] * (getattr(one, name).ndim - 1)) for name in ("frames", "coverage")
        },
        pose=one.pose.expand(4, -1, -1),
        transl=one.transl.expand(4, -1),
        alphas=one.alphas.expand(4, -1, -1),  # type: ignore[union-attr]
        cameras=one.cameras[[0, 0, 0, 0]],
    )
    assert _finite(train_full(replace(full_inputs(), sequences=(same,)), _short(4), INFO))


def test_a_limb_that_is_never_seen_stays_near_the_template():
    """Left arm cut out of everything: what the rest learns reaches it through its neighbours alone."""
    inputs = full_inputs(with_faces=False)
    arm = template().means[:, 0] > 0.45
    masks = inputs.observed.masks.clone()
    masks[:, :, 26:] = 0  # the person's left is the picture's right
    alone = replace(inputs, observed=with_frames(inputs.observed, masks=masks, silhouettes=masks * 0 + 1), sequences=())
    avatar = train_full(alone, _short(20), INFO).avatar
    assert float((avatar.colors - inputs.template.colors)[arm].abs().mean()) < 0.2
    assert float((avatar.means - template().means)[arm].norm(dim=1).max()) < 0.03
    assert float((avatar.colors - inputs.template.colors)[~arm].abs().max()) > 0.1


def test_pose_corrections_driven_to_their_bounds_stay_there_and_finite():
    """A person who is somewhere else entirely: corrections saturate, and nothing breaks."""
    far = replace(sequence(), transl=sequence().transl + torch.tensor([0.6, 0.0, 0.0]))
    config = _short(20, correction_rate=1.0, correct_from=0.0)
    result = train_full(replace(full_inputs(), sequences=(far,)), config, INFO)
    assert result.corrections["camera"] > 0.95 and max(result.corrections.values()) <= 1
    assert _finite(result)


def test_learned_skin_weights_are_a_partition_of_unity():
    weights = _trained().avatar.skin_weights
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-6) and float(weights.min()) >= 0
    assert not torch.equal(weights, template().skin_weights)


def test_without_face_views_the_head_path_is_skipped_and_says_why():
    inputs = replace(full_inputs(with_faces=False), no_faces="the face is never seen")
    result = train_full(inputs, _short(), INFO)
    assert any("head path skipped: the face is never seen" in note for note in result.notes)
    assert all(row.head == 0 for row in result.losses)


def test_expression_moves_the_face_and_nothing_else():
    basis = expression_basis(body(), body().default_betas, template())
    jaw = body().expression_names.index("jawOpen")
    assert float(basis[jaw].norm(dim=1).max()) > 0.005
    assert float(basis[:, ~template().head].abs().max()) == 0
    avatar, action = _trained().avatar, torch.zeros(body().n_expressions)
    neutral = avatar.pose(body(), raised(0.3), expression=action)
    assert torch.equal(neutral.means, avatar.pose(body(), raised(0.3)).means)
    action[jaw] = 1.0
    opened = (avatar.pose(body(), raised(0.3), expression=action).means - neutral.means).norm(dim=1)
    assert float(opened[template().head].max()) > 0.005 and float(opened[~template().head].max()) == 0
    with pytest.raises(ValueError, match="52 finite face actions"):
        avatar.pose(body(), raised(0.3), expression=action[:5])


def test_the_head_zone_is_where_the_head_is_nearest_and_within_reach():
    shares = torch.zeros(2, 20, 9)
    shares[0, 4:8, 3:6] = 1
    shares[1, 8:18, 2:7] = 1
    zone = head_zone(shares, 3.0)
    assert bool((zone[4:8, 3:6] == 1).all()) and float(zone[8:].sum()) == 0
    assert float(zone[1, 4]) == 1 and float(zone[0, 4]) == 0
    assert float(head_zone(shares * 0, 3.0).sum()) == 0


def test_gradients_from_raw_offsets_through_skinning_to_the_picture():
    """Float64, against finite differences: map -> Gaussians -> LBS with a corrected pose -> picture."""
    start = hand_made()
    raw = 0.1 * torch.randn(
        len(start), offset_channels(start), dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    camera = torch.eye(4, dtype=torch.float64)[None]
    camera[:, 2, 3] = 3.0
    K = torch.tensor([[[12.0, 0, 4], [0, 12.0, 4], [0, 0, 1]]], dtype=torch.float64)
    corrected = _Corrected(Corrections(torch.tensor([False]), torch.arange(3), CorrectionBounds()).double())

    def picture(raw: torch.Tensor, omega: torch.Tensor) -> torch.Tensor:
        still = torch.eye(3, dtype=torch.float64).expand(1, 3, 3, 3)
        turned = torch.func.functional_call(corrected, {"inner.pose": omega}, (still,))
        moved = torch.cat([turned[0], torch.zeros(3, 3, 1, dtype=torch.float64)], 2)
        relative = torch.cat([moved, torch.eye(4, dtype=torch.float64)[3:].expand(3, 1, 4)], 1)
        canonical = apply_offsets(start, raw, OffsetBounds())
        dense = dense_weights(start.skin_indices, canonical.skin_weights, 3)
        means, covars = deform(canonical.means, canonical.covars(), dense, relative)
        rgb, alpha = oracle.render(
            means, None, None, canonical.opacities, canonical.colors, camera, K, 7, 6, covars=covars
        )
        return torch.cat([rgb, alpha], -1)

    omega = torch.full((1, 3, 3), 0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(picture, (raw.requires_grad_(), omega), eps=1e-6, atol=1e-6)


class _Corrected(torch.nn.Module):
    """Lets a function be differentiated in the corrections' parameter."""

    def __init__(self, inner: Corrections) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, rotations: torch.Tensor) -> torch.Tensor:
        return self.inner.rotations(torch.tensor([0]), rotations)


def test_degenerate_covariances_after_skinning_render_finite():
    """Joints that collapse space to a plane and to a point."""
    start = hand_made()
    relative = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    relative[0, 2, 2] = 0.0
    relative[1, :3, :3] = 0.0
    dense = dense_weights(start.skin_indices, start.skin_weights, 3)
    half = (start.rotations * start.scales[:, None]).requires_grad_()
    means, covars = deform(start.means, half @ half.transpose(1, 2), dense, relative)
    camera = torch.eye(4, dtype=torch.float64)[None]
    camera[:, 2, 3] = 3.0
    K = torch.tensor([[[12.0, 0, 4], [0, 12.0, 4], [0, 0, 1]]], dtype=torch.float64)
    image, _, _ = rasterization(means, None, None, start.opacities, start.colors, camera, K, 8, 8, covars=covars)
    image.sum().backward()
    assert torch.isfinite(image).all() and half.grad is not None and torch.isfinite(half.grad).all()


def test_the_gauge_of_a_whole_training_stays_small_when_the_poses_are_true():
    """Nothing to correct: what corrections there are stay a small share of their bounds."""
    result = train_full(full_inputs(), _short(40, correct_from=0.0), INFO)
    assert result.corrections["pose"] < 0.5 and result.corrections["camera"] < 0.5


def test_previews_show_targets_above_renders():
    pictures: list[tuple[int, tuple[int, ...]]] = []
    train_full(
        full_inputs(), _short(4, check_every=2), INFO, preview=lambda n, image: pictures.append((n, image.shape))
    )
    assert [step for step, _ in pictures] == [2, 4]
    assert all(shape[0] == 3 and shape[1] > 30 for _, shape in pictures)


def test_nothing_to_learn_from_is_refused():
    inputs = full_inputs()
    nobody = with_frames(inputs.observed, used=torch.zeros(6, dtype=torch.bool))
    with pytest.raises(ValueError, match="at least one usable frame or sequence"):
        train_full(replace(inputs, observed=nobody, sequences=()), _short(), INFO)


def test_sequences_that_do_not_fit_together_are_refused():
    one = sequence()
    smaller = {name: getattr(one, name)[..., :-1, :-1] for name in ("frames", "coverage", "alphas")}
    with pytest.raises(ValueError, match="one whole factor"):
        replace(one, **smaller)
    with pytest.raises(ValueError, match="expected 3 rows"):
        replace(sequence(), transl=sequence().transl[:1])
    with pytest.raises(ValueError, match="coverage"):
        replace(sequence(), coverage=sequence().coverage[:1])


def test_base_offsets_of_another_template_are_refused():
    inputs = replace(full_inputs(), base=torch.zeros(7, 3))
    with pytest.raises(ValueError, match="same template"):
        Trainer(inputs, make_plan(inputs, TINY_FULL), TINY_FULL, None)


def test_the_objective_uses_the_perceptual_role_where_it_is_filled():
    class Constant:
        name = "constant"

        def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            assert a.shape == b.shape and min(a.shape[2:]) >= 32
            return (a - b).square().mean((1, 2, 3)) + 2

    result = train_full(full_inputs(), _short(), INFO, perceptual=Constant())
    assert result.losses[0].perceptual > 2 * FullWeights().perceptual
    without = train_full(full_inputs(), _short(), INFO)
    assert without.losses[0].perceptual == 0
    assert any("no perceptual loss" in note for note in without.notes)
