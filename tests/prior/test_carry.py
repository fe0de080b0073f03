"""Colours of held tokens carried over the body: what must arrive, and what must not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ahoy_core.prior.carry import CARRIED_CHANNELS, carried_colours, cell_colours

RED, BLUE = (0.8, -0.6, -0.6), (-0.7, -0.5, 0.9)
# A latent that is four cells of one colour in its first three channels.
READOUT = torch.zeros(12, 17)
for channel in range(3):
    READOUT[4 * channel : 4 * channel + 4, channel] = 1


def painted(*colours: tuple[float, float, float]) -> Tensor:
    """Latents [1,16,T,4,4], a colour a frame."""
    latents = torch.zeros(1, 16, len(colours), 4, 4)
    for t, colour in enumerate(colours):
        latents[0, :3, t] = torch.tensor(colour)[:, None, None]
    return latents


def body_at(*sides: float) -> Tensor:
    """Maps [1,T,7,8,8] of a body that fills the picture; x from its middle (0) to a side (1 or -1), z upwards."""
    maps = torch.zeros(1, len(sides), 7, 8, 8)
    maps[:, :, 0] = 1
    for t, side in enumerate(sides):
        maps[0, t, 1] = side * torch.linspace(0.2, 0.8, 8)
        maps[0, t, 3] = torch.linspace(0.8, -0.8, 8)[:, None]
    return maps


def held_in(*frames: int, count: int = 2) -> Tensor:
    held = torch.zeros(1, count, 2, 2, dtype=torch.bool)
    held[:, list(frames)] = True
    return held


def told(latents: Tensor, held: Tensor, body: Tensor) -> Tensor:
    """What cells are told, [T,7,2h,2w]."""
    carried = carried_colours(latents, held, body, READOUT)
    assert carried.shape == (1, CARRIED_CHANNELS, latents.shape[2], 4, 4)
    return torch.nn.functional.pixel_shuffle(carried.transpose(1, 2), 2)[0]


def test_a_latent_is_read_as_its_cells() -> None:
    latents = torch.randn(2, 16, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    readout = torch.randn(12, 17, generator=torch.Generator().manual_seed(1))
    cells = cell_colours(latents, readout)
    assert cells.shape == (2, 3, 3, 8, 8)
    expected = readout[:, :-1] @ latents[1, :, 2, 3, 1] + readout[:, -1]
    torch.testing.assert_close(cells[1, 2, :, 6:8, 2:4], expected.reshape(3, 2, 2))


def test_the_same_place_in_another_view_is_told_its_colour() -> None:
    cells = told(painted(RED, BLUE), held_in(0), body_at(1, 1))
    for near_or_wide in (slice(0, 3), slice(3, 6)):
        torch.testing.assert_close(cells[1, near_or_wide], torch.tensor(RED)[:, None, None].expand(3, 8, 8))
    assert float(cells[1, 6].min()) > 0.99  # it was there, but for the rounding of distances


def test_held_cells_are_told_nothing_they_are_known_themselves() -> None:
    assert not told(painted(RED, BLUE), held_in(0), body_at(1, 1))[0].any()


def test_what_is_not_held_reaches_nobody() -> None:
    body, held = body_at(1, 1, -1), held_in(0, count=3)
    one = told(painted(RED, BLUE, BLUE), held, body)
    assert torch.equal(told(painted(RED, RED, RED), held, body), one)


def test_the_other_side_stands_in_only_where_a_side_was_not_seen() -> None:
    body = body_at(1, -1, -1)
    right_alone = told(painted(RED, BLUE, BLUE), held_in(0, count=3), body)
    torch.testing.assert_close(right_alone[2, :3], torch.tensor(RED)[:, None, None].expand(3, 8, 8))
    assert float(right_alone[2, 6].max()) < 0.8  # and says that it is a guess
    both = told(painted(RED, BLUE, BLUE), held_in(0, 1, count=3), body)
    away = (both[2, :3] - torch.tensor(BLUE)[:, None, None]).abs().amax(0)
    # Places nearer than the penalty to the middle have both sides near them.
    assert float(away[:, 1:].max()) < 0.05


def test_what_was_further_off_says_so() -> None:
    body = body_at(1, 1)
    body[0, 1, 3] -= 1.0  # the second frame shows places below those of the first
    cells = told(painted(RED, BLUE), held_in(0), body)
    nearness = cells[1, 6].mean(1)
    assert bool((nearness.diff() <= 1e-6).all()) and float(nearness[-1]) < 0.01


def test_cloth_that_stands_off_the_bare_body_is_told_too_and_far_background_is_not() -> None:
    body = body_at(1, 1)
    body[0, 1, :, :, 3:] = 0
    cells = told(painted(RED, BLUE), held_in(0), body)
    assert bool(cells[1, 6, :, :5].all()) and not cells[1, :, :, 5:].any()


@pytest.mark.parametrize("missing", ["held", "body"])
def test_without_anything_held_or_a_body_there_is_nothing_to_tell(missing: str) -> None:
    held, body = held_in(0), body_at(1, 1)
    (held if missing == "held" else body).zero_()
    cells = told(painted(RED, BLUE), held, body)
    assert not cells.any() and bool(torch.isfinite(cells).all())
