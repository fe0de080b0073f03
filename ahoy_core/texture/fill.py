"""Role "inpaint", the simple embedded default (paper section 3.1 asks FLUX): complete the atlas on the body's surface.

1. A texel that was not seen takes the colour of the point opposite it (left/right symmetry), if that one was seen.
2. What is left is interpolated over the mesh: no part border in UV is crossed, and no seam shows. The interpolation is
   pulled to what is likely: the back of the clothes to the front at the same place, the back of the head to its top,
   hands and face to the skin that was seen (`ahoy_core.texture.tones`).
3. A screened Poisson solve over the texels joins the pieces: gradients of the mirrored colours are kept, steps at
   their border are not.

Seen texels keep their colours bit by bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.diffusion import Pull, solve_links, vertex_links
from ahoy_core.texture.links import mirror_texels, texel_links
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, pad_charts, texel_normals
from ahoy_core.texture.tones import likely_colours, skin_tone

# Pull of the final solve to the fill of steps 1 and 2: the step at a border is spread over about 1 / sqrt(pull) = 30
# texels.
SCREENING = 1e-3


@dataclass(frozen=True)
class FilledAtlas:
    """A complete atlas, and where its colours come from.

    rgb [A,A,3] uint8, charts padded. mirrored and diffused are shares of the body's surface area; the rest was seen.
    skin is the tone used for unseen hands and face, skin_from tells whether it was "seen" or "neutral".
    """

    rgb: IntArray
    mirrored: float
    diffused: float
    skin: tuple[int, int, int]
    skin_from: str


def fill_atlas(
    observed: ObservedAtlas, surface: Surface, texels: TexelMap, vertices: FloatArray, symmetry: bool = True
) -> FilledAtlas:
    """Complete an atlas.

    Args:
        observed: what was seen.
        surface: the body's triangles.
        texels: the atlas's texels on them.
        vertices: [V,3] the body in canonical pose, facing -y, metres.
        symmetry: use left/right symmetry (step 1).
    """
    points = texels.points(vertices, surface.faces)
    normals = texel_normals(texels, vertices, surface)
    seen = observed.coverage.ravel()[texels.flat] > 0
    colours = observed.rgb.reshape(-1, 3)[texels.flat].astype(np.float64)
    areas = texels.areas(vertices, surface)
    opposite = np.full(len(seen), -1)
    if symmetry:
        middle, spacing = float(vertices[:, 0].min() + vertices[:, 0].max()) / 2, float(np.sqrt(areas.mean()))
        sources, wanted = np.flatnonzero(seen), np.flatnonzero(~seen)
        opposite[wanted] = mirror_texels(points, normals, sources, wanted, middle, spacing)
    known = seen | (opposite >= 0)
    guess = np.where(seen[:, None], colours, colours[opposite])
    skin, skin_from = skin_tone(surface, texels, vertices, normals, colours, seen)
    base = _vertex_fill(surface, texels, vertices, guess, known, skin)
    guess[~known] = base[~known]
    completed = _join(texels, points, normals, guess, colours, seen, known)
    rgb = np.zeros((texels.size * texels.size, 3), dtype=np.uint8)
    rgb[texels.flat] = np.clip(np.rint(completed), 0, 255).astype(np.uint8)
    total = max(float(areas.sum()), 1e-12)
    return FilledAtlas(
        rgb=pad_charts(rgb.reshape(texels.size, texels.size, 3), texels.chart),
        mirrored=float(areas[known & ~seen].sum()) / total,
        diffused=float(areas[~known].sum()) / total,
        skin=(int(skin[0]), int(skin[1]), int(skin[2])),
        skin_from=skin_from,
    )


def _vertex_fill(
    surface: Surface, texels: TexelMap, vertices: FloatArray, guess: FloatArray, known: BoolArray, skin: FloatArray
) -> FloatArray:
    """Colours [N,3] of all texels, interpolated over the mesh from the known ones and what is likely."""
    count = len(vertices)
    nearest = surface.faces[texels.face, texels.bary.argmax(axis=1)]
    weight = np.bincount(nearest[known], minlength=count)
    value = np.zeros((count, 3))
    for channel in range(3):
        value[:, channel] = np.bincount(nearest[known], guess[known, channel], count) / np.maximum(weight, 1)
    pairs, weights = vertex_links(surface.faces, vertices)
    pull = likely_colours(surface, vertices, value, weight > 0, skin)
    value = solve_links(pairs, weights, value, weight > 0, pull, direct=True)
    return (value[surface.faces[texels.face]] * texels.bary[:, :, None]).sum(axis=1)


def _join(
    texels: TexelMap,
    points: FloatArray,
    normals: FloatArray,
    guess: FloatArray,
    colours: FloatArray,
    seen: BoolArray,
    known: BoolArray,
) -> FloatArray:
    """The screened Poisson solve of step 3: colours [N,3]."""
    pairs = texel_links(texels, points, normals)
    open_pairs = pairs[~seen[pairs].all(axis=1)]
    # Between two mirrored texels, and between two interpolated ones, the guess's own gradient; across a border of
    # kinds, none.
    alike = ~seen[open_pairs].any(axis=1) & (known[open_pairs[:, 0]] == known[open_pairs[:, 1]])
    gradient = np.where(alike[:, None], guess[open_pairs[:, 0]] - guess[open_pairs[:, 1]], 0)
    given = np.where(seen[:, None], colours, guess)
    pull = Pull(guess, np.full(len(seen), SCREENING))
    return solve_links(open_pairs, np.ones(len(open_pairs)), given, seen, pull, gradient)
