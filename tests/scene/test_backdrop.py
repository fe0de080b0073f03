"""Drawing only what changes gives the picture of drawing everything."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ahoy_core.conventions import Cameras
from ahoy_core.scene.backdrop import avatar_window, look, shaded, undrawn, with_avatars
from ahoy_core.scene.cost import rasterize
from ahoy_core.scene.effects import contact_shadow
from ahoy_core.scene.exposure import Exposure, at_moment, knots
from ahoy_core.scene.plan import Request, plan_effects
from ahoy_core.scene.render import Stage
from ahoy_core.scene.shot import Shot
from tests.scene.things import body, camera, puppet, room

# One step of float32 in a dozen sums of values up to 1.
ATOL = 2e-5


def at(place: tuple[float, float, float]):
    who = puppet(at=place)
    return who, who.avatar.pose(body(), who.motion.pose[0], who.motion.transl[0])


@pytest.mark.parametrize("place", [(-0.7, 0.3, 0.0), (1.6, 0.0, 0.0), (0.0, -3.2, 0.0)])
def test_a_joint_window_is_the_joint_picture(place: tuple[float, float, float]):
    """In the middle, half outside the picture, and so near that it fills the picture."""
    scene, cameras = room(), camera((-0.7, -4.0, 1.1), (-0.7, 0.0, 0.8))
    _, posed = at(place)
    colors = scene.gaussians.colors
    found = with_avatars(look(scene, colors, cameras, 0.5), posed, joint=True)
    truth = with_avatars(undrawn(scene, colors, cameras, 0.5), posed, joint=True)
    assert torch.allclose(found, truth, atol=ATOL)


def test_avatars_outside_the_picture_leave_it_as_it_is():
    scene, cameras = room(), camera((-0.7, -4.0, 1.1), (-0.7, 0.0, 0.8))
    backdrop = look(scene, scene.gaussians.colors, cameras, 0.5)
    _, posed = at((30.0, 0.0, 0.0))
    assert avatar_window(posed, cameras) is None
    assert with_avatars(backdrop, posed, joint=True) is backdrop.picture


def test_a_shadow_drawn_in_its_window_is_that_of_the_whole_scene_recoloured():
    scene, cameras = room(), camera((0.4, -3.0, 1.8), (0.0, 0.0, 0.5))
    who, _ = at((0.0, 0.0, 0.0))
    g = scene.gaussians
    relative = who.relative(who.motion.pose[:1], who.motion.transl[:1])[0]
    axes = contact_shadow.short_axes(g.quats, g.scales)
    discs = contact_shadow.carried([contact_shadow.occluders(who)], [relative])
    shadow = contact_shadow.cast(g.means, axes, cameras.centers[0], discs)
    found = shaded(look(scene, g.colors, cameras, 0.5), shadow, len(scene))
    colors = g.colors.clone()
    colors[shadow.rows] = contact_shadow.darkened(colors[shadow.rows], shadow.light)
    image, alpha, _ = rasterize(g.means, scene.covars, g.opacities, colors, cameras)
    assert torch.allclose(found.picture, image[0] + 0.5 * (1 - alpha[0]), atol=ATOL)
    assert float((found.picture - look(scene, g.colors, cameras, 0.5).picture).abs().max()) > 0.05


def test_a_still_camera_and_a_moving_one_that_does_not_move_give_one_picture_with_every_effect():
    scene, who = room(), puppet("walk", frames=4, fps=6.0, at=(-0.6, 0.4, 0.0))
    still = Shot(camera((-0.7, -4.0, 1.1), (-0.7, 0.0, 0.8)), fps=6.0, shutter=0.5)
    c = still.cameras
    moving = replace(still, cameras=Cameras(c.viewmats.expand(4, 4, 4), c.Ks.expand(4, 3, 3), c.width, c.height))
    plan = plan_effects(scene, [who], still, Request(("light", "contact_shadow", "occlusion", "motion_blur")))
    pictures = [Stage(scene, (who,), shot, plan).picture(1).astype(int) for shot in (still, moving)]
    assert abs(pictures[0] - pictures[1]).max() <= 1


def test_an_exposure_of_three_poses_is_that_of_all_poses():
    """A walk at 12 frames a second with the shutter open all the time: fast for film."""
    who = puppet("walk", frames=6, fps=12.0)
    moments = [(i + 0.5) / 10 for i in range(10)]

    def pose(moment: float):
        return who.avatar.pose(body(), *at_moment(who.motion, 2, moment))

    chosen = knots(moments)
    exposure = Exposure(chosen, tuple(pose(moment) for moment in chosen))
    cameras = camera()
    pixels = [cameras.project(e.means).pixels[0] for m in moments for e in (exposure.at(m), pose(m))]
    off = [float((a - b).norm(dim=1).max()) for a, b in zip(pixels[::2], pixels[1::2], strict=True)]
    moved = float((pixels[-1] - pixels[1]).norm(dim=1).max())
    assert max(off) < 0.02 < 1 < moved, (max(off), moved)
    assert all(bool((torch.linalg.eigvalsh(exposure.at(m).covars) > 0).all()) for m in moments)


def test_motion_after_the_last_frame_goes_on_as_it_came():
    who = puppet("walk", frames=3, fps=12.0)
    pose, transl = at_moment(who.motion, 2, 0.5)
    ahead = who.motion.transl[2] + 0.5 * (who.motion.transl[2] - who.motion.transl[1])
    assert torch.allclose(transl, ahead, atol=1e-6) and torch.isfinite(pose).all()
    assert torch.equal(at_moment(who.motion, 1, 0.0)[0], who.motion.pose[1])
