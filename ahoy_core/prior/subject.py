"""A subject's frames as the prior wants them: person images, what of them is visible, and the fitted body's maps."""

from __future__ import annotations

import torch
from torch import Tensor

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.conventions import Cameras, person_image
from ahoy_core.prior.bodymaps import body_maps, camera_azimuth
from ahoy_core.prior.framing import HEIGHT, WIDTH, framing_Ks
from ahoy_core.prior.identity import Frames


def subject_frames(
    images: Tensor,
    visible: Tensor,
    cameras: Cameras,
    body: PackagedBody,
    vertices: Tensor,
    root_rotations: Tensor,
) -> Frames:
    """Cuts a subject out of N frames, framed by the whole fitted body, hidden parts included.

    Args:
        images: [N,3,H,W] in [0,1].
        visible: [N,1,H,W] alpha of the visible subject.
        cameras: N pinhole cameras of the frames.
        body: the packaged body.
        vertices: [N,V,3] fitted, world, metres.
        root_rotations: [N,3,3].

    Raises:
        ValueError: when a body stands behind its camera, or no frame shows the subject.
    """
    Ks = framing_Ks(cameras.viewmats, vertices, together=False)
    framed = Cameras(cameras.viewmats, Ks, WIDTH, HEIGHT, cameras.camera_model)
    cut = [
        person_image(image, mask, K, HEIGHT, WIDTH, crop=new @ torch.linalg.inv(K))
        for image, mask, K, new in zip(images, visible, cameras.Ks, Ks, strict=True)
    ]
    return Frames(
        images=torch.stack([person.image for person in cut]),
        visible=torch.stack([person.mask for person in cut]),
        body=body_maps(body, vertices, framed),
        azimuth=camera_azimuth(cameras.viewmats, root_rotations),
    )
