"""A subject's frames and canonical views: framed by the bare body, coverage where the video showed something."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.conventions import OBSERVED_VIEWMAT, Cameras, perspective_K
from ahoy_core.prior.canonical import CLEAN_UP, CanonicalFill, check_prior
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.selfcheck import BASELINE
from ahoy_core.prior.subject import subject_frames
from ahoy_core.prior.transformer import build_transformer
from ahoy_core.prior.video import VideoModel
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.canonical import canonical_views
from ahoy_core.texture.fill import FillKind, fill_atlas
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import canonical_vertices


@pytest.fixture(scope="module")
def body() -> PackagedBody:
    return load_packaged_body()


def test_a_subject_is_framed_by_its_whole_body_even_where_hidden(body: PackagedBody) -> None:
    pose = canonical_pose(body)[None]
    vertices = body(pose, body.default_betas[None], torch.tensor([[0.3, 5.0, 0.1]])).vertices
    cameras = Cameras(OBSERVED_VIEWMAT[None], perspective_K(math.radians(50), 200, 160)[None], 200, 160)
    image = torch.zeros(1, 3, 160, 200)
    image[:, 0] = 1.0
    visible = torch.zeros(1, 1, 160, 200)
    visible[..., :80, :] = 1  # only the upper half of the picture is seen
    frames = subject_frames(image, visible, cameras, body, vertices, torch.eye(3)[None])
    assert frames.images.shape == (1, 3, HEIGHT, WIDTH) and frames.body is not None and frames.azimuth is not None
    inside = frames.body[0, 0] > 0
    rows = torch.nonzero(inside.any(1))[:, 0]
    columns = torch.nonzero(inside.any(0))[:, 0]
    wide = (columns.max() - columns.min() + 1) * 4 / WIDTH
    tall = (rows.max() - rows.min() + 1) * 4 / HEIGHT
    assert float(torch.stack([wide, tall]).max()) == pytest.approx(0.93, abs=0.08)  # cells of 4 pixels, cut ones count
    assert math.cos(float(frames.azimuth[0])) == pytest.approx(1, abs=1e-5)  # the camera looks straight at the front
    seen = frames.visible[0, 0] > 0.9999
    assert 0.3 < float(seen.float().mean()) < 0.7
    assert float((frames.images[0, 0][seen] - 1).abs().max()) < 1e-5
    assert float((frames.images[0][:, frames.visible[0, 0] == 0] - 0.5).abs().max()) < 1e-6


def atlas(size: int = 64) -> ObservedAtlas:
    """All seen, all red."""
    rgb = np.full((size, size, 3), (200, 40, 40), np.uint8)
    return ObservedAtlas(rgb, np.ones((size, size), np.float32), np.zeros((size, size), np.int32))


def test_the_fill_shows_what_is_kept_and_covers_only_that(body: PackagedBody) -> None:
    fill = CanonicalFill(body, body.default_betas.numpy(), atlas())
    everything = torch.from_numpy(fill.observed)
    full = fill(everything)
    assert full.frames.shape == (4, 3, HEIGHT, WIDTH) and fill.maps.shape == (1, 4, 7, HEIGHT // 4, WIDTH // 4)
    inside = full.mask > 0.99
    assert (
        float(full.coverage[inside].mean()) > 0.9
        and float(full.frames[full.mask.expand(-1, 3, -1, -1) == 0].std()) == 0
    )
    # The maps and the pictures show the same silhouette.
    silhouette = torch.nn.functional.avg_pool2d(full.mask, 4)[:, 0]
    assert float((silhouette - fill.maps[0, :, 0]).abs().mean()) < 0.04  # cells at the outline differ a little
    front = torch.from_numpy(fill.points[:, 1] < np.median(fill.points[:, 1]))
    half = fill(everything & front)
    shown = [float(half.coverage[view][inside[view]].mean()) for view in (0, 2)]
    assert shown[0] > shown[1] + 0.3


@pytest.mark.parametrize("settings", [("both", True), ("both", False), ("harmonic", False)])
def test_the_fill_that_competes_is_the_texture_stages_own(body: PackagedBody, settings: tuple[FillKind, bool]) -> None:
    surface, betas = Surface.of(body), body.default_betas.numpy()
    half, texels = atlas(), texel_map(surface, 64)
    vertices = canonical_vertices(body, betas)
    points = texels.points(vertices, surface.faces)
    seen = np.zeros(64 * 64, dtype=bool)
    seen[texels.flat] = points[:, 1] < 0
    half.coverage[~seen.reshape(64, 64)] = 0
    # A lit front: brighter on one side, so that light and kind of fill both matter.
    half.rgb.reshape(-1, 3)[texels.flat] = np.clip(130 + 300 * points[:, :1], 0, 255).astype(np.uint8)
    kind, light = settings
    filled = fill_atlas(half, surface, texels, vertices, kind, light)
    expected = canonical_views(surface, texels, vertices, half, filled.rgb, HEIGHT, WIDTH).views
    fill = CanonicalFill(body, betas, half, fill=kind, light=light)
    made = fill(torch.from_numpy(fill.observed))
    inside = made.mask[:, 0] > 0.999
    colours = torch.from_numpy(expected[..., :3]).float() / 255
    torch.testing.assert_close(made.frames.permute(0, 2, 3, 1)[inside], colours[inside], rtol=0, atol=2e-3)


def test_the_check_runs_with_the_prior_and_names_a_winner(body: PackagedBody, embedded: VideoModel) -> None:
    fill = CanonicalFill(body, body.default_betas.numpy(), atlas())
    check = check_prior(embedded, fill, regions=1)
    assert check.regions == 1 and {BASELINE, CLEAN_UP} <= set(check.errors)
    assert check.winner == BASELINE  # an untrained prior loses


def test_training_starts_where_pure_noise_becomes_the_coarse_latents() -> None:
    from ahoy_core.prior.conditioning import Context, timesteps, transformer_input

    torch.manual_seed(0)
    transformer = build_transformer(width=160, layers=1).eval()
    noise, coarse = torch.randn(2, 1, 16, 2, 8, 4)
    context = Context(torch.zeros(1, 4, 64), coarse=coarse, coverage=torch.zeros(1, 2, 8, 4))
    with torch.no_grad():
        steps = timesteps(torch.ones(1), noise, None)
        velocity = transformer(
            transformer_input(noise, context, torch.zeros(12, 17)), steps, context.text, return_dict=False
        )[0]
    error = (velocity - (noise - coarse)).square().mean() / (noise - coarse).square().mean()
    # The last normalisation rescales: a tenth in power, against 1 for an untrained network.
    assert float(error) < 0.1
