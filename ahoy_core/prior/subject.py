"""A subject's frames as the prior wants them: person images, what of them is visible, and the fitted body's maps."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.conventions import Cameras, person_image
from ahoy_core.prior.bodymaps import body_maps, camera_azimuth, light_maps
from ahoy_core.prior.evidence import Frames
from ahoy_core.prior.framing import HEIGHT, WIDTH, framing_Ks
from ahoy_core.prior.light import unlit

Array = NDArray[Any]


def subject_frames(
    images: Tensor,
    visible: Tensor,
    cameras: Cameras,
    body: BodyModel,
    vertices: Tensor,
    root_rotations: Tensor,
    size: tuple[int, int] = (HEIGHT, WIDTH),
    brightness: Array | None = None,
) -> Frames:
    """Cuts a subject out of N frames, framed by the whole fitted body, hidden parts included.

    Args:
        images: [N,3,H,W] in [0,1].
        visible: [N,1,H,W] alpha of the visible subject.
        cameras: N pinhole cameras of the frames.
        body: the run's body.
        vertices: [N,V,3] fitted, world, metres.
        root_rotations: [N,3,3].
        size: height and width of the person images, pixels; `VideoModel.size`.
        brightness: [V] of the light that the video was seen in (`brightness_on`), which is taken off; None: it stays.

    Raises:
        ValueError: when a body stands behind its camera, or no frame shows the subject.
    """
    height, width = size
    Ks = framing_Ks(cameras.viewmats, vertices, height, width, together=False)
    framed = Cameras(cameras.viewmats, Ks, width, height, cameras.camera_model)
    cut = [
        person_image(image, mask, K, height, width, crop=new @ torch.linalg.inv(K))
        for image, mask, K, new in zip(images, visible, cameras.Ks, Ks, strict=True)
    ]
    pictures, seen = (torch.stack(v) for v in zip(*[(person.image, person.mask) for person in cut], strict=True))
    light = None if brightness is None else light_maps(body, vertices, framed, brightness)
    return Frames(
        images=unlit(pictures, seen, light),
        visible=seen,
        body=body_maps(body, vertices, framed),
        azimuth=camera_azimuth(cameras.viewmats, root_rotations),
    )
