"""Repainting pictures: evidence stays, everything else may change, and baselines are what they say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ahoy_core.prior.clips import Clips, region_weight
from ahoy_core.prior.completion import Pictures, composited, repaint
from ahoy_core.prior.config import InversionConfig, PriorConfig
from ahoy_core.prior.corpus.dress import KINDS
from ahoy_core.prior.evaluate import (
    back_from_front,
    mean_colours,
    mirrored_front,
    repair_methods,
    repaired,
)
from ahoy_core.prior.round_trip import round_trips
from ahoy_core.prior.scores import gradient_energy, psnr
from ahoy_core.prior.video import VideoModel

FRAMES, HEIGHT, WIDTH = 2, 64, 32


def pictures() -> Pictures:
    generator = torch.Generator().manual_seed(0)
    frames = torch.rand(FRAMES, 3, HEIGHT, WIDTH, generator=generator)
    coverage = torch.zeros(FRAMES, 1, HEIGHT, WIDTH)
    coverage[0, :, :32] = 1
    return Pictures(frames, torch.ones_like(coverage), coverage)


def body() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(1, FRAMES, 7, HEIGHT // 4, WIDTH // 4), torch.zeros(1, FRAMES)


@pytest.mark.parametrize("config", [PriorConfig(), PriorConfig(method="inversion", inversion=InversionConfig(steps=1))])
def test_held_regions_come_back_through_the_autoencoder_only(embedded: VideoModel, config: PriorConfig) -> None:
    given = pictures()
    maps, azimuth = body()
    made = repaint(embedded, given, maps, azimuth, config)
    with torch.no_grad():
        coded = embedded.decode(embedded.encode(given.frames.transpose(0, 1)[None]))[0].transpose(0, 1)
    inner = (slice(0, 1), slice(None), slice(0, 8))  # rows away from the border: a latent is seen by its neighbours too
    torch.testing.assert_close(made[inner], coded[inner], rtol=0, atol=0.05)
    assert float((made[1] - coded[1]).abs().mean()) > 0.02
    pasted = composited(made, given)
    assert torch.equal(pasted[0, :, :32], given.frames[0, :, :32]) and torch.equal(pasted[1], made[1])


def test_a_head_is_never_the_priors() -> None:
    given, made = pictures(), torch.rand(FRAMES, 3, HEIGHT, WIDTH)
    heads = torch.zeros_like(given.mask)
    heads[1, :, :20] = 1
    pasted = composited(made, replace(given, heads=heads))
    assert torch.equal(pasted[1, :, :20], given.frames[1, :, :20]) and torch.equal(pasted[1, :, 20:], made[1, :, 20:])
    assert not torch.equal(composited(made, given)[1, :, :20], given.frames[1, :, :20])


def test_the_outline_is_the_guesss_whatever_was_generated() -> None:
    """Red, made with a halo, comes out within the guess's alpha over grey: edges too are red, and nothing is beside."""
    mask = torch.zeros(1, 1, HEIGHT, WIDTH)
    mask[..., 20:40, 10:20] = 1
    mask[..., 20:40, 9] = 0.4
    mask[..., 50, 25] = 0.6  # too thin to show a colour of its own
    guess = 0.5 + 0.1 * mask.expand(-1, 3, -1, -1)
    red = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    made = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    made[..., 10:60, 5:30] = 0.8 * red + 0.1
    made[..., 20:40, 10:20] = red
    pasted = composited(made, Pictures(guess, mask, torch.zeros_like(mask)))
    torch.testing.assert_close(pasted[0, :, 20:40, 10:20], red.expand(-1, 20, 10))
    torch.testing.assert_close(pasted[0, :, 20:40, 9], (0.4 * red + 0.3)[..., 0].expand(-1, 20))
    torch.testing.assert_close(pasted[0, :, 50, 25], guess[0, :, 50, 25])
    assert torch.equal(pasted[(mask == 0).expand_as(pasted)], torch.full((int((mask == 0).sum()) * 3,), 0.5))


def test_the_seed_decides(embedded: VideoModel) -> None:
    maps, azimuth = body()
    one, two = (repaint(embedded, pictures(), maps, azimuth, PriorConfig(seed=seed)) for seed in (1, 2))
    assert torch.equal(one, repaint(embedded, pictures(), maps, azimuth, PriorConfig(seed=1)))
    assert not torch.equal(one, two)


@pytest.mark.parametrize("name", ["mask", "coverage", "heads"])
def test_masks_of_another_size_are_refused(name: str) -> None:
    fitting = torch.rand(2, 1, 8, 8)
    with pytest.raises(ValueError, match=f"expected {name}"):
        Pictures(torch.rand(2, 3, 8, 8), **{"mask": fitting, "coverage": fitting, name: torch.rand(2, 8, 8)})


def clips() -> Clips:
    """Two people of two colours, red above and blue below, who look alike from all sides."""
    part = torch.full((2, 2, HEIGHT, WIDTH), 255, dtype=torch.uint8)
    part[..., 8:32, 8:24] = KINDS.index("upper")
    part[..., 32:56, 8:24] = KINDS.index("lower")
    frames = torch.full((2, 2, 3, HEIGHT, WIDTH), 0.5)
    for kind, colour in (("upper", (0.8, 0.1, 0.1)), ("lower", (0.1, 0.1, 0.8))):
        frames = torch.where((part == KINDS.index(kind))[:, :, None], torch.tensor(colour)[:, None, None], frames)
    mask = (part != 255)[:, :, None].float()
    coverage = mask * torch.tensor([1.0, 0.0]).view(1, 2, 1, 1, 1)
    coarse = torch.where(coverage > 0, frames, torch.full_like(frames, 0.5))
    body_ = torch.zeros(2, 2, 7, HEIGHT // 4, WIDTH // 4)
    return Clips(frames, mask, coverage, coarse, part, body_, torch.tensor([[0.0, 3.14]] * 2))


def test_mean_colours_of_plain_people_are_right() -> None:
    given = clips()
    for made in (mean_colours(given), mirrored_front(given)):
        weight = region_weight(given, "torso")
        assert float(psnr(made, given.frames, weight)[:, 1].min()) > 60
    assert torch.isnan(psnr(given.frames, given.frames, region_weight(given, "head"))).all()


def test_psnr_counts_only_what_it_is_told_to() -> None:
    made, truth = torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)
    made[..., :4] = 0.1
    made[..., 4:] = 1.0
    weight = torch.zeros(1, 1, 8, 8)
    weight[..., :4] = 1
    assert float(psnr(made, truth, weight)) == pytest.approx(20.0, abs=1e-4)


def test_gradient_energy_tells_blur_from_detail() -> None:
    sharp = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    blurred = torch.nn.functional.avg_pool2d(sharp, 3, 1, 1)
    weight = torch.ones(1, 1, 16, 16)
    assert gradient_energy(blurred, weight) < 0.3 * gradient_energy(sharp, weight)
    # Independent uniform values differ by 1/6 in mean square.
    assert gradient_energy(sharp, weight) == pytest.approx(1 / 6, rel=0.15)


def test_the_measurements_run_on_a_prior(embedded: VideoModel) -> None:
    figures = back_from_front(embedded, clips(), steps=1)
    assert {"mean/torso", "sample/legs", "mirror/torso", "colours/legs", "ceiling/torso", "mean/gradient"} <= set(
        figures
    )
    assert figures["mirror/torso"] > 60
    repairs = repaired(embedded, clips(), {"clean-up 1 step": repair_methods(embedded)["clean-up 1 step"]})
    assert repairs["coarse/observed"] > 60 > repairs["coarse/unobserved"]
    trips = round_trips(embedded, clips(), (8,), ("euler", "reversible_heun"), reference_steps=8)
    errors = {row["solver"]: row["round_trip"] for row in trips.rows}
    assert errors["reversible_heun"] < 1e-5 < errors["euler"]
