"""The prior sees colours in even light, and what it makes is lit where it lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.body.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from ahoy_core.conventions import GREY, Cameras, canonical_cameras, look_at
from ahoy_core.prior.bodymaps import light_maps
from ahoy_core.prior.completion import Pictures, repaint
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.light import brightness_on, lit, unlit
from ahoy_core.prior.subject import subject_frames
from ahoy_core.prior.video import VideoModel

HEIGHT, WIDTH = 64, 32
FROM_FRONT = np.array([0.0, -0.3, 0.0])  # the person faces -y


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


def front_camera(vertices: torch.Tensor) -> Cameras:
    return canonical_cameras(vertices, HEIGHT, WIDTH)[0:1]


def posed(body: PackagedBody, turned: float) -> torch.Tensor:
    """Vertices [1,V,3] in canonical pose, turned about the vertical axis through the origin, radians."""
    pose = canonical_pose(body)[None].clone()
    turn = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, turned]]))
    pose[:, 0] = matrix_to_axis_angle(turn @ axis_angle_to_matrix(pose[:, 0]))
    return body(pose, body.default_betas[None], torch.zeros(1, 3)).vertices


@pytest.mark.parametrize(("turned", "low", "high"), [(0.0, 1.05, 1.31), (np.pi, 0.69, 0.95)])
def test_a_person_carries_the_light_about(body: PackagedBody, turned: float, low: float, high: float) -> None:
    vertices = posed(body, turned)
    brightness = brightness_on(body, body.default_betas.numpy(), FROM_FRONT)
    light = light_maps(body, vertices, front_camera(vertices[0]), brightness)
    assert light.shape == (1, 1, HEIGHT, WIDTH)
    middle = light[0, 0, HEIGHT // 4 : HEIGHT // 2, WIDTH // 2 - 2 : WIDTH // 2 + 2]
    assert low < float(middle.mean()) < high
    assert float(light[0, 0, 0, 0]) == 1, "far from the body nothing is known"


def test_what_is_worn_over_the_body_is_lit_like_it(body: PackagedBody) -> None:
    vertices = posed(body, 0.0)
    cameras = front_camera(vertices[0])
    light = light_maps(body, vertices, cameras, brightness_on(body, body.default_betas.numpy(), FROM_FRONT))[0, 0]
    pixels = cameras.project(vertices).pixels[0].long()
    shown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    shown[pixels[:, 1].clamp(0, HEIGHT - 1), pixels[:, 0].clamp(0, WIDTH - 1)] = True
    row = HEIGHT // 3
    edge = int(shown[row].nonzero().min())
    assert float(light[row, edge - 2]) != 1, "a loose sleeve two pixels off the arm"


def test_light_is_taken_off_and_put_back() -> None:
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(2, 1, HEIGHT, WIDTH, generator=generator).round()
    mask[0, 0, :8] = 0.5
    light = 0.8 + 0.4 * torch.rand(2, 1, HEIGHT, WIDTH, generator=generator)
    person = 0.1 + 0.6 * torch.rand(2, 3, HEIGHT, WIDTH, generator=generator)
    frames = person * mask + GREY * (1 - mask)
    even = unlit(frames, mask, light)
    torch.testing.assert_close(even, person / light * mask + GREY * (1 - mask))
    torch.testing.assert_close(lit(even, mask, light), frames)
    assert unlit(frames, mask, None) is frames and lit(frames, mask, None) is frames


def test_the_prior_never_sees_the_light(embedded: VideoModel) -> None:
    """One person in even light and in any other: the same repainting, lit."""
    generator = torch.Generator().manual_seed(1)
    even = 0.2 + 0.4 * torch.rand(2, 3, HEIGHT, WIDTH, generator=generator)
    coverage = torch.zeros(2, 1, HEIGHT, WIDTH)
    coverage[0] = 1
    light = torch.tensor([1.2, 0.6]).view(2, 1, 1, 1).expand_as(coverage)
    plain = Pictures(even, torch.ones_like(coverage), coverage)
    seen = replace(plain, frames=lit(even, plain.mask, light), light=light)
    maps, azimuth = torch.rand(1, 2, 7, HEIGHT // 4, WIDTH // 4), torch.zeros(1, 2)
    made = repaint(embedded, plain, maps, azimuth, PriorConfig())
    expected = lit(made, plain.mask, light)
    torch.testing.assert_close(repaint(embedded, seen, maps, azimuth, PriorConfig()), expected, rtol=0, atol=1e-4)
    blind = repaint(embedded, replace(seen, light=None), maps, azimuth, PriorConfig())
    assert float((blind - expected).abs().mean()) > 0.01


def test_frames_for_the_fine_tuning_are_in_even_light(body: PackagedBody) -> None:
    """Somebody of one colour, filmed in light from the front and turning: of one colour from every side."""
    vertices = torch.cat([posed(body, angle) for angle in (0.0, np.pi / 2, np.pi)])
    camera = look_at(torch.tensor([[0.0, -3.5, 1.0]]), torch.tensor([0.0, 0.0, 1.0]))
    K = torch.tensor([[220.0, 0.0, 64.0], [0.0, 220.0, 128.0], [0.0, 0.0, 1.0]])
    cameras = Cameras(camera.expand(3, 4, 4), K.expand(3, 3, 3), 128, 256)
    brightness = brightness_on(body, body.default_betas.numpy(), FROM_FRONT)
    images = (0.4 * light_maps(body, vertices, cameras, brightness)).expand(3, 3, 256, 128)
    visible = torch.ones(3, 1, 256, 128)
    roots = torch.eye(3).expand(3, 3, 3)
    seen, even = (
        subject_frames(images, visible, cameras, body, vertices, roots, brightness=given)
        for given in (None, brightness)
    )
    inside = (
        even.body[:, :1].repeat_interleave(4, -1).repeat_interleave(4, -2) > 0.99 if even.body is not None else None
    )
    assert inside is not None and int(inside.sum()) > 1000
    off = [float((frames.images[:, :1] - 0.4)[inside].abs().mean()) for frames in (seen, even)]
    assert off[1] < 0.01 and off[0] > 5 * off[1]
