"""What the prior is used for on one person: completing a picture, turning it round, cleaning coarse videos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import GREY, Cameras, canonical_cameras
from ahoy_core.prior.bodymaps import body_maps, camera_azimuth
from ahoy_core.prior.conditioning import PATCH, Context, held_tokens
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.inversion import clean_up, hallucinate
from ahoy_core.prior.light import lit, unlit
from ahoy_core.prior.video import VideoModel

HELD_SHARE: Final = 0.5
"""Observed share of the first frame's person from which a published model goes on from it."""
WHOLE: Final = 0.9
"""Alpha from which a pixel shows the person alone."""
BESIDE: Final = 2
"""Pixels from the edge within which the person's own colours are looked for."""


@dataclass(frozen=True)
class Pictures:
    """T person images of one subject, as far as they are known.

    Attributes:
        frames: [T,3,H,W] in [0,1] over grey; a coarse guess where nothing is known.
        mask: [T,1,H,W] alpha of the person, hidden parts included.
        coverage: [T,1,H,W] in [0,1], 1 where `frames` shows what was observed.
        moving: they follow each other as a video's frames do; views from four sides do not.
        heads: [T,1,H,W] share of a pixel that is head, where what the prior makes is not taken; None: no such place.
        light: [T,1,H,W] brightness as a share of each colour's own (`ahoy_core.prior.light`); None: not known.
    """

    frames: Tensor
    mask: Tensor
    coverage: Tensor
    moving: bool = True
    heads: Tensor | None = None
    light: Tensor | None = None

    def __post_init__(self) -> None:
        shape = (len(self.frames), 1, *self.frames.shape[2:])
        for name in ("mask", "coverage", "heads", "light"):
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"expected {name} {list(shape)} for these frames, got {list(value.shape)}")


def pose_context(body: BodyModel, vertices: Tensor, root_rotations: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Body maps [1,T,7,H/4,W/4] and azimuths [1,T] of posed bodies.

    Args:
        body: that the vertices are of.
        vertices: [T,V,3] posed, world.
        root_rotations: [T,3,3].
        cameras: T cameras.
    """
    return body_maps(body, vertices, cameras)[None], camera_azimuth(cameras.viewmats, root_rotations)[None]


def canonical_context(body: BodyModel, vertices: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """`pose_context` of a body [V,3] in canonical pose from front, left, back and right.

    Args:
        body: that the vertices are of.
        vertices: [V,3].
        size: height and width of the pictures, pixels.
    """
    upright = torch.eye(3).expand(4, 3, 3)
    return pose_context(body, vertices.expand(4, -1, -1), upright, canonical_cameras(vertices, *size))


@torch.no_grad()
def repaint(
    video: VideoModel,
    pictures: Pictures,
    body: Tensor,
    azimuth: Tensor,
    config: PriorConfig,
    prompt: str = NEUTRAL,
) -> Tensor:
    """Replaces what was not observed by what the prior finds plausible.

    The prior works on colours without the light they were seen in, and what it makes is lit where it lies. It would
    take the light from what it is shown and sees no other: in the pictures that it learned from, light mostly goes with
    the camera, so a back would become as bright as the front that was observed. A published model, which sees the
    guess by RF-inversion alone, starts from its light and needs none of this.

    Args:
        video: the prior, with or without an identity adapter.
        pictures: T frames of the prior's size; a coarse guess everywhere, and how much of it was observed.
        body: [1,T,7,H/4,W/4] from `pose_context`; not looked at by a prior that reads no bodies.
        azimuth: [1,T], likewise.
        config: knobs.
        prompt: of the way back (the subject's, where there is an adapter).

    Returns:
        [T,3,H,W] in [0,1], as the prior made them: observed pixels are not pasted back (see `composited`).

    Raises:
        ValueError: a prior that reads no coarse latents is asked for the clean-up, which consists in reading them.
    """
    if not video.reads_bodies:
        return _repaint_unread(video, pictures, config, prompt)
    coarse = video.encode(unlit(pictures.frames, pictures.mask, pictures.light).transpose(0, 1)[None])
    coverage, mask = pictures.coverage[None, :, 0], pictures.mask[None, :, 0]
    held = held_tokens(coverage, mask) if config.hold else torch.zeros_like(held_tokens(coverage, mask))
    factor = pictures.frames.shape[-1] // coarse.shape[-1]
    context = Context(
        text=video.embed([prompt]),
        known=coarse,
        held=held,
        body=body,
        azimuth=azimuth,
        coarse=coarse,
        coverage=torch.nn.functional.avg_pool2d(torch.minimum(coverage, mask), factor),
    )
    generator = torch.Generator().manual_seed(config.seed)
    if config.method == "clean-up":
        noise = torch.randn(coarse.shape, generator=generator)
        latents = clean_up(video, noise, context, config.steps).latents
    else:
        latents = hallucinate(video, coarse, context, video.embed([NEUTRAL]), config.inversion, generator).latents
    return lit(video.decode(latents)[0].transpose(0, 1), pictures.mask, pictures.light)


def _repaint_unread(video: VideoModel, pictures: Pictures, config: PriorConfig, prompt: str) -> Tensor:
    """`repaint` by a published video model: pose and silhouette come in by RF-inversion of the coarse latents alone.

    Pictures that are no video are asked for one by one. Of a video the first frame is held clean where the model was
    trained to go on from one and most of it was observed.
    """
    if config.method != "inversion":
        raise ValueError(
            "expected the method inversion, got clean-up: this prior has no input for coarse latents; set "
            "hallucinate.method=inversion"
        )
    count = len(pictures.frames)
    clip = pictures.frames[:, :, None]  # [N,3,1,H,W]
    if pictures.moving:
        last = pictures.frames[-1:].expand(video.clip_frames(count) - count, -1, -1, -1)
        clip = torch.cat([pictures.frames, last]).transpose(0, 1)[None]
    coarse = video.encode(clip)
    text, neutral = (video.embed([words]).expand(len(clip), -1, -1) for words in (prompt, NEUTRAL))
    context = Context(text)
    if config.hold and pictures.moving and video.holds_first_frame and _mostly_observed(pictures):
        batch, _, times, height, width = coarse.shape
        held = torch.zeros(batch, times, height // PATCH, width // PATCH, dtype=torch.bool)
        held[:, 0] = True
        context = Context(text, known=coarse, held=held)
    generator = torch.Generator().manual_seed(config.seed)
    made = video.decode(hallucinate(video, coarse, context, neutral, config.inversion, generator).latents)
    return made[0].transpose(0, 1)[:count] if pictures.moving else made[:, :, 0]


def _mostly_observed(pictures: Pictures) -> bool:
    """Whether the video showed at least `HELD_SHARE` of the person in the first picture."""
    mask, coverage = pictures.mask[0], pictures.coverage[0]
    return float(torch.minimum(mask, coverage).sum()) >= HELD_SHARE * float(mask.sum()) > 0


def composited(generated: Tensor, pictures: Pictures) -> Tensor:
    """Generated pictures with what was observed pasted over them: a hallucination never overwrites evidence.

    Nor does it invent a face: heads stay the guess's own where the pictures say where they are. And it repaints the
    person, not the outline, which is the guess's: an autoencoder's halo beside it would make the avatar grow.
    """
    generated = _within(generated, pictures)
    share = torch.minimum(pictures.coverage, pictures.mask)
    if pictures.heads is not None:
        share = torch.maximum(share, torch.minimum(pictures.heads, pictures.mask))
    return generated * (1 - share) + pictures.frames * share


def _within(generated: Tensor, pictures: Pictures) -> Tensor:
    """Generated pictures with edges of the guess's alpha over grey, coloured by the person's pixels `BESIDE` them.

    Where there are none (thin fingers; the background) the guess stands.
    """
    whole = (pictures.mask > WHOLE).to(generated)
    size = 2 * BESIDE + 1
    near, colours = (avg_pool2d(v, size, stride=1, padding=BESIDE) for v in (whole, generated * whole))
    edge = colours / near.clamp(min=1e-6) * pictures.mask + GREY * (1 - pictures.mask)
    return torch.where(whole > 0, generated, torch.where(near > 0, edge, pictures.frames))
