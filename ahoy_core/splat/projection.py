"""Where Gaussians lie in an image, without drawing it."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.splat import constants, validate
from ahoy_core.splat._autograd import project
from ahoy_core.splat._camera import View
from ahoy_core.splat.rasterization import Window


@torch.no_grad()
def footprints(
    means: Tensor, covars: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int
) -> Tensor:
    """The part of a pinhole image that each Gaussian can change, exactly as `rasterization` decides it.

    Args:
        means: [N,3] world, metres.
        covars: [N,3,3] metres^2.
        opacities: [N] in [0,1].
        viewmats: [C,4,4] world -> camera (OpenCV axes).
        Ks: [C,3,3] pixels.
        width: Pixels.
        height: Pixels.

    Returns:
        [C,N,4] left, top, right and bottom, pixels, inside the image; right <= left for what is not visible.

    Raises:
        ValueError: Shapes or values are wrong.
        TypeError: A tensor has the wrong type or dtype.
    """
    colors = opacities[:, None].contiguous()
    validate.check_tensors(
        {"means": means, "covars": covars, "opacities": opacities, "colors": colors, "viewmats": viewmats, "Ks": Ks}
    )
    validate.check_shapes(means, None, None, covars, opacities, colors, viewmats, Ks, None, None)
    validate.check_cameras(viewmats, Ks)
    view = View(
        width, height, constants.NEAR_PLANE, constants.FAR_PLANE, constants.EPS2D, 0.0, constants.ALPHA_CUTOFF, False,
        False,
    )  # fmt: skip
    seen = project(means, None, None, covars, viewmats, Ks, opacities, colors, view)
    return boxes(seen.means2d, seen.radii, width, height)


def boxes(means2d: Tensor, radii: Tensor, width: int, height: int) -> Tensor:
    """The same [C,N,4] from the meta of a rasterization: means2d [C,N,2] and radii [C,N,2] (0 where not visible)."""
    reach = radii.to(means2d.dtype)
    box = torch.cat([(means2d - reach).floor(), (means2d + reach).ceil()], -1)
    box = box.clamp(min=0).minimum(box.new_tensor([width, height, width, height]))
    return torch.where((radii > 0).all(-1, keepdim=True), box, torch.zeros_like(box))


def hull(box: Tensor) -> Window | None:
    """The smallest window round boxes [N,4]; None if none has a pixel."""
    box = box[(box[:, 2:] > box[:, :2]).all(1)]
    if not len(box):
        return None
    (left, top), (right, bottom) = box[:, :2].amin(0).tolist(), box[:, 2:].amax(0).tolist()
    return int(left), int(top), int(right - left), int(bottom - top)


def meeting(box: Tensor, window: Window) -> Tensor:
    """Which [N] of boxes [N,4] share a pixel with a window."""
    left, top, width, height = window
    return (
        (box[:, 0] < left + width) & (box[:, 2] > left) & (box[:, 1] < top + height) & (box[:, 3] > top)
        & (box[:, 2] > box[:, 0])
    )  # fmt: skip
