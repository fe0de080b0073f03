"""Repainting by a published video model, which reads no bodies: what comes in, what is held, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ahoy_core.prior.canonical import CLEAN_UP, INVERSION, ways
from ahoy_core.prior.completion import Pictures, repaint
from ahoy_core.prior.config import InversionConfig, PriorConfig
from ahoy_core.prior.hallucination import fine_cameras
from ahoy_core.prior.sequences import plan_motions
from ahoy_core.prior.video import VideoModel, WanVideo, load_video

HEIGHT, WIDTH = 64, 32
NONE = torch.zeros(1, 0), torch.zeros(1, 0)
ASKED = PriorConfig(method="inversion", inversion=InversionConfig(steps=1))


@pytest.fixture(params=["5b", "a14b"])
def wan(request: pytest.FixtureRequest, wan_folders: dict[str, Path]) -> VideoModel:
    return load_video(wan_folders[request.param])


def pictures(count: int, observed: float, moving: bool = True) -> Pictures:
    generator = torch.Generator().manual_seed(0)
    mask = torch.zeros(count, 1, HEIGHT, WIDTH)
    mask[..., 8:56, 8:24] = 1
    return Pictures(torch.rand(count, 3, HEIGHT, WIDTH, generator=generator), mask, observed * mask, moving)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_any_number_of_frames_comes_back(wan: VideoModel, count: int) -> None:
    made = repaint(wan, pictures(count, 0.0), *NONE, ASKED)
    assert made.shape == (count, 3, HEIGHT, WIDTH)
    assert float(made.min()) >= 0 and float(made.max()) <= 1
    assert torch.equal(made, repaint(wan, pictures(count, 0.0), *NONE, ASKED))
    assert not torch.equal(made, repaint(wan, pictures(count, 0.0), *NONE, ASKED.model_copy(update={"seed": 1})))


def test_views_from_four_sides_are_asked_for_one_by_one(wan: VideoModel) -> None:
    still = pictures(4, 0.0, moving=False)
    made = repaint(wan, still, *NONE, ASKED)
    changed = still.frames.clone()
    changed[2] = 1 - changed[2]
    other = repaint(wan, replace(still, frames=changed), *NONE, ASKED)
    same = [torch.allclose(a, b, atol=1e-5) for a, b in zip(made, other, strict=True)]
    assert same == [True, True, False, True]


def _through(video: VideoModel, given: Pictures) -> torch.Tensor:
    with torch.no_grad():
        return video.decode(video.encode(given.frames.transpose(0, 1)[None]))[0].transpose(0, 1)


def test_a_first_frame_that_was_seen_is_gone_on_from_where_the_model_can(wan: VideoModel) -> None:
    given = pictures(5, 0.9)
    made, coded = repaint(wan, given, *NONE, ASKED), _through(wan, given)
    kept = torch.allclose(made[0], coded[0], atol=1e-5)
    assert kept == wan.holds_first_frame and not torch.allclose(made[4], coded[4], atol=1e-3)
    free = repaint(wan, given, *NONE, ASKED.model_copy(update={"hold": False}))
    assert not torch.allclose(free[0], coded[0], atol=1e-3)
    assert not torch.allclose(repaint(wan, pictures(5, 0.3), *NONE, ASKED)[0], coded[0], atol=1e-3)


def test_one_field_both_ways_is_the_identity_up_to_the_solver(wan: VideoModel) -> None:
    """What makes inversion carry pose and silhouette without any body map: equation 4 with nothing changed between."""
    literal = InversionConfig(mode="paper", tau_max=1.0, gamma=0.0, solver="midpoint", steps=24)
    given = pictures(5, 0.0)
    made = repaint(wan, given, *NONE, PriorConfig(method="inversion", inversion=literal))
    # The tiny fields are smooth: 24 midpoint steps bring the latents back to a thousandth of their spread.
    assert float((made - _through(wan, given)).abs().max()) < 0.01


def test_the_clean_up_is_refused_and_not_among_the_ways(wan: VideoModel, embedded: VideoModel) -> None:
    with pytest.raises(ValueError, match=r"no input for coarse latents; set hallucinate\.method=inversion"):
        repaint(wan, pictures(2, 0.0), *NONE, PriorConfig())
    assert ways(wan) == (INVERSION,) and ways(embedded) == (CLEAN_UP, INVERSION)


def test_the_model_says_its_size_and_its_clips(wan_folders: dict[str, Path]) -> None:
    video = load_video(wan_folders["5b"])
    assert video.size == (832, 416) and [video.clip_frames(n) for n in (1, 2, 5, 6, 8)] == [1, 5, 5, 9, 9]
    assert WanVideo(video.components, height=64).size == (64, 32)


def test_sequences_are_rendered_in_the_models_framing(smplx: object) -> None:
    body = smplx
    plan = plan_motions(body, body.default_betas, torch.zeros(len(body.faces)), frames=2, limit=1)  # type: ignore[attr-defined, arg-type]
    planned = plan.sequences[0].cameras
    vertices = body(plan.sequences[0].pose, body.default_betas[None].expand(2, -1), plan.sequences[0].transl).vertices  # type: ignore[operator, attr-defined]
    for size, factor in (((128, 64), 2), ((832, 416), 1)):
        cameras, found = fine_cameras(planned, size)
        assert found == factor and (cameras.height, cameras.width) == (factor * size[0], factor * size[1])
        pixels = cameras.project(vertices).pixels / torch.tensor([cameras.width, cameras.height])
        expected = planned.project(vertices).pixels / torch.tensor([planned.width, planned.height])
        torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def smplx(tmp_path_factory: pytest.TempPathFactory) -> object:
    """A body that no embedded prior knows."""
    from ahoy_core.body.load import load_body
    from tests.body import licensed

    return load_body(str(licensed.write(tmp_path_factory.mktemp("smplx"), "smplx")))
