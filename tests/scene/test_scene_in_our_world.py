"""Scenes moved into our world: similarity transforms, turned harmonics, ground and scale."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.conventions import look_at, perspective_K
from ahoy_core.formats.cameras import CameraFile
from ahoy_core.formats.ply import write_ply
from ahoy_core.formats.spz import write_spz
from ahoy_core.scene.ground import find_ground
from ahoy_core.scene.scene import make_scene, read_splats
from ahoy_core.splat import Gaussians, rasterization
from ahoy_core.splat.transform import Similarity, rotate_sh, transform_gaussians
from tests.formats.splats import cloud, harmonics
from tests.scene.things import floor, room

C0 = 0.28209479177387814


def similarity(seed: int = 0, scale: float = 1.7) -> Similarity:
    g = torch.Generator().manual_seed(seed)
    omega = torch.randn(3, generator=g, dtype=torch.float64)
    return Similarity(axis_angle_to_matrix(omega), torch.randn(3, generator=g, dtype=torch.float64), scale)


def rendered(gaussians: Gaussians, rest: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
    coefficients = torch.cat([((gaussians.colors - 0.5) / C0)[:, None], rest], 1)
    degree = {3: 1, 8: 2, 15: 3}[rest.shape[1]]
    K = perspective_K(0.8, 48, 48)[None]
    parts = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, coefficients)
    return rasterization(*parts, view[None], K, 48, 48, sh_degree=degree)[0]


@pytest.mark.parametrize("terms", [3, 8, 15])
@pytest.mark.parametrize("seed", [0, 1])
def test_scene_and_camera_moved_together_give_the_same_picture(terms: int, seed: int):
    gaussians, rest, move = cloud(300), harmonics(300, terms), similarity(seed)
    view = look_at(torch.tensor([0.5, -6.0, 1.0]), torch.zeros(3))
    before = rendered(gaussians, rest, view)
    moved, turned = transform_gaussians(gaussians, move, rest)
    after = rendered(moved, turned, move.viewmats(view[None])[0])
    # float32 positions and quaternions: a step of 8 bits at a few edges, a hundredth of it on average.
    assert float((before - after).abs().max()) < 4e-3 and float((before - after).abs().mean()) < 4e-5
    unturned = rendered(moved, rest, move.viewmats(view[None])[0])
    assert float((before - unturned).abs().mean()) > 5e-3


def test_turning_there_and_back_or_in_two_steps_is_exact():
    rest, a, b = harmonics().double(), similarity(2).rotation, similarity(3).rotation
    assert torch.allclose(rotate_sh(rotate_sh(rest, a), a.T), rest, atol=1e-9)
    assert torch.allclose(rotate_sh(rotate_sh(rest, a), b), rotate_sh(rest, b @ a), atol=1e-9)
    move = similarity(4)
    points = torch.randn(5, 3, dtype=torch.float64)
    assert torch.allclose(move.inverse().points(move.points(points)), points, atol=1e-9)
    assert torch.allclose(move.then(move.inverse()).points(points), points, atol=1e-9)


def test_reflections_and_bad_scales_are_refused():
    with pytest.raises(ValueError, match="reflection"):
        Similarity(torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.zeros(3))
    with pytest.raises(ValueError, match="scale"):
        Similarity(torch.eye(3), torch.zeros(3), 0.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_the_floor_of_a_tilted_room_of_any_scale_is_found(seed: int, scale: float):
    move = similarity(seed, scale)
    tilted, _ = transform_gaussians(room().gaussians, move)
    up = (move.rotation @ torch.tensor([0.05, -0.1, 1.0], dtype=torch.float64)).float()  # roughly
    scene = make_scene(tilted, up=up, metres_per_unit=1 / scale)
    back = scene.to_world.points(move.points(room().gaussians.means))
    assert float((back[:, 2] - room().gaussians.means[:, 2]).abs().max()) < 0.02  # metres
    assert scene.ground is not None and any("ground found" in note for note in scene.notes)


def test_cameras_tell_up_and_scale():
    eyes = torch.tensor([[1.0, -2.0, 1.5], [-1.0, -2.0, 1.5], [0.0, -1.5, 1.5]])
    views = look_at(eyes, torch.tensor([0.0, 1.0, 1.0]))
    move = similarity(5, 0.25)
    file = CameraFile(("a", "b", "c"), move.viewmats(views), torch.eye(3).expand(3, 3, 3), ((8, 8),) * 3)
    scene = make_scene(transform_gaussians(room().gaussians, move)[0], cameras=file)
    assert scene.to_world.scale == pytest.approx(4.0, rel=0.02)
    world = scene.to_world.viewmats(file.viewmats)
    assert torch.allclose(torch.linalg.inv(world)[:, 2, 3], torch.full((3,), 1.5), atol=0.02)


def test_a_ball_and_a_handful_have_no_ground_and_an_empty_scene_is_whole():
    g = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(3000, 3, generator=g), dim=1)
    blob = Gaussians(ball, torch.randn(3000, 4, generator=g), torch.full((3000, 3), 0.02), torch.ones(3000), ball.abs())
    assert find_ground(blob, torch.tensor([0.0, 0, 1])) is None
    assert find_ground(cloud(5)) is None
    nothing = Gaussians(*(part[:0] for part in vars(cloud(1)).values() if part is not None))
    scene = make_scene(nothing)
    assert len(scene) == 0 and scene.ground is None and any("no ground" in note for note in scene.notes)


def test_a_ceiling_is_no_ground_when_up_is_known():
    below, above = floor().gaussians, transform_gaussians(floor(extent=2.0).gaussians, _lift(2.5))[0]
    names = ("means", "quats", "scales", "opacities", "colors")
    both = Gaussians(*(torch.cat([getattr(below, name), getattr(above, name)]) for name in names))
    found = find_ground(both, torch.tensor([0.0, 0.0, 1.0]))
    assert found is not None and abs(found.offset) < 0.05 and float(found.normal[2]) > 0.99


def _lift(z: float) -> Similarity:
    return Similarity(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, z], dtype=torch.float64))


def test_splats_are_read_from_each_format_and_faint_ones_are_left_out(tmp_path: Path):
    write_ply(tmp_path / "a.ply", cloud())
    write_spz(tmp_path / "a.spz", cloud())
    for name in ("a.ply", "a.spz"):
        assert len(read_splats(tmp_path / name)[0]) == 200
    with pytest.raises(ValueError, match=r"\.ply, \.spz or \.glb"):
        read_splats(tmp_path / "a.obj")
    scene = make_scene(cloud())
    assert len(scene) == int((cloud().opacities >= 1 / 255).sum()) and math.isclose(scene.to_world.scale, 1.0)
