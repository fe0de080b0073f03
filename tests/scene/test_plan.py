"""What is called for and what is not; what is off costs nothing; auto shows what all shows where nothing is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ahoy_core.avatar import Avatar
from ahoy_core.conventions import Cameras
from ahoy_core.motion import Motion
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.plan import BASE, EFFECT_NAMES, Request, plan_effects
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.render import Stage
from ahoy_core.scene.scene import Scene, empty_scene, make_scene
from ahoy_core.scene.shot import Shot
from tests.scene.test_secondary_motion import shaken, skirted
from tests.scene.things import avatar, camera, flat, floor, full_avatar, moved, puppet, room, smiling, wall

NEAR = camera((0.0, -1.2, 1.6), (0.0, 0.0, 1.5))
FAR = camera((0.0, -40.0, 1.5), (0.0, 0.0, 1.0))


def stretched(who: Puppet) -> Puppet:
    return moved(who, lambda t: t * torch.tensor([1.0, 1.3, 1.0]))


# For each effect: content that calls for it, and content that differs in the one thing that matters and does not.
CALLS = {
    "foot_contact": (
        lambda: (floor(), stretched(puppet("walk", frames=24, fps=24.0)), Shot(camera())),
        lambda: (floor(), puppet("walk", frames=24, fps=24.0), Shot(camera())),
    ),
    "expression": (
        lambda: (empty_scene(), puppet(smiling()), Shot(NEAR)),
        lambda: (empty_scene(), puppet(smiling()), Shot(FAR)),
    ),
    "light": (
        lambda: (room(), puppet(), Shot(camera())),
        lambda: (floor(), puppet(), Shot(camera())),
    ),
    "view_color": (
        lambda: (room(), puppet(), Shot(camera())),
        lambda: (replace(room(), sh_rest=room().sh_rest * 0.01), puppet(), Shot(camera())),
    ),
    "contact_shadow": (
        lambda: (floor(), puppet(), Shot(camera())),
        lambda: (floor(), puppet(), Shot(NEAR)),
    ),
    "ambient_occlusion": (
        lambda: (floor(), puppet(), Shot(camera((0.4, -1.0, 0.3), (0.0, 0.0, 0.1)))),
        lambda: (floor(), puppet(), Shot(NEAR)),
    ),
    "secondary_motion": (
        lambda: (empty_scene(), shaken(skirted(puppet(frames=12, fps=12.0))), Shot(camera())),
        lambda: (empty_scene(), skirted(puppet(frames=12, fps=12.0)), Shot(camera())),
    ),
    "occlusion": (
        lambda: (wall(-1.0), puppet(), Shot(camera((0.0, -4.0, 1.0), (0.0, 0.0, 1.0)))),
        lambda: (wall(1.0), puppet(), Shot(camera((0.0, -4.0, 1.0), (0.0, 0.0, 1.0)))),
    ),
    "depth_of_field": (
        lambda: (room(), puppet(), Shot(camera(), aperture=0.3)),
        lambda: (room(), puppet(), Shot(camera(), aperture=0.001)),
    ),
    "motion_blur": (
        lambda: (empty_scene(), puppet("walk"), Shot(camera((2.5, -0.3, 1.0), (0, -0.3, 0.9)), fps=12.0)),
        lambda: (empty_scene(), puppet("walk"), Shot(camera((2.5, -0.3, 1.0), (0, -0.3, 0.9)), fps=12.0, shutter=0.01)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EFFECT_NAMES)
def test_each_effect_is_called_for_by_one_scene_and_not_by_another(name: str):
    for wanted, make in zip((True, False), CALLS[name], strict=True):
        scene, who, shot = make()
        effect = plan_effects(scene, [who], shot)[name]
        assert effect.on is wanted, effect
        assert len(effect.reason) > 10
        assert not wanted or effect.seconds > 0


@pytest.mark.parametrize("name", EFFECT_NAMES)
def test_an_effect_that_is_on_changes_the_picture_and_leaves_an_entry_and_one_that_is_off_leaves_none(name: str):
    scene, who, shot = CALLS[name][0]()
    for effects, on in (((name,), True), ((), False)):
        stage = Stage(scene, (who,), shot, plan_effects(scene, [who], shot, Request(effects)))
        picture = stage.picture(2).astype(int)
        assert (name in stage.ledger.calls) is on
        assert set(stage.ledger.calls) <= {BASE, name}
        if on:
            with_it = picture
    assert np.abs(with_it - picture).max() > 4


class Counting(TorchDispatchMode):
    """Counts operations and the bytes of what they make."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        self.calls[str(func)] += 1
        for part in result if isinstance(result, (tuple, list)) else (result,):
            if isinstance(part, torch.Tensor):
                self.bytes += part.numel() * part.element_size()
        return result


def plain() -> tuple[Scene, Puppet, Shot]:
    """Content that calls for nothing: a wall behind a person who stands still, filmed sharply."""
    return wall(2.0), puppet(), Shot(camera((0.0, -4.0, 1.2), (0.0, 0.0, 1.2)), shutter=0.0)


def test_what_is_off_makes_no_call_and_no_tensor():
    scene, who, shot = plain()
    counted = []
    for effects in ("auto", "none"):
        plan = plan_effects(scene, [who], shot, Request(effects))
        assert not any(effect.on for effect in plan.effects), [e for e in plan.effects if e.on]
        stage = Stage(scene, (who,), shot, plan)
        stage.picture(0)
        with Counting() as counting:
            stage.picture(1)
        counted.append((counting.calls, counting.bytes, dict(stage.ledger.calls)))
    assert counted[0] == counted[1]


def test_auto_shows_what_all_shows_where_the_extras_are_not_called_for():
    scene, who, shot = plain()
    auto, everything = (
        Stage(scene, (who,), shot, plan_effects(scene, [who], shot, Request(effects))).picture(1).astype(int)
        for effects in ("auto", "all")
    )
    # Light is matched to a grey wall that leaves half of all directions open: a step or two of 8 bits.
    difference = np.abs(auto - everything)
    assert difference.mean() < 1.0 and np.quantile(difference, 0.99) <= 8


def test_planning_is_pure_and_costs_less_than_a_frame_of_what_it_plans():
    scene, who, shot = CALLS["light"][0]()
    before = scene.gaussians.colors.clone(), who.motion.pose.clone()
    first, second = (plan_effects(scene, [who], shot) for _ in range(2))
    assert first == second
    assert torch.equal(before[0], scene.gaussians.colors) and torch.equal(before[1], who.motion.pose)


def test_estimates_add_up_and_grow_with_the_work():
    scene, who, shot = CALLS["motion_blur"][0]()
    small, large = (plan_effects(scene, [puppet("walk", frames=n)], shot) for n in (4, 8))
    assert large.base_seconds == pytest.approx(2 * small.base_seconds, rel=0.05)
    assert small.seconds == pytest.approx(small.base_seconds + sum(e.seconds for e in small.effects if e.on))
    slow = plan_effects(scene, [who], shot, Request(rates=Rates().scaled(3.0)))
    assert slow.seconds == pytest.approx(3 * plan_effects(scene, [who], shot).seconds, rel=1e-6)
    assert small["motion_blur"].seconds > plan_effects(scene, [who], shot, Request("none")).seconds


def test_samples_of_blur_and_focus_are_shared():
    scene = room()
    shot = Shot(camera(), fps=12.0, aperture=0.1, shutter=1.0)
    walking = puppet("walk")
    both = plan_effects(scene, [walking], shot, Request(("motion_blur", "depth_of_field")))
    assert both.samples == max(both["motion_blur"].quality, both["depth_of_field"].quality)
    assert min(both["motion_blur"].seconds, both["depth_of_field"].seconds) == 0.0


def test_an_empty_scene_calls_for_nothing_but_still_renders():
    shot = Shot(camera(), shutter=0.0)
    plan = plan_effects(empty_scene(), [puppet()], shot)
    assert not any(effect.on for effect in plan.effects) and all(effect.seconds == 0 for effect in plan.effects)
    picture = Stage(empty_scene(), (puppet(),), shot, plan).picture(0)
    assert (np.abs(picture.astype(int) - 128) > 10).any()
    everything = plan_effects(empty_scene(), [puppet()], shot, Request("all"))
    assert not everything.on("occlusion") and not everything.on("light")


def test_two_avatars_hide_each_other():
    near, far = puppet(at=(0.0, -0.6, 0.0)), puppet(at=(0.25, 0.5, 0.0))
    shot = Shot(camera((0.0, -4.0, 1.0), (0.0, 0.0, 0.9)), shutter=0.0)
    both, other, alone = (
        Stage(empty_scene(), who, shot, plan_effects(empty_scene(), who, shot)).picture(0).astype(int)
        for who in ((near, far), (far, near), (near,))
    )
    assert np.abs(both - other).max() <= 1  # whoever is named first
    person = np.abs(alone - 128).max(-1) > 20
    assert np.abs(both - alone)[person].mean() < 6  # the near one is whole
    assert (np.abs(both - alone).max(-1) > 20).sum() > 50  # and the far one is there


def test_a_camera_inside_an_avatar_and_an_avatar_inside_a_wall_give_finite_pictures():
    for cameras in (camera((0.0, 0.0, 1.2), (0.0, -1.0, 1.2)), camera((0.0, 0.05, 0.9), (0.0, 1.0, 1.0))):
        shot = Shot(cameras, aperture=0.01)
        plan = plan_effects(room(), [puppet()], shot)
        assert all(np.isfinite(effect.seconds) for effect in plan.effects)
        assert Stage(room(), (puppet(),), shot, plan).picture(0).shape == (96, 96, 3)
    # Five centimetres before the body's axis: face and chest stand out of the wall, arms and legs are in it.
    inside = plan_effects(wall(-0.05), [puppet()], Shot(camera((0.0, -4.0, 1.0), (0.0, 0.0, 1.0))))
    assert inside.on("occlusion")


def test_a_moving_camera_and_a_single_frame_are_planned_and_rendered():
    eyes = [camera((1.0 - 0.2 * i, -4.0, 1.4)) for i in range(4)]
    views, Ks = torch.cat([c.viewmats for c in eyes]), torch.cat([c.Ks for c in eyes])
    shot = Shot(Cameras(views, Ks, 96, 96))
    plan = plan_effects(room(), [puppet()], shot)
    assert plan.on("motion_blur")
    stage = Stage(room(), (puppet(),), shot, plan)
    assert not np.array_equal(stage.picture(0), stage.picture(3))
    one = plan_effects(room(), [puppet(frames=1)], Shot(camera()))
    assert not one.on("motion_blur") and one.frames == 1


def test_what_cannot_be_planned_says_why():
    with pytest.raises(ValueError, match="auto, all, none"):
        Request(("sparkle",))
    with pytest.raises(ValueError, match="strengths"):
        Request(strengths={"light": 2.0})
    with pytest.raises(ValueError, match="one length"):
        plan_effects(room(), [puppet(frames=3), puppet(frames=4)], Shot(camera()))
    with pytest.raises(ValueError, match="shutter"):
        Shot(camera(), shutter=2.0)


def test_culling_what_a_still_camera_cannot_see_changes_nothing():
    """A scene with as much behind the camera and beside the view as in it: the joint picture is that of all of it."""
    scene = room()
    shot = Shot(camera((0.0, -0.5, 1.5), (0.3, 2.0, 0.9)), shutter=0.0)
    who = puppet(at=(0.2, 1.2, 0.0))
    still = plan_effects(scene, [who], shot, Request(("occlusion",)))
    moving = Shot(Cameras(shot.cameras.viewmats.expand(4, 4, 4), shot.cameras.Ks.expand(4, 3, 3), 96, 96), shutter=0.0)
    culled, whole = Stage(scene, (who,), shot, still), Stage(scene, (who,), moving, still)
    assert np.array_equal(culled.picture(1), whole.picture(1))
    assert len(culled._views[(0.0, 0.0)].rows) < 0.8 * len(scene)


def test_two_million_gaussians_fit_a_stated_budget_or_are_refused():
    count = 2_000_000
    means = (torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 6
    shades = (means[:, :1] > 0).float().repeat(1, 3)
    scene_gaussians = replace(flat(means, 0.01), opacities=torch.full((count,), 0.2), colors=shades)
    with pytest.raises(MemoryError, match="crop or thin"):
        make_scene(scene_gaussians, memory_budget=500 * 2**20)
    scene = make_scene(scene_gaussians, metres_per_unit=1.0, memory_budget=4 * 2**30)
    shot = Shot(camera(), shutter=0.0)
    plan = plan_effects(scene, [puppet(frames=1)], shot, Request(("occlusion",)))
    assert Stage(scene, (puppet(frames=1),), shot, plan).picture(0).std() > 1


def test_a_one_frame_motion_of_one_pose_needs_no_blur_and_keeps_its_expression():
    motion = smiling(1)
    assert isinstance(motion, Motion)
    plan = plan_effects(empty_scene(), [puppet(motion)], Shot(NEAR))
    assert plan.on("expression") and not plan.on("motion_blur")


@pytest.mark.parametrize("who", [avatar, full_avatar])
def test_the_expression_of_a_motion_is_seen_on_coarse_and_full_avatars(who: Callable[[], Avatar]):
    acting = replace(puppet(smiling()), avatar=who())
    shot = Shot(NEAR, shutter=0.0)
    plan = plan_effects(empty_scene(), [acting], shot)
    still = plan_effects(empty_scene(), [acting], shot, Request(()))
    assert plan.on("expression") and not still.on("expression")
    moved = Stage(empty_scene(), (acting,), shot, plan).picture(0).astype(int)
    change = np.abs(moved - Stage(empty_scene(), (acting,), shot, still).picture(0).astype(int)).max(-1)
    assert (change > 10).sum() > 5
