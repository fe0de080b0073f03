"""A scene before one camera, and avatars drawn into its picture: only what changes is drawn again.

I = R(D(G; theta) u G_scene; camera) of paper section 3.4 is one rasterization of all Gaussians. Outside the avatars'
footprints that picture is the scene's own, so a camera that stands still needs it once; the joint rasterization is
confined to the window that holds the footprints, of all Gaussians that reach into it, and equals that part of the
whole (tests/scene/test_backdrop.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ahoy_core.avatar.avatar import Posed
from ahoy_core.conventions import Cameras
from ahoy_core.scene.cost import rasterize
from ahoy_core.scene.effects.contact_shadow import Shadow, darkened
from ahoy_core.scene.scene import Scene
from ahoy_core.splat import Window, boxes, footprints, hull, meeting


@dataclass(frozen=True)
class Backdrop:
    """M Gaussians of a scene before a camera, and their picture.

    Attributes:
        cameras: One.
        rows: [M] which of the scene's.
        means, covars, opacities, colors: Theirs.
        boxes: [M,4] left, top, right, bottom: the pixels each can change.
        picture: [H,W,3] sRGB, of the scene alone over the background; None where it was not asked for.
        background: Grey level behind everything.
    """

    cameras: Cameras
    rows: Tensor
    means: Tensor
    covars: Tensor
    opacities: Tensor
    colors: Tensor
    boxes: Tensor
    picture: Tensor | None
    background: float

    def within(self, window: Window) -> Posed:
        """The Gaussians that reach into a window."""
        rows = torch.nonzero(meeting(self.boxes, window))[:, 0]
        return Posed(self.means[rows], self.covars[rows], self.colors[rows], self.opacities[rows])


def look(scene: Scene, colors: Tensor, cameras: Cameras, background: float) -> Backdrop:
    """Draw a scene, and keep the Gaussians that can change a pixel: what no ray meets is left out from here on.

    Args:
        scene: In our world.
        colors: [N,3] its colours, as seen from here.
        cameras: One.
        background: Grey level behind everything.
    """
    g = scene.gaussians
    image, alpha, meta = rasterize(g.means, scene.covars, g.opacities, colors, cameras)
    box = boxes(meta["means2d"], meta["radii"], cameras.width, cameras.height)[0]
    rows = torch.nonzero((box[:, 2:] > box[:, :2]).all(1))[:, 0]
    return Backdrop(
        cameras, rows, g.means[rows], scene.covars[rows], g.opacities[rows], colors[rows], box[rows],
        image[0] + background * (1 - alpha[0]), background,
    )  # fmt: skip


def undrawn(scene: Scene, colors: Tensor, cameras: Cameras, background: float) -> Backdrop:
    """The whole scene without its picture: for a camera from which a joint picture is the only one."""
    g, count = scene.gaussians, len(scene)
    return Backdrop(
        cameras, torch.arange(count), g.means, scene.covars, g.opacities, colors, torch.zeros(count, 4), None,
        background,
    )  # fmt: skip


def shaded(backdrop: Backdrop, shadow: Shadow, count: int) -> Backdrop:
    """The same with a shadow (on rows of a scene of `count` Gaussians), drawn again where the shadow is."""
    place = torch.full((count,), -1)
    place[backdrop.rows] = torch.arange(len(backdrop.rows))
    here = place[shadow.rows]
    rows, kept = here[here >= 0], shadow.light[here >= 0]
    if not len(rows):
        return backdrop
    colors = backdrop.colors.clone()
    colors[rows] = darkened(colors[rows], kept)
    darker = replace(backdrop, colors=colors)
    if backdrop.picture is None:
        return darker
    window = hull(backdrop.boxes[rows])
    assert window is not None, "only what is in the picture is kept"
    part = darker.within(window)
    image, alpha, _ = rasterize(part.means, part.covars, part.opacities, part.colors, backdrop.cameras, window)
    return replace(darker, picture=_pasted(backdrop.picture, image[0] + backdrop.background * (1 - alpha[0]), window))


def with_avatars(backdrop: Backdrop, avatars: Posed, joint: bool) -> Tensor:
    """The picture [H,W,3] sRGB with avatars: hidden by what is nearer (`joint`), or over everything."""
    cameras = backdrop.cameras
    if backdrop.picture is None:
        everything = together([avatars, Posed(backdrop.means, backdrop.covars, backdrop.colors, backdrop.opacities)])
        image, alpha, _ = rasterize(*_arguments(everything), cameras)
        return image[0] + backdrop.background * (1 - alpha[0])
    window = avatar_window(avatars, cameras)
    if window is None:
        return backdrop.picture
    drawn = together([avatars, backdrop.within(window)]) if joint else avatars
    image, alpha, _ = rasterize(*_arguments(drawn), cameras, window)
    behind = backdrop.background if joint else backdrop.picture[pixels(window)]
    return _pasted(backdrop.picture, image[0] + behind * (1 - alpha[0]), window)


def avatar_window(avatars: Posed, cameras: Cameras) -> Window | None:
    """The part of the picture that avatars can change; None if they are not in it."""
    width, height = cameras.width, cameras.height
    return hull(
        footprints(avatars.means, avatars.covars, avatars.opacities, cameras.viewmats, cameras.Ks, width, height)[0]
    )


def together(parts: list[Posed]) -> Posed:
    """All Gaussians of some sets, in their order."""
    if not parts:
        return Posed(torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0, 3), torch.zeros(0))
    if len(parts) == 1:
        return parts[0]
    names = ("means", "covars", "colors", "opacities")
    return Posed(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def pixels(window: Window) -> tuple[slice, slice]:
    """Index of a window's pixels in a picture [H,W,...]."""
    left, top, width, height = window
    return slice(top, top + height), slice(left, left + width)


def _arguments(part: Posed) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return part.means, part.covars, part.opacities, part.colors


def _pasted(picture: Tensor, part: Tensor, window: Window) -> Tensor:
    changed = picture.clone()
    changed[pixels(window)] = part
    return changed
