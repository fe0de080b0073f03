"""Hard cases of perception: finite values and gradients, and bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.perceive.fit import Fit, fit_body
from ahoy_core.perceive.head import head_mask
from ahoy_core.perceive.masks import frame_masks, mask_box
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.objective import FitConfig
from ahoy_core.perceive.perceive import NoPersonError, PerceiveConfig, perceive
from ahoy_core.perceive.timeline import spread_poses
from ahoy_core.texture.rays import to_camera
from tests.perceive.synthetic import HEIGHT, PER_FRAME, WIDTH, Scene, draw_masks, make_scene, similarity_error, weighted

MAIN = ("upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01", "foot")
QUICK = FitConfig(iterations=6)


def joints(body: PackagedBody, fit: Fit) -> torch.Tensor:
    return body(fit.pose, fit.betas[None], fit.transl).joints


def errors(body: PackagedBody, scene: Scene, fit: Fit) -> torch.Tensor:
    """Mean distance a frame after the best similarity, metres."""
    rows = [body.joint_names.index(f"{name}.{side}") for name in MAIN for side in "LR"]
    return similarity_error(joints(body, fit)[:, rows], scene.joints[:, rows])


def finite(fit: Fit) -> bool:
    return all(bool(torch.isfinite(t).all()) for t in (fit.pose, fit.transl, fit.betas, fit.landmark_confidence))


def test_a_body_hidden_for_twenty_frames_goes_on_between_what_was_seen(body: PackagedBody) -> None:
    scene = make_scene(body, frames=26, rise=0.0)
    weights = torch.ones(26, 33)
    weights[3:23] = 0
    fit = fit_body(body, weighted(scene.seen, weights), QUICK)
    assert finite(fit)
    missed = errors(body, scene, fit)
    # Seen frames as without the gap; hidden ones drift towards the standing prior by less than a forearm's width.
    assert float(missed[:3].max()) < 0.02 and float(missed[3:23].max()) < 0.12
    steps = joints(body, fit).diff(dim=0).norm(dim=-1).amax(1)
    truth = scene.joints.diff(dim=0).norm(dim=-1).amax(1)
    # Out of the standing prior and back takes three times the truth's largest step; a jump would take all at once.
    assert float(steps.max()) < 4 * float(truth.max())
    assert float(fit.landmark_confidence[3:23].max()) == 0.0


def test_frames_without_any_detection_are_filled_in_between(body: PackagedBody) -> None:
    scene = make_scene(body, frames=24)
    used = np.ones(24, np.bool_)
    used[2:22] = False
    pose, transl = spread_poses(scene.pose[used], scene.transl[used], used, np.arange(24) / 15.0, np.zeros(24, int))
    assert bool(torch.isfinite(pose).all()) and bool(torch.isfinite(transl).all())
    moved = body(pose, scene.betas[None], transl).joints.diff(dim=0).norm(dim=-1)
    assert float(moved.max()) < 2.5 * float(scene.joints.diff(dim=0).norm(dim=-1).max())


def test_half_a_body_outside_of_the_picture_keeps_its_visible_half(body: PackagedBody) -> None:
    scene = make_scene(body, frames=4, rise=-0.9)
    outside = scene.seen.points[..., 1] > HEIGHT * 0.8
    assert 0.3 < float(outside.float().mean()) < 0.8
    weights = (~outside).float()
    fit = fit_body(body, weighted(scene.seen, weights), QUICK, masks=draw_masks(body, scene))
    assert finite(fit)
    rows = [body.joint_names.index(f"{name}.{side}") for name in MAIN[:3] for side in "LR"]
    # 0.032 m was measured.
    assert float(similarity_error(joints(body, fit)[:, rows], scene.joints[:, rows]).max()) < 0.045


def test_one_landmark_wildly_wrong_in_every_frame_moves_nothing_else(body: PackagedBody) -> None:
    scene = make_scene(body, frames=4, rise=0.0)
    points = scene.seen.points.clone()
    points[:, 15] += torch.tensor([180.0, -150.0])
    fit = fit_body(body, replace(scene.seen, points=points), QUICK)
    plain = fit_body(body, scene.seen, QUICK)
    legs = [body.joint_names.index(f"{name}.{side}") for name in MAIN[3:] for side in "LR"]
    assert float((joints(body, fit) - joints(body, plain))[:, legs].norm(dim=-1).max()) < 0.02


def test_a_mirrored_video_gives_the_mirrored_body(body: PackagedBody) -> None:
    scene = make_scene(body, frames=3, rise=0.0)
    order = [0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9, *(i + (1 if i % 2 else -1) for i in range(11, 33))]
    values = {name: getattr(scene.seen, name)[:, order].clone() for name in PER_FRAME}
    values["points"][..., 0] = WIDTH - values["points"][..., 0]
    values["world"][..., 0] *= -1
    plain, turned = (joints(body, fit_body(body, seen, QUICK)) for seen in (scene.seen, replace(scene.seen, **values)))
    names = body.joint_names
    swapped = [
        names.index(n[:-1] + {"L": "R", "R": "L"}[n[-1]]) if n[-2:] in (".L", ".R") else i for i, n in enumerate(names)
    ]
    back = turned[:, swapped] * torch.tensor([-1.0, 1.0, 1.0])
    main = [i for i, n in enumerate(names) if n.rpartition(".")[0] in MAIN]
    # The packaged body's thighs are not quite symmetric.
    assert float((plain - back)[:, main].norm(dim=-1).max()) < 0.01


def test_a_person_thirty_pixels_tall_is_found_where_they_are(body: PackagedBody) -> None:
    scene = make_scene(body, frames=4, rise=0.0)
    shrunk = 30.0 / float(scene.seen.points[0, :, 1].max() - scene.seen.points[0, :, 1].min())
    middle = torch.tensor([WIDTH / 2, HEIGHT / 2])
    noise = torch.randn(scene.seen.points.shape, generator=torch.Generator().manual_seed(1))
    small = (scene.seen.points - middle) * shrunk + middle + 0.3 * noise
    K = scene.seen.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * shrunk, K[1, 1] * shrunk
    fit = fit_body(body, replace(scene.seen, points=small, K=K), QUICK)
    assert finite(fit)
    # Half a pixel of 30 on a person of 1.65 m is 3 cm.
    assert float(errors(body, scene, fit).max()) < 0.06
    assert abs(float(fit.transl[:, 1].mean() / scene.transl[:, 1].mean()) - 1) < 0.1


@pytest.mark.parametrize("pixels", [0, 1])
def test_masks_of_one_pixel_and_of_none_are_borne(body: PackagedBody, pixels: int) -> None:
    scene = make_scene(body, frames=1)
    masks = np.zeros((1, HEIGHT, WIDTH), np.uint8)
    masks[0, HEIGHT // 2, WIDTH // 2] = 255 * pixels
    fit = fit_body(body, scene.seen, QUICK, masks=masks)
    assert finite(fit) and float(errors(body, scene, fit).max()) < 0.02
    soft = frame_masks(masks[0], masks[0])
    assert soft.amodal.max() <= 255 and np.isfinite(soft.occluded) and mask_box(soft.visible).shape == (4,)


def test_a_head_out_of_view_has_no_mask_and_a_hand_before_the_face_is_none_of_it(body: PackagedBody) -> None:
    faces = body.faces.numpy()
    head = body.regions["head"][body.faces].all(1).numpy()
    vertices = body(
        torch.zeros(1, body.n_joints, 3), body.default_betas[None], torch.tensor([[0.0, 4.0, 0.0]])
    ).vertices[0]
    points = to_camera(vertices.numpy(), OBSERVED_VIEWMAT.numpy())
    K = np.array([[300.0, 0, 128], [0, 300.0, 128], [0, 0, 1]])
    whole = np.full((256, 256), 255, np.uint8)
    shown = head_mask(points, faces, head, K, whole)
    rows = np.flatnonzero(shown.any(1))
    # 1.84 m at 4 m are 138 pixels; a head is an eighth of that high, so 180 pixels large, and up to six times as large
    # with the hair that may stand off it.
    assert 180 < (shown > 0).sum() < 6 * 180 and rows[-1] < 128
    covered = points.copy()
    hand = body.regions["hands"].numpy() & (points[:, 0] > 0)
    face = points[body.regions["head"].numpy()].mean(0)
    covered[hand] += face - covered[hand].mean(0) - [0, 0, 0.4]
    less = head_mask(covered, faces, head, K, whole)
    assert 0 < int((less > 0).sum()) < int((shown > 0).sum())
    away = head_mask(points + np.array([50.0, 0, 0]), faces, head, K, whole)
    assert not away.any() and not head_mask(points, faces, head, K, np.zeros_like(whole)).any()


def test_constant_colour_frames_are_an_error_that_says_so(body: PackagedBody, networks: Networks) -> None:
    for value in (0, 128, 255):
        frames = np.full((2, 64, 96, 3), value, np.uint8)
        with pytest.raises(NoPersonError, match="larger or better lit"):
            perceive(frames, np.arange(2) / 15, np.zeros(2, int), None, body, networks, PerceiveConfig(passes=1))
