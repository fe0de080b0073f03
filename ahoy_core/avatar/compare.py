"""The avatar beside what the video shows: the picture that tells at a glance whether training went wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from ahoy_core.avatar.avatar import Avatar
from ahoy_core.avatar.render import render
from ahoy_core.avatar.supervision import CoarseInputs, unit_range
from ahoy_core.conventions import Cameras
from ahoy_core.formats.images import to_uint8
from ahoy_core.metrics.regions import mask_box

_SEEN = 0.05  # alpha above which a pixel of the render counts for the box


@torch.no_grad()
def observed_pairs(
    avatar: Avatar, inputs: CoarseInputs, numbers: Sequence[int]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Observed frames and the avatar in their poses, before the same camera, cut to the avatar's box.

    Args:
        avatar: who.
        inputs: what it was trained on.
        numbers: indices of frames with a fitted person.

    Yields:
        Two uint8 [h,w,3] pictures: the frame, and the whole avatar (hidden parts too) over grey.
    """
    height, width = inputs.frames.shape[2:]
    camera = Cameras(inputs.viewmat.float()[None], inputs.K.float()[None], width, height, "pinhole")
    for number in numbers:
        posed = avatar.pose(inputs.body, inputs.pose[number].float(), inputs.transl[number].float())
        image, alpha = render(posed.means, posed.covars, posed.opacities, posed.colors, camera)
        mask = alpha[0, 0] * (alpha[0, 0] > _SEEN)
        x0, y0, x1, y1 = mask_box(mask, 8) if bool((mask > 0).any()) else (0, 0, width, height)
        seen = to_uint8(unit_range(inputs.frames[number]))
        yield seen[y0:y1, x0:x1], to_uint8(image[0])[y0:y1, x0:x1]
