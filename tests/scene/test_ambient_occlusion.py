"""What an avatar loses of its light next to surfaces in its own shadow, against rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from ahoy_core.scene.effects import ambient_occlusion, contact_shadow
from ahoy_core.scene.effects.ambient_occlusion import light_left, surfaces_of
from tests.scene.test_references import ray_cast_sky
from tests.scene.things import body, floor, puppet


def traced_loss(mesh: trimesh.Trimesh, points: np.ndarray, normals: np.ndarray, rays: int = 160) -> np.ndarray:
    """Mean over cosine-weighted rays of what the ground lacks of its sky where they hit it (limbs are no obstacle)."""
    rng = np.random.default_rng(0)
    u, phi = rng.random((len(points), rays)), 2 * np.pi * rng.random((len(points), rays))
    local = np.stack([np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi), np.sqrt(1 - u)], -1)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frame = np.stack([x, np.cross(normals, x), normals], 1)
    rays_out = np.einsum("prk,pkd->prd", local, frame)
    down = rays_out[..., 2] < -1e-3
    way = np.where(down, -points[:, None, 2] / np.where(down, rays_out[..., 2], -1.0), 0.0)
    hit = points[:, None, :2] + way[..., None] * rays_out[..., :2]
    # The ground's own light on a grid, looked up where rays hit; further out nothing is in shadow.
    steps = np.linspace(-1.2, 1.2, 49)
    grid = np.stack([*(g.ravel() for g in np.meshgrid(steps, steps, indexing="ij")), np.zeros(49 * 49)], 1)
    sky = ray_cast_sky(mesh, grid, 64).reshape(49, 49)
    index = np.clip(np.rint((hit + 1.2) / 0.05).astype(int), 0, 48)
    inside = down & (np.abs(hit) < 1.2).all(-1)
    return (np.where(inside, 1 - sky[index[..., 0], index[..., 1]], 0.0)).mean(1)


def scene_discs(motion: str):
    who = puppet(motion)
    pose, transl = who.motion.pose[:1], who.motion.transl[:1]
    relative = who.relative(pose, transl)[0]
    points, normals = who.sample.posed(relative)
    discs = contact_shadow.carried([contact_shadow.occluders(who)], [relative])
    vertices = body()(pose, who.avatar.betas[None], transl).vertices[0]
    return points, normals, discs, trimesh.Trimesh(vertices.numpy(), body().faces.numpy(), process=False)


@pytest.mark.parametrize("motion", ["still", "walk"])
def test_the_light_lost_at_contact_is_that_of_rays(motion: str):
    points, normals, discs, mesh = scene_discs(motion)
    nearby = surfaces_of(floor(pitch=0.03), points.amin(0) - 0.8, points.amax(0) + 0.8)
    found = 1 - light_left(points, normals, nearby, discs).numpy()
    low = (points[:, 2] > 0.03) & (points[:, 2] < 0.5)  # under three centimetres a disc is as large as its distance
    truth = traced_loss(mesh, points[low].numpy(), normals[low].numpy())
    error, nothing = (float(np.sqrt(np.mean(x**2))) for x in (found[low.numpy()] - truth, truth))
    assert nothing > 0.05 and error < 0.4 * nothing, (error, nothing)
    assert np.corrcoef(found[low.numpy()], truth)[0, 1] > 0.85
    assert float(found[(points[:, 2] > 1.2).numpy()].mean()) < 0.01  # the head loses nothing


def test_the_area_of_surfaces_does_not_depend_on_their_tilt_or_on_how_densely_they_are_covered():
    corner = torch.full((3,), 5.0)
    for pitch in (0.02, 0.04):
        flat = surfaces_of(floor(pitch=pitch, extent=0.6), -corner, corner)
        assert float(flat.areas.sum()) == pytest.approx(1.2**2, rel=0.15)
        assert torch.allclose(flat.normals[:, 2].abs(), torch.ones(len(flat)), atol=1e-4)
    tilted = floor(pitch=0.02, extent=0.6)
    turn = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    half = torch.tensor([0.9**0.5, 0.0, 0.1**0.5, 0.0])  # the same turn as a quaternion
    g = tilted.gaussians
    object.__setattr__(g, "means", g.means @ turn.T)
    object.__setattr__(g, "quats", half.expand(len(g.means), 4).contiguous())
    found = surfaces_of(tilted, -corner, corner)
    assert float(found.areas.sum()) == pytest.approx(1.2**2, rel=0.2)
    assert float((found.normals @ (turn @ torch.tensor([0.0, 0, 1]))).abs().min()) > 0.99


def test_an_avatar_in_the_air_loses_nothing():
    points, normals, discs, _ = scene_discs("still")
    lifted = contact_shadow.Discs(discs.places + torch.tensor([0, 0, 2.0]), discs.facing, discs.areas)
    nearby = surfaces_of(floor(), points.amin(0) - 3, points.amax(0) + 3)
    left = light_left(points + torch.tensor([0, 0, 2.0]), normals, nearby, lifted)
    assert torch.equal(left, torch.ones(len(points)))
    assert ambient_occlusion.REACH < 2.0
