"""What the prior draws from words alone: the average adult in canonical pose, seen from four sides."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.prior.completion import canonical_context
from ahoy_core.prior.conditioning import FACTOR, LATENT_CHANNELS, Context
from ahoy_core.prior.inversion import clean_up
from ahoy_core.prior.solvers import Solver
from ahoy_core.prior.video import VideoModel
from ahoy_core.texture.texture import canonical_vertices


def bare_context(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Body maps [1,4,7,H/4,W/4] and azimuths [1,4] of the average adult from front, left, back and right.

    Args:
        size: height and width of the pictures, pixels.
    """
    body = load_packaged_body()
    vertices = torch.from_numpy(canonical_vertices(body, body.default_betas.numpy()))
    return canonical_context(body, vertices, size)


@torch.no_grad()
def drawn_from_words(video: VideoModel, prompts: Sequence[str], steps: int = 1, seed: int = 0) -> Tensor:
    """Four views [P,4,3,H,W] in [0,1] for each of P prompts, all from the same noise.

    Args:
        video: a prior that reads bodies.
        prompts: like `corpus.prompts.caption` makes them: "a person, red top, blue trousers".
        steps: 1 is the mean of what the words allow, more give a sample.
        seed: of the noise.

    Raises:
        ValueError: when the prior reads no bodies; its frames are a video's, not four views.
    """
    if not video.reads_bodies:
        raise ValueError("expected a prior that reads bodies, got one that does not; draw with its own pipeline")
    maps, azimuth = bare_context(video.size)
    shape = (1, LATENT_CHANNELS, 4, video.size[0] // FACTOR, video.size[1] // FACTOR)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    solver: Solver = "euler" if steps == 1 else "midpoint"
    views = []
    for prompt in prompts:
        context = Context(video.embed([prompt]), body=maps, azimuth=azimuth)
        views.append(video.decode(clean_up(video, noise, context, steps, solver).latents)[0].transpose(0, 1))
    return torch.stack(views)
