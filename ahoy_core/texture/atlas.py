"""The observed atlas (paper section 3.1): what the frames show of each texel, first write wins.

The paper writes pixels into the atlas; here every texel is looked up in the frame instead (inverse mapping), which
leaves no holes between pixels when the atlas is finer than the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ahoy_core.texture.align import best_shift
from ahoy_core.texture.consensus import Consensus
from ahoy_core.texture.exposure import Exposure, ExposureMatch, match_exposure
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray, to_pixels, view_cosines
from ahoy_core.texture.surface import SeenFrame, Surface
from ahoy_core.texture.texels import TexelMap, sample_image

WriteRule = Literal["first", "best", "median"]

# A margin this many times the asked boundary is as good as any: beyond it, only angle, alpha and confidence rank
# views ("best").
SAFE_MARGIN = 4.0
# Written texels looked up to find a frame's shift: about half of them are in sight.
LOOKED_UP = 8000


@dataclass(frozen=True)
class ObservedAtlas:
    """What was seen of each texel.

    rgb [A,A,3] uint8 (0 where never seen), coverage [A,A] float32 in [0,1] (0: never), source_frame [A,A]
    int32 (-1: never).
    """

    rgb: IntArray
    coverage: FloatArray
    source_frame: IntArray


class Reading(NamedTuple):
    """K texels that a frame shows: numbers, rgb [K,3] uint8, coverage [K] in (0,1] and margin [K] (see `SeenFrame`)."""

    texel: IntArray
    rgb: IntArray
    coverage: FloatArray
    margin: FloatArray


class AtlasAccumulator:
    """Collects texel colours over frames.

    Args:
        surface: the body's triangles.
        texels: the atlas's texels on them.
        rule: "first": the first frame that shows a texel decides (the paper's rule, no blending over time). "best":
            the frame with the best view of it does, by angle, mask alpha, distance to the nearest boundary and
            confidence. "median": the frame whose colour is nearest to the consensus does, which no passing shadow or
            reflection is; without a consensus of the texel, the best view.
        grazing_cos: smallest trusted cosine between normal and view, as given to `look`.
        consensus: what most frames show; colours that contradict it are not written. None: everything is written.
    """

    def __init__(
        self,
        surface: Surface,
        texels: TexelMap,
        rule: WriteRule = "first",
        grazing_cos: float = 0.3,
        consensus: Consensus | None = None,
    ) -> None:
        self.surface, self.texels, self.rule, self.grazing_cos = surface, texels, rule, grazing_cos
        self.consensus = consensus
        count = len(texels.face)
        self._rgb = np.zeros((count, 3), dtype=np.uint8)
        self._coverage = np.zeros(count, dtype=np.float32)
        self._source = np.full(count, -1, dtype=np.int32)
        self._score = np.zeros(count, dtype=np.float32)
        self._everything = np.ones(count, dtype=bool)

    def add(
        self,
        number: int,
        image: IntArray,
        visible: IntArray,
        seen: SeenFrame,
        confidence: FloatArray | float = 1.0,
        min_confidence: float = 0.0,
    ) -> int:
        """Write what one frame shows; returns how many texels it wrote.

        Args:
            number: index of the frame, stored with the texels.
            image: [H,W,3] uint8 sRGB.
            visible: [H,W] uint8 alpha of the visible part of the person.
            seen: this frame, looked at with the same mask.
            confidence: in [0,1], one for the frame or one for each vertex [V].
            min_confidence: texels below it are not written.
        """
        trust = self._texel_confidence(confidence)
        pending = (self._source < 0) if self.rule == "first" else np.ones(len(self._source), dtype=bool)
        texel, rgb, coverage, margin = self.read(image, visible, seen, pending & (trust >= min_confidence))
        score = coverage * np.minimum(margin / SAFE_MARGIN, 1) * trust[texel]
        if self.rule == "median" and self.consensus is not None:
            score = np.where(self.consensus.votes[texel] > 0, self.consensus.closeness(texel, rgb), score)
        better = (self.rule == "first") | (score > self._score[texel])
        if self.consensus is not None:
            better &= self.consensus.agrees(texel, rgb)
        texel = texel[better]
        self._rgb[texel], self._coverage[texel] = rgb[better], coverage[better]
        self._source[texel], self._score[texel] = number, score[better]
        return len(texel)

    def read(self, image: IntArray, visible: IntArray, seen: SeenFrame, wanted: BoolArray | None = None) -> Reading:
        """What a frame shows of the wanted texels [N] bool (None: of all); arguments as in `add`."""
        texel, pixels, cosine = self._candidates(seen, np.flatnonzero(self._everything if wanted is None else wanted))
        # Only pixels inside the boundary give colour: at 30 pixels a person, bilinear lookups else take half of it
        # from the background.
        weight = np.where(seen.margin > 0, visible, 0).astype(np.float32)
        alpha = sample_image(weight, pixels) / 255
        found = alpha > 0
        texel, pixels, cosine, alpha = texel[found], pixels[found], cosine[found], alpha[found]
        colour = sample_image(image * weight[..., None], pixels) / (255 * alpha[:, None])
        rgb = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
        return Reading(texel, rgb, np.clip(cosine * alpha, 0, 1), seen.margin[_cells(pixels)])

    def shift(self, image: IntArray, seen: SeenFrame, reach: float) -> tuple[float, float]:
        """How far (x, y in pixels) a frame lies beside the consensus, or what was written; (0, 0) where none can tell.

        Args:
            image: [H,W,3] uint8 sRGB.
            seen: this frame, looked at.
            reach: largest shift along each axis, pixels.
        """
        pixels, known = self._common(seen)
        return best_shift(image, pixels, known, reach)

    def exposure(self, image: IntArray, seen: SeenFrame, mode: ExposureMatch) -> Exposure | None:
        """What brings a frame to the exposure of the consensus, or of what was written; None where nothing has to."""
        if mode == "off":
            return None
        pixels, known = self._common(seen)
        return match_exposure(sample_image(image, pixels), known, mode)

    def _common(self, seen: SeenFrame) -> tuple[FloatArray, FloatArray]:
        """Texels in sight whose colours are known (a sample of them): pixels [K,2] and colours [K,3], 0..255."""
        known, rgb = self._source >= 0, self._rgb
        if self.consensus is not None:
            known, rgb = self.consensus.votes > 0, self.consensus.rgb
        written = np.flatnonzero(known)
        texel, pixels, _ = self._candidates(seen, written[:: 1 + len(written) // LOOKED_UP])
        return pixels, rgb[texel].astype(np.float32)

    def _texel_confidence(self, confidence: FloatArray | float) -> FloatArray:
        if np.ndim(confidence) == 0:
            return np.full(len(self._source), confidence, dtype=np.float32)
        corner = np.asarray(confidence, dtype=np.float32)[self.surface.faces].min(axis=1)
        return corner[self.texels.face]

    def _candidates(self, seen: SeenFrame, texel: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Of the texels [M], those that the frame shows: their numbers [K], pixels [K,2] and view cosines [K]."""
        vertices, faces = seen.caster.vertices, seen.caster.faces
        centres = vertices[faces].mean(axis=1)
        normals = seen.caster.normals
        facing = view_cosines(centres, normals, seen.caster.camera_model) > 0
        texel = texel[facing[self.texels.face[texel]]]
        face = self.texels.face[texel]
        points = (vertices[faces[face]] * self.texels.bary[texel][:, :, None]).sum(axis=1)
        cosine = view_cosines(points, normals[face], seen.caster.camera_model).astype(np.float32)
        pixels = to_pixels(points, seen.K, seen.caster.camera_model)
        keep = (cosine >= self.grazing_cos) & _trusted(seen, pixels)
        keep[keep] = seen.caster.sees(points[keep], face[keep])
        return texel[keep], pixels[keep], cosine[keep]

    def result(self) -> ObservedAtlas:
        """The atlas as it stands."""
        size = self.texels.size
        rgb = np.zeros((size * size, 3), dtype=np.uint8)
        coverage = np.zeros(size * size, dtype=np.float32)
        source = np.full(size * size, -1, dtype=np.int32)
        rgb[self.texels.flat], coverage[self.texels.flat], source[self.texels.flat] = (
            self._rgb,
            self._coverage,
            self._source,
        )
        return ObservedAtlas(rgb.reshape(size, size, 3), coverage.reshape(size, size), source.reshape(size, size))


def _cells(pixels: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pixels that hold positions [N,2]."""
    return np.floor(pixels[:, 1]).astype(np.int64), np.floor(pixels[:, 0]).astype(np.int64)


def _trusted(seen: SeenFrame, pixels: FloatArray) -> BoolArray:
    """Whether positions [N,2] fall on a trusted pixel; outside the image and behind the camera, no."""
    height, width = seen.valid.shape
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    trusted = np.zeros(len(pixels), dtype=bool)
    trusted[inside] = seen.valid[_cells(pixels[inside])]
    return trusted
