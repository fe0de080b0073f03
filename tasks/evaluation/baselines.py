"""Built-in baselines: the fitted body as a mesh with the texture that the video gave it, and nothing trained.

`baseline: body mesh` shows what was seen and grey elsewhere; `baseline: mirrored` fills what was not seen from the
body's other side. The third of the paper's kind, the coarse avatar, is configuration A.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.body.load import load_body
from ahoy_core.body.model import BodyModel
from ahoy_core.captures.capture import Capture
from ahoy_core.conventions import GREY
from ahoy_core.formats.npz import load_npz
from ahoy_core.metrics.score import Made
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import pad_charts, sample_atlas
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.renderers import Driver, Renderer
from tasks.evaluation.truths import Shot
from tasks.stage import StageContext

BODY_MESH: Final = "baseline: body mesh"
MIRRORED: Final = "baseline: mirrored"
BASELINES: Mapping[str, tuple[str, ...]] = {BODY_MESH: (), MIRRORED: ("texture.fill=symmetric",)}
"""By name: settings of the stages before."""

_RAYS = 2  # a pixel and axis


class MeshRenderer:
    """The body's triangles with a texture, ray-cast.

    Args:
        atlas: `observed_rgb`, `filled_rgb` [A,A,3] uint8, `coverage` [A,A], `chart` [A,A] bool.
        completed: show the filled texture; off, what was never seen is grey.
        body: the model.
        driver: who stands where.
    """

    def __init__(self, atlas: Mapping[str, NDArray[Any]], completed: bool, body: BodyModel, driver: Driver) -> None:
        self._body, self._driver, self._surface = body, driver, Surface.of(body)
        seen = (atlas["coverage"] > 0)[..., None]
        grey = np.full_like(atlas["observed_rgb"], round(255 * GREY))
        rgb = atlas["filled_rgb"] if completed else np.where(seen, atlas["observed_rgb"], grey)
        self._rgb = pad_charts(np.asarray(rgb, dtype=np.uint8), np.asarray(atlas["chart"], dtype=bool))

    def __call__(self, shot: Shot) -> Made:
        """Draw one shot over grey."""
        pose, transl = self._driver.pose(shot)
        with torch.no_grad():
            vertices = self._body(pose[None], self._driver.betas[None], transl[None]).vertices[0]
        if shot.protocol == "novel-view-est":
            vertices = self._driver.alignment.points(vertices)
        camera = shot.camera
        height, width = camera.height * _RAYS, camera.width * _RAYS
        K = camera.Ks[0].numpy() * np.array([[_RAYS], [_RAYS], [1.0]], dtype=np.float32)
        points = to_camera(np.asarray(vertices.numpy(), dtype=np.float32), camera.viewmats[0].numpy())
        hits = hit_map(Caster(points, self._surface.faces), K, width, height)
        where = hits.face >= 0
        image = np.full((height, width, 3), 255 * GREY, dtype=np.float32)
        image[where] = sample_atlas(self._rgb, interpolate_uv(self._surface, hits.face[where], hits.bary[where]))
        both = np.concatenate([image / 255, where[..., None].astype(np.float32)], -1)
        small = both.reshape(camera.height, _RAYS, camera.width, _RAYS, 4).mean((1, 3))
        picture = torch.from_numpy(small).permute(2, 0, 1).float()
        return Made(picture[:3].contiguous(), picture[3].contiguous())


def mesh_renderer(name: str, ctx: StageContext, capture: Capture, fitted: Fitted) -> Renderer:
    """The renderer of a baseline from the stage's inputs.

    Args:
        name: of `BASELINES`.
        ctx: with the input `texture`.
        capture: whose true bodies drive it.
        fitted: shape, and poses where they are estimated.
    """
    body = load_body(ctx.body)
    driver = Driver(body, fitted.betas, capture, fitted)
    return MeshRenderer(load_npz(ctx.inputs["texture"] / "atlas.npz"), name == MIRRORED, body, driver)
