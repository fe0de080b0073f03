"""How far a texture is from the true pictures of a capture, looked up through the true body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.captures.capture import Capture, View
from ahoy_core.captures.fit import Fit, posed_vertices, true_frames, true_rgba
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import pad_charts, sample_atlas

OPAQUE = 250  # of 255: pixels on the true outline mix in the background
SURELY_SEEN = 0.9  # of 1: share of seen texels in what a bilinear lookup reads


def texture_errors(capture: Capture, body: PackagedBody, fit: Fit, atlas: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Look the texture up where the true pictures show the true body.

    Args:
        capture: with true pictures.
        body: that the fit is of.
        fit: the true one, see `ahoy_core.captures.fit.true_fit`.
        atlas: `coverage` [A,A], `chart` [A,A] and `filled_rgb` [A,A,3] of the texture.

    Returns:
        `texel_l1`: mean absolute difference, of 255, of seen texels before the input's camera; `unseen_l1`: of texels
        that were never seen, by camera; `psnr_seen`, `psnr_filled`: of both kinds over all cameras, dB.

    Raises:
        ValueError: there are no true pictures.
    """
    surface = Surface.of(body)
    seen_texels = pad_charts((atlas["coverage"] > 0).astype(np.float32), atlas["chart"])
    front: list[NDArray[np.float64]] = []
    unseen: dict[str, list[NDArray[np.float64]]] = {name: [] for name in capture.cameras}
    errors: list[NDArray[np.float64]] = []
    known: list[NDArray[np.bool_]] = []
    if not (frames := true_frames(capture)):
        raise ValueError(f"expected true pictures of {capture.name}, got none; a texture cannot be compared without")
    for frame in frames:
        vertices = posed_vertices(body, fit, frame)
        for name, camera in capture.cameras.items():
            truth = true_rgba(capture, View("view", name, frame))
            caster = Caster(to_camera(vertices, camera.viewmats[0].numpy()), surface.faces)
            hits = hit_map(caster, camera.Ks[0].numpy(), camera.width, camera.height)
            where = (hits.face >= 0) & (truth[..., 3] > OPAQUE)
            where[where] = surface.textured[hits.face[where]]
            uv = interpolate_uv(surface, hits.face[where], hits.bary[where])
            error = sample_atlas(atlas["filled_rgb"], uv).astype(np.float64) - truth[where][:, :3]
            seen = sample_atlas(seen_texels, uv)
            errors.append(error)
            known.append(seen > 0.5)
            unseen[name].append(error[seen <= 0.5])
            if name == capture.input_camera:
                front.append(error[seen > SURELY_SEEN])
    every, is_seen = np.concatenate(errors), np.concatenate(known)
    return {
        "texel_l1": round(float(np.abs(np.concatenate(front)).mean()), 2),
        "unseen_l1": {name: round(float(np.abs(np.concatenate(rows)).mean()), 1) for name, rows in unseen.items()},
        "psnr_seen": round(_psnr(every[is_seen]), 2),
        "psnr_filled": round(_psnr(every[~is_seen]), 2),
    }


def _psnr(errors: NDArray[np.float64]) -> float:
    return float(10 * np.log10(255**2 / np.square(errors).mean()))
