"""One contract a role, over everything that can fill it: the embedded default and the real models on tiny checkpoints.

Shapes, ranges, dtypes, the same answer under the same seed, empty and single-frame input.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.conventions import OBSERVED_VIEWMAT, Cameras, look_at, orbit_eyes, perspective_K
from ahoy_core.ingest import IngestConfig, ingest
from ahoy_core.metrics.stlpips import StLpips
from ahoy_core.models.catalogue import ADAPTERS, adapter
from ahoy_core.perceive.networks import Networks
from ahoy_core.perceive.perceive import PerceiveConfig, Perception, perceive
from ahoy_core.prior.bodymaps import CELL, CHANNELS
from ahoy_core.prior.completion import Pictures
from ahoy_core.prior.conditioning import Context
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.video import VideoModel, load_video
from ahoy_core.prior.views import PriorBody
from ahoy_core.texture.canonical import CanonicalViews
from ahoy_core.texture.fillings import TexturedBody
from ahoy_core.texture.surface import PARTS, Surface, correspondences
from tests.models.conftest import Load, Tiny
from tests.perceive.conftest import networks  # noqa: F401  (a session fixture)
from tests.prior.conftest import embedded_folder  # noqa: F401  (likewise)

H, W = 64, 48


def names(role: str, *embedded: str) -> list[str]:
    return [*embedded, *(each.name for each in ADAPTERS if each.role == role)]


def frames(count: int) -> Tensor:
    return torch.rand(count, 3, H, W, generator=torch.Generator().manual_seed(5))


def boxes(count: int) -> Tensor:
    """The subject over the middle, not there in the second frame."""
    found = torch.tensor([[0.25 * W, 0.0, 0.75 * W, float(H)]]).repeat(count, 1)
    found[1:2] = float("nan")
    return found


def same(first: Any, second: Any) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("name", names("body", "packaged"))
def test_body(name: str, load: Load) -> None:
    body = load_packaged_body() if name == "packaged" else load("body", name)
    for count in (0, 1, 2):
        out = body(torch.zeros(count, body.n_joints, 3), body.default_betas[None], torch.zeros(count, 3))
        assert out.vertices.shape == (count, len(body.lbs_weights), 3) and out.joints.shape == (count, body.n_joints, 3)
        assert out.vertices.dtype == torch.float32 and bool(torch.isfinite(out.vertices).all())
    # Metres, z up, facing -y: a person is between one and two and a half metres tall.
    assert 1.0 < float(out.vertices[0, :, 2].amax() - out.vertices[0, :, 2].amin()) < 2.5


@pytest.mark.parametrize("name", names("pose"))
def test_pose(name: str, load: Load) -> None:
    role, K = load("pose", name), perspective_K(0.9, W, H)
    for count in (0, 1, 3):
        found = role(frames(count), K, boxes(count))
        joints = found.pose.shape[1]
        assert found.pose.shape == found.joints.shape == (count, joints, 3)
        assert found.uncertainty.shape == (count, joints) and found.betas.shape[0] == count
        assert found.pose.dtype == found.joints.dtype == torch.float32 and found.found.dtype == torch.bool
        assert found.found.tolist() == [True, False, True][:count]
        # Metres in front of the camera; what was not looked for is zero.
        assert count == 0 or 0.5 < float(found.joints[0, :, 2].mean()) < 20
        assert not bool(found.joints[1:2].any())
    assert same([found.pose, found.joints], [(again := role(frames(3), K, boxes(3))).pose, again.joints])


@pytest.mark.parametrize("mode", ["image", "video"])
@pytest.mark.parametrize("name", names("mask"))
def test_mask(name: str, mode: str, tiny: Tiny) -> None:
    sam3 = tiny("mask", name)
    role = adapter("mask", name).open(sam3.model_copy(update={"options": {**sam3.options, "mode": mode}}))
    for count in (0, 1, 3):
        masks = role(frames(count), boxes(count))
        assert masks.shape == (count, 1, H, W) and masks.dtype == torch.float32
        assert count == 0 or (float(masks.min()) >= 0 and float(masks.max()) <= 1)
        assert mode == "video" or count == 0 or float(masks[0].max()) > 0  # an untrained tracker may lose everybody
        assert mode == "video" or not bool(masks[1:2].any())
    assert torch.equal(masks, role(frames(3), boxes(3)))
    nowhere = torch.full((2, 4), float("nan"))
    assert not bool(role(frames(2), nowhere).any())


@pytest.mark.parametrize("name", names("surface"))
def test_surface(name: str, load: Load) -> None:
    role = load("surface", name)
    for count in (0, 1, 3):
        found = role(frames(count), boxes(count))
        assert found.part.shape == (count, H, W) and found.part.dtype == torch.uint8
        assert found.uv.shape == (count, 2, H, W) and found.uv.dtype == torch.float32
        assert count == 0 or (0 < int(found.part.max()) <= 24 and float(found.uv.min()) >= 0)
        assert count == 0 or float(found.uv.max()) <= 1
        assert not bool(found.uv[(found.part == 0)[:, None].expand_as(found.uv)].any())
        assert not bool(found.part[1:2].any())
    assert same([found.part, found.uv], [(again := role(frames(3), boxes(3))).part, again.uv])


@pytest.fixture(scope="module")
def perceived(networks: Networks) -> tuple[np.ndarray, Perception, Perception]:  # noqa: F811
    """One frame of the bundled clip, and what the embedded pose, mask and head say of it, twice."""
    with resources.as_file(resources.files("ahoy_core.assets") / "demo.mp4") as path:
        clip = ingest(path, IngestConfig(max_frames=1, max_size=256)).arrays()
    body, config = load_packaged_body(), PerceiveConfig(iterations=3)
    once, again = (perceive(clip["frames"], clip["pts"], clip["shot"], None, body, networks, config) for _ in range(2))
    return clip["frames"], once, again


def test_embedded_pose(perceived: tuple[np.ndarray, Perception, Perception]) -> None:
    """The landmark networks and the fit: bodies of ours in metres before the camera, one a frame, the same twice."""
    _, once, again = perceived
    body = load_packaged_body()
    assert once.pose.shape == (1, body.n_joints, 3) and once.transl.shape == (1, 3)
    assert once.betas.shape == (body.n_betas,) and once.joint_confidence.shape == (1, body.n_joints)
    for name in ("pose", "transl", "betas", "joint_confidence", "frame_confidence"):
        value = getattr(once, name)
        assert value.dtype == np.float32 and np.isfinite(value).all() and np.array_equal(value, getattr(again, name))
    assert 0.5 < once.transl[0, 1] < 20 and 0 <= once.frame_confidence[0] <= 1


@pytest.mark.parametrize("name", ["visible", "head"])
def test_embedded_masks(name: str, perceived: tuple[np.ndarray, Perception, Perception]) -> None:
    """Role "mask" and role "head" of one frame: somebody is there, and a head is nowhere above the visible person."""
    frames, once, again = perceived
    mask = getattr(once, name)
    assert mask.shape == frames.shape[:3] and mask.dtype == np.uint8 and mask.max() > 128
    assert bool((once.head <= once.visible).all()) and np.array_equal(mask, getattr(again, name))


def test_embedded_pose_mask_and_head_want_a_frame(networks: Networks) -> None:  # noqa: F811
    empty = np.zeros((0, 32, 32, 3), np.uint8)
    with pytest.raises(ValueError, match="with T > 0"):
        perceive(empty, np.zeros(0), np.zeros(0, int), None, load_packaged_body(), networks, PerceiveConfig())


def test_embedded_surface() -> None:
    """The fitted body, ray-cast: parts and UV where the mask sees it, nothing elsewhere."""
    body = load_packaged_body()
    surface, K = Surface.of(body), perspective_K(0.6, W, H).numpy()
    for count in (0, 1, 3):
        pose, transl = torch.zeros(count, body.n_joints, 3), torch.tensor([[0.0, 4.0, -0.8]]).expand(count, 3)
        vertices = body(pose, body.default_betas[None].expand(count, -1), transl).vertices.numpy()
        seen = np.full((count, H, W), 255, np.uint8)
        seen[1:2] = 0
        found = correspondences(surface, vertices, OBSERVED_VIEWMAT.numpy(), K, seen)
        assert found.part.shape == (count, H, W) and found.part.dtype == np.uint8
        assert found.uv.shape == (count, 2, H, W) and found.uv.dtype == np.float32
        there = np.broadcast_to((found.part > 0)[:, None], found.uv.shape)
        assert np.isnan(found.uv[~there]).all() and not (found.uv[there] < 0).any() and not (found.uv[there] > 1).any()
        assert count == 0 or ((0 < found.part[0].max() < len(PARTS)) and not found.part[1:2].any())
    again = correspondences(surface, vertices, OBSERVED_VIEWMAT.numpy(), K, seen)
    assert np.array_equal(found.part, again.part) and np.array_equal(found.uv, again.uv, equal_nan=True)


@pytest.mark.parametrize("name", names("head"))
def test_head(name: str, load: Load) -> None:
    role = load("head", name)
    for count in (0, 1, 3):
        masks = torch.zeros(count, 1, H, W)
        masks[:, :, 5:70, 10:40] = 0.8
        masks[1:2] = 0
        heads = role(frames(count), masks)
        assert heads.shape == masks.shape and heads.dtype == torch.float32
        assert bool((heads >= 0).all()) and bool((heads <= masks + 1e-6).all())
        assert count == 0 or float(heads[0].max()) > 0
    assert torch.equal(heads, role(frames(3), masks))
    assert not bool(role(frames(1), torch.zeros(1, 1, H, W)).any())


def textured_body() -> TexturedBody:
    views = (255 * torch.rand(4, H, W, 4, generator=torch.Generator().manual_seed(1))).byte().numpy()
    cameras = Cameras(torch.eye(4).expand(4, 4, 4), torch.eye(3).expand(4, 3, 3), W, H, "ortho")
    return TexturedBody(CanonicalViews(views, views[..., 3], views[0], cameras))


@pytest.fixture(scope="module")
def prior_body(embedded_folder: Path) -> PriorBody:  # noqa: F811
    """The embedded prior before one person who fills the pictures; untrained, so its answers are noise."""
    pictures = Pictures(torch.full((4, 3, H, W), 0.5), torch.ones(4, 1, H, W), torch.zeros(4, 1, H, W), moving=False)
    maps, azimuth = torch.zeros(1, 4, CHANNELS, H // CELL, W // CELL), torch.zeros(1, 4)
    return PriorBody(load_video(embedded_folder), pictures, maps, azimuth, PriorConfig())


EMBEDDED_PICTURES = ("textured body", "embedded prior")


def hole() -> Tensor:
    mask = torch.zeros(1, H, W)
    mask[:, 20:60, 15:40] = 1
    return mask


@pytest.mark.parametrize("name", names("inpaint", *EMBEDDED_PICTURES))
def test_inpaint(name: str, load: Load, prior_body: PriorBody) -> None:
    embedded = {"textured body": textured_body().inpaint, "embedded prior": prior_body.inpaint}
    role = embedded[name] if name in embedded else load("inpaint", name)
    image = frames(1)[0]
    filled = role(image, hole(), "a person", 3)
    assert filled.shape == image.shape and filled.dtype == torch.float32
    assert float(filled.min()) >= 0 and float(filled.max()) <= 1
    outside = (hole() == 0).expand_as(image)
    assert torch.equal(filled[outside], image[outside]) and not torch.equal(filled, image)
    assert torch.equal(filled, role(image, hole(), "a person", 3))
    if name != "textured body":
        assert not torch.equal(filled, role(image, hole(), "a person", 4)), "the seed matters"
    assert torch.equal(role(image, torch.zeros(1, H, W)), image), "nothing to fill: nothing changes"
    with pytest.raises(ValueError, match="expected image"):
        role(image, torch.zeros(1, H, W + 8))


@pytest.mark.parametrize("name", names("views", *EMBEDDED_PICTURES))
def test_views(name: str, load: Load, prior_body: PriorBody) -> None:
    embedded = {"textured body": textured_body().views, "embedded prior": prior_body.views}
    role = embedded[name] if name in embedded else load("views", name)
    image = frames(1)[0]
    views, azimuths = role(image, hole())
    assert views.shape == (4, 3, H, W) and views.dtype == torch.float32
    assert sorted(azimuths) == [0.0, 90.0, 180.0, 270.0]
    assert float(views.min()) >= 0 and float(views.max()) <= 1
    assert torch.equal(views, role(image, hole())[0])


@pytest.mark.parametrize("name", names("face"))
def test_face(name: str, load: Load) -> None:
    role = load("face", name)
    for count in (0, 1, 3):
        eyes = orbit_eyes(torch.zeros(3), 1.0, torch.linspace(-0.5, 0.5, count))
        cameras = Cameras(look_at(eyes, torch.zeros(3)), perspective_K(0.3, 40, 40).expand(count, 3, 3), 40, 40)
        made = role(frames(2)[:, :, :W], torch.zeros(count, 52), cameras, 7)
        assert made.shape == (count, 3, 40, 40) and made.dtype == torch.float32
        assert count == 0 or (float(made.min()) >= 0 and float(made.max()) <= 1)
    assert torch.equal(made, role(frames(2)[:, :, :W], torch.zeros(3, 52), cameras, 7))
    assert not torch.equal(made, role(frames(2)[:, :, :W], torch.zeros(3, 52), cameras, 8)), "the seed matters"
    with pytest.raises(ValueError, match="at least one reference"):
        role(frames(0), torch.zeros(3, 52), cameras)


@torch.no_grad()
@pytest.mark.parametrize("name", names("video", "embedded prior"))
def test_video(name: str, load: Load, embedded_folder: Path) -> None:  # noqa: F811
    role = load_video(embedded_folder) if name == "embedded prior" else load("video", name)
    assert isinstance(role, VideoModel) and role.size[0] == 2 * role.size[1]
    assert role.clip_frames(5) == 5 and role.clip_frames(6) >= 6
    for count in (1, 5):
        clip = torch.rand(2, 3, count, 32, 32, generator=torch.Generator().manual_seed(2))
        latents = role.encode(clip)
        text = role.embed(["a <v> person", ""])
        velocity = role.velocity(latents, torch.tensor([0.95, 0.3]), Context(text))
        decoded = role.decode(latents)
        times = count if role.reads_bodies else 1 + (count - 1) // 4
        assert latents.shape[0] == 2 and latents.shape[2] == times
        assert velocity.shape == latents.shape and decoded.shape == clip.shape
        for value in (latents, velocity, decoded, text):
            assert value.dtype == torch.float32 and value.device.type == "cpu" and bool(torch.isfinite(value).all())
        assert float(decoded.min()) >= 0 and float(decoded.max()) <= 1
    assert torch.equal(velocity, role.velocity(latents, torch.tensor([0.95, 0.3]), Context(text)))
    one = role.velocity(latents[:1], 0.95, Context(text[:1]))
    torch.testing.assert_close(one, velocity[:1], rtol=1e-4, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("name", names("perceptual", "ST-LPIPS"))
def test_perceptual(name: str, load: Load) -> None:
    role = StLpips() if name == "ST-LPIPS" else load("perceptual", name)
    a, b = frames(3), frames(3).flip(0)
    distance = role(a, b)
    assert role.name and distance.shape == (3,) and distance.dtype == torch.float32
    assert bool((distance >= 0).all()) and float(distance[0]) > 0 and not bool(role(a, a).any())
    assert torch.equal(distance, role(a, b)) and role(a[:0], b[:0]).shape == (0,)
    torch.testing.assert_close(role(a[:1], b[:1]), distance[:1], rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="of one size"):
        role(a, b[:, :, :40])
