"""Completion of the atlas (paper section 3.1 asks FLUX): left/right symmetry, then harmonic filling, part by part.

1. A texel that was not seen takes the colour of the point opposite it (left/right symmetry), if that one was seen.
2. What is left is interpolated over the mesh, harmonically (sparse solve), each part from itself: links between parts
   (`ahoy_core.texture.parts`) are cut. The interpolation is pulled to what is likely: the back of the clothes to the
   front of the same part, the back of the head to its top, hands and face to the skin that was seen; a part of which
   nothing is known to a neutral colour (`ahoy_core.texture.tones`).
3. A screened Poisson solve over the texels joins the pieces of a part: gradients of the mirrored colours are kept,
   steps at their border are not.

All of it is done on colours from which the light they were seen in is divided out (`ahoy_core.texture.light`), and each
texel is lit again where it lies. Seen texels keep their colours bit by bit. Skin is the one exception to "each part
from itself": face and hands share it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.diffusion import Pull, solve_links, vertex_links
from ahoy_core.texture.links import mirror_texels, texel_links
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.seen import at_vertices, nearest_vertex, read_seen
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, pad_charts
from ahoy_core.texture.tones import likely_colours, neutral_cloth, skin_tone

FillKind = Literal["both", "harmonic", "symmetric"]

# Pull of the final solve to the fill of steps 1 and 2: the step at a border is spread over about 1 / sqrt(pull) = 30
# texels.
SCREENING = 1e-3


@dataclass(frozen=True)
class FilledAtlas:
    """A complete atlas, and where its colours come from.

    rgb [A,A,3] uint8, charts padded. mirrored and diffused are shares of the body's surface area; the rest was seen.
    part [N] uint8 of each texel, garments the borders that the colours showed. skin is the tone used for unseen hands
    and face, skin_from tells whether it was "seen" or "neutral". light is the slope of brightness over the normal that
    was estimated, zero where it was not.
    """

    rgb: IntArray
    mirrored: float
    diffused: float
    part: IntArray
    garments: tuple[str, ...]
    skin: tuple[int, int, int]
    skin_from: str
    light: tuple[float, float, float] = (0.0, 0.0, 0.0)


def fill_atlas(
    observed: ObservedAtlas,
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    fill: FillKind = "both",
    light: bool = True,
) -> FilledAtlas:
    """Complete an atlas.

    Args:
        observed: what was seen.
        surface: the body's triangles.
        texels: the atlas's texels on them.
        vertices: [V,3] the body in canonical pose, facing -y, metres.
        fill: "both"; "harmonic", without step 1; or "symmetric", where step 2 is one colour a part (the median of what
            is known of it) and there is no step 3.
        light: copy colours without the light they were seen in, and light them where they come to lie.
    """
    told = read_seen(observed, surface, texels, vertices, light)
    points, normals, areas, part = told.points, told.normals, told.areas, told.part
    seen, colours = told.seen, told.colours
    opposite = np.full(len(seen), -1)
    if fill != "harmonic":
        opposite = _opposite(points, normals, areas, vertices, seen)
    known = seen | (opposite >= 0)
    guess = np.where(seen[:, None], colours, colours[opposite])
    skin, skin_from = skin_tone(surface, texels, vertices, normals, colours, seen)
    if fill == "symmetric":
        for number in np.unique(part):
            there, missing = ((part == number) & some for some in (known, ~known))
            guess[missing] = np.median(guess[there], axis=0) if there.any() else neutral_cloth(part[missing])
        completed = guess
    else:
        value, weight = at_vertices(surface, texels, guess, known)
        base = _vertex_fill(surface, texels, vertices, value, weight, skin, told.parts.of_vertex)
        guess[~known] = base[~known]
        completed = _join(texels, points, normals, guess, colours, seen, known, part)
    rgb = np.zeros((texels.size * texels.size, 3), dtype=np.uint8)
    rgb[texels.flat] = np.clip(np.rint(completed * told.bright), 0, 255).astype(np.uint8)
    total = max(float(areas.sum()), 1e-12)
    return FilledAtlas(
        rgb=pad_charts(rgb.reshape(texels.size, texels.size, 3), texels.chart),
        mirrored=float(areas[known & ~seen].sum()) / total,
        diffused=float(areas[~known].sum()) / total,
        part=part.astype(np.uint8),
        garments=told.parts.found,
        skin=(int(skin[0]), int(skin[1]), int(skin[2])),
        skin_from=skin_from,
        light=(float(told.slope[0]), float(told.slope[1]), float(told.slope[2])),
    )


def _opposite(
    points: FloatArray, normals: FloatArray, areas: FloatArray, vertices: FloatArray, seen: BoolArray
) -> IntArray:
    """[N] the seen texel opposite each unseen one; -1 for the others, and where none is."""
    opposite = np.full(len(seen), -1)
    middle, spacing = float(vertices[:, 0].min() + vertices[:, 0].max()) / 2, float(np.sqrt(areas.mean()))
    sources, wanted = np.flatnonzero(seen), np.flatnonzero(~seen)
    opposite[wanted] = mirror_texels(points, normals, sources, wanted, middle, spacing)
    return opposite


def _vertex_fill(
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    value: FloatArray,
    weight: FloatArray,
    skin: FloatArray,
    part: IntArray,
) -> FloatArray:
    """Colours [N,3] of all texels, interpolated over the mesh from the known vertices and what is likely.

    A triangle on a border of parts has corners of both; its texels take the colour of the nearest corner.
    """
    pairs, weights = vertex_links(surface.faces, vertices)
    within = part[pairs[:, 0]] == part[pairs[:, 1]]
    pull = likely_colours(surface, vertices, value, weight > 0, skin, part)
    value = solve_links(pairs[within], weights[within], value, weight > 0, pull, direct=True)
    corners = surface.faces[texels.face]
    smooth = (value[corners] * texels.bary[:, :, None]).sum(axis=1)
    mixed = (part[corners] != part[corners][:, :1]).any(axis=1)
    smooth[mixed] = value[nearest_vertex(surface, texels)[mixed]]
    filled: FloatArray = smooth
    return filled


def _join(
    texels: TexelMap,
    points: FloatArray,
    normals: FloatArray,
    guess: FloatArray,
    colours: FloatArray,
    seen: BoolArray,
    known: BoolArray,
    part: IntArray,
) -> FloatArray:
    """The screened Poisson solve of step 3: colours [N,3]."""
    pairs = texel_links(texels, points, normals)
    pairs = pairs[part[pairs[:, 0]] == part[pairs[:, 1]]]
    open_pairs = pairs[~seen[pairs].all(axis=1)]
    # Between two mirrored texels, and between two interpolated ones, the guess's own gradient; across a border of
    # kinds, none.
    alike = ~seen[open_pairs].any(axis=1) & (known[open_pairs[:, 0]] == known[open_pairs[:, 1]])
    gradient = np.where(alike[:, None], guess[open_pairs[:, 0]] - guess[open_pairs[:, 1]], 0)
    given = np.where(seen[:, None], colours, guess)
    pull = Pull(guess, np.full(len(seen), SCREENING))
    return solve_links(open_pairs, np.ones(len(open_pairs)), given, seen, pull, gradient)
