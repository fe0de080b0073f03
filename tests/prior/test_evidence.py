"""What the fine-tuning reads of a video: occluders leave no trace, mirrors exchange the sides."""

from __future__ import annotations

import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.conventions import Cameras, look_at, orbit_eyes
from ahoy_core.prior.bodymaps import body_maps
from ahoy_core.prior.evidence import Frames, holes_closed, with_mirrored

HEIGHT, WIDTH = 64, 32


def seen(body: bool = True) -> Frames:
    """A red person whose lower half is hidden by something grey."""
    images = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    visible = torch.zeros(1, 1, HEIGHT, WIDTH)
    visible[..., 8:32, 8:24] = 1
    images = torch.where(visible > 0, torch.tensor([0.8, 0.1, 0.1])[:, None, None], images)
    maps = torch.zeros(1, 7, HEIGHT // 4, WIDTH // 4)
    maps[:, 0, 2:14, 2:6] = 1
    return Frames(images, visible, maps if body else None, torch.tensor([0.3]) if body else None)


def test_hidden_body_takes_the_nearest_visible_colour_and_nothing_else_changes() -> None:
    given = seen()
    closed = holes_closed(given)
    hidden = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hidden[32:56, 8:24] = True
    red = torch.tensor([0.8, 0.1, 0.1])[:, None].expand(3, int(hidden.sum()))
    torch.testing.assert_close(closed.images[0][:, hidden], red, rtol=0, atol=0)
    assert torch.equal(closed.images[0][:, ~hidden], given.images[0][:, ~hidden])
    assert torch.equal(closed.visible, given.visible), "a hole that was closed is not seen for it"


def test_what_an_occluder_shows_does_not_matter() -> None:
    given = seen()
    painted = given.images.clone()
    painted[..., 32:56, 8:24] = torch.rand(3, 24, 16, generator=torch.Generator().manual_seed(0))
    other = Frames(painted, given.visible, given.body, given.azimuth)
    assert torch.equal(holes_closed(other).images, holes_closed(given).images)


def test_without_a_body_or_without_a_hole_nothing_is_painted() -> None:
    assert torch.equal(holes_closed(seen(body=False)).images, seen(body=False).images)
    whole = Frames(seen().images, torch.ones(1, 1, HEIGHT, WIDTH), seen().body, seen().azimuth)
    assert torch.equal(holes_closed(whole).images, whole.images)


def test_a_mirrored_body_is_the_body_seen_from_the_other_side() -> None:
    """The maps of a symmetric body at azimuth -a are those at a in a mirror; so is what the prior is told of it."""
    body = load_packaged_body()
    with torch.no_grad():
        vertices = body(torch.zeros(1, len(body.parents), 3), body.default_betas[None], torch.zeros(1, 3)).vertices
    azimuth = torch.tensor([0.5, -0.5])
    center = 0.5 * (vertices.amin((0, 1)) + vertices.amax((0, 1)))
    viewmats = look_at(orbit_eyes(center, 4.0, azimuth), center)
    K = torch.tensor([[260.0, 0.0, 32.0], [0.0, 260.0, 64.0], [0.0, 0.0, 1.0]])
    maps = body_maps(body, vertices.expand(2, -1, -1), Cameras(viewmats, K.expand(2, 3, 3), 64, 128))
    images, visible = torch.rand(1, 3, 128, 64), torch.ones(1, 1, 128, 64)
    both = with_mirrored(Frames(images, visible, maps[:1], azimuth[:1]))
    assert both.body is not None and both.azimuth is not None
    torch.testing.assert_close(both.azimuth, azimuth)
    assert torch.equal(both.images[1], images[0].flip(-1)) and torch.equal(both.images[0], images[0])
    inside = (both.body[1, 0] > 0.99) & (maps[1, 0] > 0.99)
    assert float(inside.float().mean()) > 0.05
    # Cells at the silhouette's edge fall on other pixels; the tessellation of the mesh is not quite symmetric.
    difference = (both.body[1] - maps[1]).abs()[:, inside]
    assert float(difference.mean()) < 0.03, difference.mean(1)


def test_mirroring_without_bodies_mirrors_the_pictures() -> None:
    both = with_mirrored(seen(body=False))
    assert both.body is None and torch.equal(both.images[1], seen().images[0].flip(-1))


def test_frames_of_nobody_are_refused() -> None:
    with pytest.raises(ValueError, match="visible subject"):
        Frames(torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8))
