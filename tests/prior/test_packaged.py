"""The prior that ships: what a fresh clone may rely on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.conventions import GREY, canonical_cameras
from ahoy_core.prior.bodymaps import CELL
from ahoy_core.prior.completion import pose_context
from ahoy_core.prior.conditioning import FACTOR, LATENT_CHANNELS, Context
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.inversion import clean_up
from ahoy_core.prior.video import EmbeddedVideo, load_video
from ahoy_core.texture.texture import canonical_vertices
from tasks.fills import Fills
from tasks.prior_folder import no_prior, prior_folder

FOLDER = prior_folder("packaged")
MEGABYTES = 40


@pytest.fixture(scope="module")
def video() -> EmbeddedVideo:
    loaded = load_video(FOLDER)
    assert isinstance(loaded, EmbeddedVideo)
    return loaded


def test_it_is_there_small_enough_and_has_a_card() -> None:
    assert no_prior("packaged", "packaged", Fills()) == ""
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < MEGABYTES * 2**20
    card = (FOLDER / "README.md").read_text()
    for expected in ("Licence", "Data", "Splits", "Seeds", "Limits", "Figures"):
        assert expected in card, expected
    assert (FOLDER / "curves.png").is_file()


def test_its_files_name_no_place_of_the_machine_that_made_it() -> None:
    for path in FOLDER.rglob("*.json"):
        assert "_name_or_path" not in path.read_text() and "/tmp" not in path.read_text(), path


@torch.no_grad()
def test_it_is_trained(video: EmbeddedVideo) -> None:
    """From noise and a bare body alone it draws somebody where the body is, and grey round them."""
    body = load_packaged_body()
    vertices = torch.from_numpy(canonical_vertices(body, body.default_betas.numpy()))
    cameras = canonical_cameras(vertices, *video.size)
    maps, azimuth = pose_context(body, vertices.expand(4, -1, -1), torch.eye(3).expand(4, 3, 3), cameras)
    size = (1, LATENT_CHANNELS, 4, video.size[0] // FACTOR, video.size[1] // FACTOR)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(0))
    context = Context(video.embed([NEUTRAL]), body=maps, azimuth=azimuth)
    made = video.decode(clean_up(video, noise, context, 1).latents)[0].transpose(0, 1)
    away = (made - GREY).square().mean(1).sqrt()
    silhouette = maps[0, :, :1].repeat_interleave(CELL, -1).repeat_interleave(CELL, -2)[:, 0]
    near = torch.nn.functional.max_pool2d(silhouette[:, None], 17, 1, 8)[:, 0]
    inside, outside = away[silhouette > 0.9].mean(), away[near < 0.01].mean()
    assert float(outside) < 0.05 and float(inside) > 3 * float(outside), (float(inside), float(outside))


@torch.no_grad()
def test_it_hears_words(video: EmbeddedVideo) -> None:
    """From words and a bare body alone, whose top and trousers are named red and blue has them so, and the reverse."""
    body = load_packaged_body()
    vertices = torch.from_numpy(canonical_vertices(body, body.default_betas.numpy()))
    cameras = canonical_cameras(vertices, *video.size)
    maps, azimuth = pose_context(body, vertices.expand(4, -1, -1), torch.eye(3).expand(4, 3, 3), cameras)
    size = (1, LATENT_CHANNELS, 4, video.size[0] // FACTOR, video.size[1] // FACTOR)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(0))

    def redness(prompt: str) -> torch.Tensor:
        """Red less blue of the torso and of the legs."""
        made = video.decode(
            clean_up(video, noise, Context(video.embed([prompt]), body=maps, azimuth=azimuth), 1).latents
        )
        cells = torch.nn.functional.avg_pool2d(made[0].transpose(0, 1), CELL)
        height, inside = maps[0, :, 3], maps[0, :, 0] > 0.9
        bands = (inside & (height > 0.15) & (height < 0.5), inside & (height > -0.7) & (height < -0.15))
        return torch.stack([(cells[:, 0] - cells[:, 2])[band].mean() for band in bands])

    one, other = redness("a person, red top, blue trousers"), redness("a person, blue top, red trousers")
    difference = (one - other) * torch.tensor([1, -1])
    assert float(difference.min()) > 0.15, (one, other)


def test_it_is_part_of_the_package() -> None:
    text = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text()
    assert '"prior/*"' in text and '"prior/*/*"' in text
