"""What the truth says of each pixel: surface that the input showed or never showed, and where the head is.

Both come from the true body and the true masks alone, so that they are the same for every method that is scored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures.capture import Capture, View, drive
from ahoy_core.conventions import Cameras, project
from ahoy_core.texture.rays import Caster, hit_map, to_camera, to_pixels

MOST_FRAMES = 60  # of the input, evenly chosen: neighbours show the same surface
GRAZING_COS = 0.1
HEAD_MARGIN = 0.15  # of the bare head's box, for hair


@dataclass(frozen=True)
class PixelTruth:
    """Of one true picture: `observed` [H,W] bool and the head's box x0, y0, x1, y1, or None where it is not in view."""

    observed: Tensor | None
    head: tuple[int, int, int, int] | None


class TrueSurface:
    """The true body of a capture, and which of its triangles the input shows."""

    def __init__(self, capture: Capture) -> None:
        self._body: BodyModel = load_packaged_body()
        self._faces = self._body.faces.numpy().astype(np.int32)
        self._vertices = {moment: _posed(capture, moment, self._body) for moment in capture.bodies}
        self._rows = {moment: truth.row for moment, truth in capture.bodies.items()}
        self.seen = self._seen(capture)

    def look(self, moment: str, frame: int, camera: Cameras) -> PixelTruth:
        """Pixels of a true picture.

        Args:
            moment: "view" or "pose".
            frame: number of the frame.
            camera: one, of the size that is scored.
        """
        vertices = self._vertices[moment][self._rows[moment](frame)]
        viewmat, K = camera.viewmats[0].numpy(), camera.Ks[0].numpy()
        hits = hit_map(Caster(to_camera(vertices, viewmat), self._faces), K, camera.width, camera.height)
        hit = hits.face >= 0
        observed = None
        if hit.any():
            nearest = distance_transform_edt(~hit, return_distances=False, return_indices=True)
            observed = torch.from_numpy(self.seen[hits.face[tuple(nearest)]])
        return PixelTruth(observed, self._head(vertices, camera))

    def _head(self, vertices: NDArray[np.float32], camera: Cameras) -> tuple[int, int, int, int] | None:
        head = torch.from_numpy(vertices)[self._body.regions["head"]]
        found = project(head, camera.viewmats[0], camera.Ks[0])
        if bool((found.depths <= 0).any()):
            return None
        low, high = found.pixels.amin(0), found.pixels.amax(0)
        margin = HEAD_MARGIN * (high - low)
        x0, y0 = (int(value) for value in (low - margin).floor().clamp(min=0))
        x1, y1 = (int(value) for value in (high + margin).ceil())
        x1, y1 = min(x1, camera.width), min(y1, camera.height)
        return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None

    def _seen(self, capture: Capture) -> NDArray[np.bool_]:
        """[F] triangles whose middle is in a visible pixel of the input, not from the side, with nothing before it."""
        seen = np.zeros(len(self._faces), dtype=bool)
        truth = capture.bodies["view"]
        camera = capture.cameras[capture.input_camera]
        viewmat, K = camera.viewmats[0].numpy(), camera.Ks[0].numpy()
        apart = -(-len(truth.frames) // MOST_FRAMES)
        for frame in truth.frames[::apart]:
            mask = capture.picture(View("input", capture.input_camera, frame)).alpha.numpy() > 0.5
            points = to_camera(self._vertices["view"][truth.row(frame)], viewmat)
            caster = Caster(points, self._faces)
            middles = points[self._faces].mean(1)
            pixels = np.nan_to_num(to_pixels(middles, K), nan=-1.0)
            column, row = np.floor(pixels).astype(int).T
            inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
            inside[inside] = mask[row[inside], column[inside]]
            towards = -(caster.normals * middles).sum(1) / np.maximum(np.linalg.norm(middles, axis=1), 1e-9)
            wanted = np.flatnonzero(inside & (towards > GRAZING_COS) & ~seen)
            seen[wanted[caster.sees(middles[wanted], wanted)]] = True
        return seen


def _posed(capture: Capture, moment: str, body: BodyModel) -> NDArray[np.float32]:
    truth = capture.bodies[moment]
    betas = (body.default_betas if truth.betas is None else truth.betas).float()
    pose, transl = drive(truth, body, betas)
    with torch.no_grad():
        return np.asarray(body(pose, betas[None], transl).vertices.numpy(), dtype=np.float32)
