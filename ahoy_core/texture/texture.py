"""The texture stage (paper section 3.1): frames and fitted body -> atlas and canonical views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.texture.accumulate import Clip, Log, Progress, SecondOpinion, accumulate
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.canonical import canonical_views
from ahoy_core.texture.fill import FilledAtlas, fill_atlas
from ahoy_core.texture.inputs import TextureConfig, check_inputs, choose_frames
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.seen import read_seen
from ahoy_core.texture.stains import without_stains
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_map

FILL_WORDS = {
    "both": "left/right symmetry, then harmonic on the surface, part by part",
    "harmonic": "harmonic on the surface, part by part",
    "symmetric": "left/right symmetry, then one colour a part",
}


@dataclass(frozen=True)
class Texture:
    """The artifact "texture" (storage_schema): fields of atlas.npz, canonical.npz and texture.json.

    observed_rgb [A,A,3] uint8, coverage [A,A] float32, source_frame [A,A] int32 (-1: never seen), filled_rgb [A,A,3]
    uint8 (complete, padded for bilinear lookups), chart [A,A] bool; views [4,H,W,4] uint8, view_coverage [4,H,W]
    uint8, partial [H,W,4] uint8, viewmats [4,4,4] and Ks [4,3,3] float32 (orthographic); notes, ready for JSON.
    """

    observed_rgb: IntArray
    coverage: FloatArray
    source_frame: IntArray
    filled_rgb: IntArray
    chart: BoolArray
    views: IntArray
    view_coverage: IntArray
    partial: IntArray
    viewmats: FloatArray
    Ks: FloatArray
    notes: dict[str, Any]

    def atlas_arrays(self) -> dict[str, np.ndarray]:
        """Arrays of atlas.npz."""
        return {
            name: getattr(self, name) for name in ("observed_rgb", "coverage", "source_frame", "filled_rgb", "chart")
        }

    def canonical_arrays(self) -> dict[str, np.ndarray]:
        """Arrays of canonical.npz."""
        arrays = {name: getattr(self, name) for name in ("views", "partial", "viewmats", "Ks")}
        return {**arrays, "coverage": self.view_coverage}


def build_texture(
    frames: IntArray,
    visible: IntArray,
    fit: Mapping[str, np.ndarray],
    body: BodyModel,
    config: TextureConfig,
    progress: Progress | None = None,
    canonical: FloatArray | None = None,
    second: SecondOpinion | None = None,
) -> Texture:
    """Accumulate the atlas over the frames, complete it, and view the textured body in canonical pose.

    Args:
        frames: [T,H,W,3] uint8 sRGB.
        visible: [T,H,W] uint8 alpha of the visible part of the person.
        fit: the arrays of the perceive stage's body.npz: pose [T,J,3], transl [T,3], betas [S], expression [T,E],
            joint_confidence [T,J], frame_confidence [T], used [T], viewmat [4,4], K [3,3].
        body: the body model that was fitted.
        config: knobs.
        progress: called with frames done and frames in all, of both passes.
        canonical: [V,3] the fitted shape in the canonical pose theta_*; `canonical_vertices` by default.
        second: see `ahoy_core.texture.accumulate.Clip`.

    Raises:
        ValueError: where shapes disagree, or an array is missing.
    """
    check_inputs(frames, visible, fit, body)
    surface = Surface.of(body)
    texels = texel_map(surface, config.atlas_size)
    chosen, rejected = choose_frames(fit["used"], fit["frame_confidence"], config)
    vertices = canonical_vertices(body, fit["betas"]) if canonical is None else canonical
    points = texels.points(vertices, surface.faces)
    clip = Clip(frames, visible, fit, body, surface, config, second)
    observed, log = accumulate(clip, texels, points, chosen, progress)
    stained = 0.0
    if config.drop_stains:
        told = read_seen(observed, surface, texels, vertices, config.light)
        observed, stained = without_stains(observed, told, surface, texels)
    filled = fill_atlas(observed, surface, texels, vertices, config.fill, config.light)
    rendered = canonical_views(
        surface,
        texels,
        vertices,
        observed,
        filled.rgb,
        config.canonical_height,
        config.canonical_width,
        config.supersample,
    )
    return Texture(
        observed_rgb=observed.rgb,
        coverage=observed.coverage,
        source_frame=observed.source_frame,
        filled_rgb=filled.rgb,
        chart=texels.chart,
        views=rendered.views,
        view_coverage=rendered.coverage,
        partial=rendered.partial,
        viewmats=rendered.cameras.viewmats.numpy().astype(np.float32),
        Ks=rendered.cameras.Ks.numpy().astype(np.float32),
        notes=_notes(observed, filled, surface, texels, vertices, chosen, rejected, log, config, stained),
    )


def canonical_vertices(body: BodyModel, betas: FloatArray) -> FloatArray:
    """Vertices [V,3] of a shape in canonical pose with zero translation; float32, metres.

    Args:
        body: the packaged body or one of the SMPL family.
        betas: [S].

    Raises:
        ValueError: for a body that has no canonical pose.
    """
    shape = torch.as_tensor(betas).to(body.lbs_weights)
    with torch.no_grad():
        output = body(canonical_pose(body)[None], shape[None], shape.new_zeros(1, 3))
    vertices: FloatArray = output.vertices[0].cpu().numpy().astype(np.float32)
    return vertices


def _notes(
    observed: ObservedAtlas,
    filled: FilledAtlas,
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    chosen: list[int],
    rejected: dict[str, list[int]],
    log: Log,
    config: TextureConfig,
    stained: float,
) -> dict[str, Any]:
    """What texture.json says."""
    areas = texels.areas(vertices, surface)
    seen = observed.coverage.ravel()[texels.flat] > 0
    return {
        "observed_share": float(areas[seen].sum() / max(areas.sum(), 1e-12)),
        "stained_share": round(stained, 4),
        "mirrored_share": filled.mirrored,
        "diffused_share": filled.diffused,
        "fill": FILL_WORDS[config.fill],
        "filled_with": {"fill": config.fill, "light": config.light},
        "garment_borders": list(filled.garments),
        "skin": {"rgb": list(filled.skin), "from": filled.skin_from},
        "light": [round(slope, 3) for slope in filled.light],
        "rule": config.rule,
        "frames_used": chosen,
        "texels_written": {str(t): count for t, count in log.written.items()},
        "frame_shifts_px": {str(t): list(shift) for t, shift in log.shifts.items() if shift != (0.0, 0.0)},
        "frame_gains": {str(t): round(gain, 3) for t, gain in log.gains.items()},
        "frames_rejected": rejected,
    }
