"""What an atlas holds of a person, texel by texel: where, of which part, in which light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.light import estimate_light, shading
from ahoy_core.texture.parts import Parts, find_parts
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_normals


@dataclass(frozen=True)
class Seen:
    """N texels on the canonical body.

    points [N,3] metres, normals [N,3] unit, areas [N] square metres; seen [N]; colours [N,3] in 0..255 without the
    light they were seen in (nothing where not seen), part [N] of each texel and parts of the vertices; slope [3] of
    the light and bright [N,1], what it makes of a colour.
    """

    points: FloatArray
    normals: FloatArray
    areas: FloatArray
    seen: BoolArray
    colours: FloatArray
    part: IntArray
    parts: Parts
    slope: FloatArray
    bright: FloatArray


def read_seen(
    observed: ObservedAtlas, surface: Surface, texels: TexelMap, vertices: FloatArray, light: bool = True
) -> Seen:
    """Read an atlas.

    Args:
        observed: what was seen.
        surface: the body's triangles.
        texels: the atlas's texels on them.
        vertices: [V,3] the body in canonical pose, facing -y, metres.
        light: estimate the light; off, colours stay as they were seen.
    """
    points = texels.points(vertices, surface.faces)
    normals = texel_normals(texels, vertices, surface)
    areas = texels.areas(vertices, surface)
    seen = observed.coverage.ravel()[texels.flat] > 0
    colours = observed.rgb.reshape(-1, 3)[texels.flat].astype(np.float64)
    value, weight = at_vertices(surface, texels, colours, seen)
    parts = find_parts(surface, vertices, value, weight > 0)
    part = parts.of_vertex[nearest_vertex(surface, texels)]
    slope = estimate_light(colours, normals, areas, part, seen) if light else np.zeros(3)
    bright = shading(normals, slope)[:, None]
    return Seen(points, normals, areas, seen, colours / bright, part, parts, slope, bright)


def nearest_vertex(surface: Surface, texels: TexelMap) -> IntArray:
    """[N] the corner that each texel is nearest to."""
    nearest: IntArray = surface.faces[texels.face, texels.bary.argmax(axis=1)]
    return nearest


def at_vertices(
    surface: Surface, texels: TexelMap, colours: FloatArray, known: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Mean colours [V,3] of the known texels round each vertex, and how many they are [V]."""
    count = len(surface.limb)
    nearest = nearest_vertex(surface, texels)[known]
    weight = np.bincount(nearest, minlength=count)
    sums = [np.bincount(nearest, colours[known, channel], count) for channel in range(3)]
    return np.stack(sums, axis=1) / np.maximum(weight, 1)[:, None], weight
