"""From hits to colours: albedo by material, a face, patterns and prints, then soft light in linear values."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from ahoy_core.prior.corpus import paint
from ahoy_core.prior.corpus.dress import KINDS, Dressed
from ahoy_core.prior.raster import Hits, texel

Array = NDArray[Any]

_kernel = numba.njit(nogil=True, cache=True, error_model="numpy")

_SKIN, _EYES = KINDS.index("skin"), KINDS.index("eyes")
_LIP, _IRIS = 0.011, 0.0055  # metres


class Light(NamedTuple):
    """Soft light: ambient in [0,1], a direction [3] towards the light (camera axes of the frame), sky (from above)."""

    ambient: float
    direction: Array
    sky: float


class Surface(NamedTuple):
    """Per pixel of N covered ones: number in the image [N], material [N], texture [N,3], normal [N,3], rest [N,3]."""

    pixels: Array
    material: Array
    texture: Array
    normal: Array
    rest: Array


def surface(hits: Hits, person: Dressed, normals: Array) -> Surface:
    """Looks everything up that does not depend on paint or light.

    Args:
        hits: of one image.
        person: who was drawn.
        normals: [V,3] camera axes.
    """
    index = np.flatnonzero(hits.face >= 0).astype(np.int32)
    face, bary = hits.face.ravel()[index], hits.bary.reshape(-1, 2)[index]
    n = len(index)
    colour, normal, rest = (np.empty((n, 3), dtype=np.float32) for _ in range(3))
    _lookup(
        face, bary, person.faces, person.uvs, person.materials, person.textures, normals.astype(np.float32),
        person.vertices, colour, normal, rest,
    )  # fmt: skip
    return Surface(index, person.materials[face], colour, normal, rest)


def shade(surface_: Surface, rows: Array, person: Dressed, light: Light) -> Array:
    """Colours [N,3] float32 sRGB in [0,1] of the covered pixels."""
    out = np.empty((len(surface_.pixels), 3), dtype=np.float32)
    direction = (light.direction / np.linalg.norm(light.direction)).astype(np.float32)
    _shade(
        surface_.material, surface_.texture, surface_.normal, surface_.rest, rows, person.features,
        light.ambient, direction, light.sky, out,
    )  # fmt: skip
    return out


@_kernel
def _lookup(
    face: Array, bary: Array, faces: Array, uvs: Array, materials: Array, textures: Array, normals: Array,
    vertices: Array, colour: Array, normal: Array, rest: Array,
) -> None:  # fmt: skip
    for n in range(len(face)):
        f = face[n]
        w1, w2 = bary[n, 0], bary[n, 1]
        w0 = 1.0 - w1 - w2
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u = w0 * uvs[f, 0, 0] + w1 * uvs[f, 1, 0] + w2 * uvs[f, 2, 0]
        v = w0 * uvs[f, 0, 1] + w1 * uvs[f, 1, 1] + w2 * uvs[f, 2, 1]
        pixel = texel(textures[materials[f]], u, v)
        length = 0.0
        for k in range(3):
            colour[n, k] = pixel[k] / 255.0
            normal[n, k] = w0 * normals[a, k] + w1 * normals[b, k] + w2 * normals[c, k]
            rest[n, k] = w0 * vertices[a, k] + w1 * vertices[b, k] + w2 * vertices[c, k]
            length += normal[n, k] * normal[n, k]
        # Cloth and hair are drawn from both sides: the visible one faces the camera (-z in camera axes).
        scale = (1.0 if normal[n, 2] < 0 else -1.0) / max(np.sqrt(length), 1e-6)
        for k in range(3):
            normal[n, k] *= scale


@_kernel
def _patterned(row: Array, x: float, y: float, z: float) -> bool:
    """Whether a point of rest space shows the pattern's second colour."""
    kind, frequency, phase, duty = int(row[paint.PATTERN]), row[paint.FREQUENCY], row[paint.PHASE], row[paint.DUTY]
    across = (z * frequency + phase) % 1.0 < duty
    upright = (x * frequency + phase) % 1.0 < duty
    if kind == paint.STRIPES:
        return across
    if kind == paint.COLUMNS_PATTERN:
        return upright
    if kind == paint.CHECKS:
        return across != upright
    if kind == paint.DOTS:
        dx, dz = (x * frequency) % 1.0 - 0.5, (z * frequency) % 1.0 - 0.5
        return dx * dx + dz * dz < 0.25 * duty
    if kind == paint.BLOCK:
        return z < phase
    if kind == paint.PANELS:
        return abs(x) > 0.1 + 0.1 * duty
    return False


@_kernel
def _printed(row: Array, x: float, y: float, z: float) -> bool:
    """Whether a point of rest space lies in a print; row is the print's eight numbers."""
    kind = int(row[0])
    if kind == paint.NO_PRINT or y * row[1] < -0.02:
        return False
    dx, dz = (x - row[2]) / row[4], (z - row[3]) / row[4]
    distance = dx * dx + dz * dz
    if kind == paint.DISC:
        return distance < 1.0
    if kind == paint.BOX:
        return abs(dx) < 0.8 and abs(dz) < 0.8
    if kind == paint.BAR:
        return abs(dx) < 1.0 and abs(dz) < 0.35
    if kind == paint.CROSS:
        return (abs(dx) < 0.3 and abs(dz) < 1.0) or (abs(dz) < 0.3 and abs(dx) < 1.0)
    if kind == paint.RING:
        return 0.45 < distance < 1.0
    letter = (int(np.floor(dx * 3.0)) * 7 + int(np.floor(dz * 2.0)) * 13 + int(row[4] * 1000)) % 5
    return abs(dx) < 1.0 and abs(dz) < 0.5 and letter < 3


@_kernel
def _shade(
    material: Array, texture: Array, normal: Array, rest: Array, rows: Array, features: Array, ambient: float,
    direction: Array, sky: float, out: Array,
) -> None:  # fmt: skip
    tint = np.empty(3, dtype=np.float32)
    for n in range(len(material)):
        m = material[n]
        row = rows[m]
        x, y, z = rest[n, 0], rest[n, 1], rest[n, 2]
        second = row[paint.PATTERN] > 0 and _patterned(row, x, y, z)
        blend = 1.0 if second else 0.0
        if int(row[paint.PATTERN]) == paint.GRADIENT:
            blend = min(1.0, max(0.0, 0.5 + (row[paint.PHASE] - z) * 2.5))
        keep = row[paint.KEEP] * (1.0 - blend)
        grey = (texture[n, 0] + texture[n, 1] + texture[n, 2]) / 3.0 / row[paint.GREYNESS]
        grey = min(grey, 1.6)
        for k in range(3):
            tint[k] = row[paint.TINT + k] + blend * (row[paint.PATTERN_TINT + k] - row[paint.TINT + k])
        if m in (_SKIN, _EYES):
            _face(m, x, y, z, features, tint)
        for number in range(2):
            start = paint.PRINTS + number * paint.PRINT_WIDTH
            if _printed(row[start : start + paint.PRINT_WIDTH], x, y, z):
                keep = 0.0
                for k in range(3):
                    tint[k] = row[start + 5 + k]
        rough = np.sin(61.0 * x + 17.0 * z) * np.sin(47.0 * z - 23.0 * y) * np.sin(53.0 * y + 29.0 * x + 11.0)
        wrinkle = 1.0 + row[paint.GRAIN] * 2.0 * rough
        toward = 0.0
        for k in range(3):
            toward += normal[n, k] * direction[k]
        received = ambient + (1.0 - ambient) * max(0.0, 0.25 + 0.75 * toward) + sky * max(0.0, -normal[n, 1])
        for k in range(3):
            colour = keep * texture[n, k] + (1.0 - keep) * tint[k] * grey
            colour = min(1.0, max(0.0, colour * wrinkle))
            out[n, k] = min(1.0, (colour**2.2 * received) ** (1 / 2.2))


@_kernel
def _face(material: int, x: float, y: float, z: float, features: Array, tint: Array) -> None:
    """Irises in the eyes; lips redder than the skin."""
    if material == _EYES:
        for side in range(2):
            if (x - features[side, 0]) ** 2 + (z - features[side, 2]) ** 2 < _IRIS**2:
                for k in range(3):
                    tint[k] = 0.18
        return
    middle_x, middle_z = 0.5 * (features[2, 0] + features[3, 0]), 0.5 * (features[2, 2] + features[3, 2])
    half = max(0.5 * abs(features[2, 0] - features[3, 0]), 1e-3)
    across, up = (x - middle_x) / half, (z - middle_z) / _LIP
    if across * across + up * up < 1.0 and y < features[2, 1] + 0.02:
        tint[0] *= 0.88
        tint[1] *= 0.62
        tint[2] *= 0.62
