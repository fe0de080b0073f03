"""The surface role: correspondences only where the right person is seen, squarely, away from boundaries."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from ahoy_core.texture.surface import PARTS, Surface, correspondences, look

from .synthetic import CapsuleBody, pictures, smooth_paint, standing


def posed(body: CapsuleBody, fit: dict[str, np.ndarray]) -> np.ndarray:
    betas = torch.as_tensor(fit["betas"]).expand(len(fit["pose"]), -1)
    return body(torch.as_tensor(fit["pose"]), betas, torch.as_tensor(fit["transl"])).vertices.numpy()


def test_uv_of_a_pixel_lies_in_the_chart_of_the_part_it_shows(body: CapsuleBody, surface: Surface) -> None:
    fit = standing(1, distance=3.2)
    _, masks = pictures(body, fit, smooth_paint)
    seen = correspondences(surface, posed(body, fit), fit["viewmat"], fit["K"], masks)
    head = seen.part[0] == PARTS.index("head")
    assert head.sum() > 50
    u, v = seen.uv[0][:, head]
    assert ((u > 0.25) & (u < 0.5) & (v < 0.5)).all()  # the head is the second chart of the lower row
    assert np.isnan(seen.uv[0][:, seen.part[0] == 0]).all()
    assert np.isfinite(seen.uv[0][:, seen.part[0] > 0]).all()


def test_what_the_mask_hides_is_not_trusted_and_neither_is_its_margin(body: CapsuleBody, surface: Surface) -> None:
    fit = standing(1, distance=3.2)
    _, masks = pictures(body, fit, smooth_paint)
    masks[0, 70:] = 0
    seen = look(surface, posed(body, fit)[0], fit["viewmat"], fit["K"], masks[0], boundary_px=4)
    height = np.flatnonzero((seen.hits.face >= 0).any(axis=1))
    boundary = 4 * (height[-1] - height[0] + 1) / 200
    distance = cv2.distanceTransform(masks[0], cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
    assert seen.valid.any()
    assert (distance[seen.valid] >= boundary - 1e-5).all()


def test_grazing_pixels_are_not_trusted(body: CapsuleBody, surface: Surface) -> None:
    fit = standing(1)
    _, masks = pictures(body, fit, smooth_paint)
    full = np.full_like(masks[0], 255)
    loose = look(surface, posed(body, fit)[0], fit["viewmat"], fit["K"], full, grazing_cos=0.05, boundary_px=0)
    tight = look(surface, posed(body, fit)[0], fit["viewmat"], fit["K"], full, grazing_cos=0.7, boundary_px=0)
    assert (tight.hits.cosine[tight.valid] >= 0.7).all()
    assert 0 < tight.valid.sum() < loose.valid.sum()


def test_the_edge_of_an_arm_before_the_chest_is_not_trusted(body: CapsuleBody, surface: Surface) -> None:
    fit = standing(1, distance=3.2)
    fit["pose"][0, 0, 2] = 1.3  # in profile: one arm before the chest
    vertices = posed(body, fit)[0]
    full = np.full((128, 128), 255, dtype=np.uint8)
    seen = look(surface, vertices, fit["viewmat"], fit["K"], full, grazing_cos=0.01, boundary_px=2)
    depth = seen.hits.depth
    both = np.isfinite(depth[:, 1:]) & np.isfinite(depth[:, :-1])
    jump = both & (np.abs(np.where(both, depth[:, 1:], 0) - np.where(both, depth[:, :-1], 0)) > 0.1)
    assert jump.sum() > 5
    assert not (seen.valid[:, 1:] & jump).any()
    assert not (seen.valid[:, :-1] & jump).any()


def test_interior_faces_are_never_trusted(body: CapsuleBody) -> None:
    fit = standing(1)
    _, masks = pictures(body, fit, smooth_paint)
    inside = CapsuleBody()
    inside.regions = {**body.regions, "interior": body.regions["head"]}
    surface = Surface.of(inside)
    seen = look(surface, posed(body, fit)[0], fit["viewmat"], fit["K"], masks[0], boundary_px=0)
    head_faces = body.regions["head"].numpy()[surface.faces].all(axis=1)
    assert head_faces[seen.hits.face[seen.hits.face >= 0]].any()
    assert not head_faces[seen.hits.face[seen.valid]].any()
