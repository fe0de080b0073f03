"""What an unseen place of a person probably looks like, from what was seen of them elsewhere."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ahoy_core.texture.diffusion import Pull
from ahoy_core.texture.parts import LEG_PART, little_lightness
from ahoy_core.texture.rays import BoolArray, FloatArray, IntArray
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap

NEUTRAL_SKIN = (198.0, 160.0, 138.0)
NEUTRAL_CLOTH = (128.0, 128.0, 128.0)
# Trousers are darker than the middle grey: those of five captures, jeans among them, have means of 40 to 90.
NEUTRAL_TROUSERS = (70.0, 70.0, 72.0)
NEUTRAL_SHOE = (66.0, 62.0, 60.0)
# Strength of a guess against a link between neighbours: it takes over about 1 / sqrt(pull) vertices, some 4 cm, from
# the last colour that was seen. Weaker, and skin washes out over the shoulders and jeans over the shirt's back.
LIKELY_PULL = 0.5
# Fewer seen texels of skin than this are noise of the mask's border.
LEAST_SKIN_TEXELS = 20
# The face: the part of the head that looks ahead, between neck and hairline (shares of the head's height, from below).
FACE_FORWARD = 0.4
FACE_SPAN = (0.15, 0.65)
# The back of the head, above the neck, takes the colour of its top: hair, or skin where there is none.
BACK_OF_HEAD = 0.3
TOP_OF_HEAD = 0.75
# Looking for a back vertex's front, depth counts this much: less than 1 prefers the same height and limb to the same
# side, more than 0 the nearer of two layers.
DEPTH_WEIGHT = 0.3
# Vertices averaged into one guess: about 10 cm of cloth, so that no print is copied from front to back.
FRONT_VERTICES = 24
# Nearer than this to the skin's tone, in CIE Lab with lightness counted 0.3, what was seen of a garment's part is skin.
SKIN_LIKE = 10.0
# ... that far from the head (metres) at most: an open collar.
COLLAR_REACH = 0.15
# Further from anything seen (metres), the guess is dropped: a sock tells nothing about a shirt.
FRONT_REACH = 0.15


def face_points(points: FloatArray, normals: FloatArray, head: BoolArray, head_z: FloatArray) -> BoolArray:
    """Which of points belong to the face.

    Args:
        points: [N,3] on the canonical body, metres.
        normals: [N,3] unit.
        head: [N] bool, on the head.
        head_z: heights of the head's vertices, metres.
    """
    share = _head_share(points, head_z)
    return head & (normals[:, 1] < -FACE_FORWARD) & (share > FACE_SPAN[0]) & (share < FACE_SPAN[1])


def _head_share(points: FloatArray, head_z: FloatArray) -> FloatArray:
    """Heights [N] of points as shares of the head's; NaN where the body has no head."""
    if not len(head_z):
        return np.full(len(points), np.nan)
    low, high = head_z.min(), head_z.max()
    share: FloatArray = (points[:, 2] - low) / max(high - low, 1e-9)
    return share


def skin_tone(
    surface: Surface,
    texels: TexelMap,
    vertices: FloatArray,
    normals: FloatArray,
    colours: FloatArray,
    seen: BoolArray,
) -> tuple[FloatArray, str]:
    """Median colour [3] of the seen face, else of the seen hands, else a neutral tone; and which: "seen" or "neutral".

    Args:
        surface: the body's triangles.
        texels: the atlas's N texels on them.
        vertices: [V,3] canonical pose, metres.
        normals: [N,3] unit.
        colours: [N,3] in 0..255.
        seen: [N] bool.
    """
    corners = surface.faces[texels.face]
    on_head, on_hands = np.all(surface.head[corners], axis=1), np.all(surface.hands[corners], axis=1)
    face = face_points(texels.points(vertices, surface.faces), normals, on_head, vertices[surface.head][:, 2])
    for skin in (face & seen, on_hands & seen):
        if skin.sum() >= LEAST_SKIN_TEXELS:
            return np.median(colours[skin], axis=0), "seen"
    return np.array(NEUTRAL_SKIN), "neutral"


def neutral_cloth(part: IntArray) -> FloatArray:
    """Colours [N,3] of clothes of which nothing is known, from the parts [N] that they cover."""
    colours: FloatArray = np.where((part == LEG_PART)[:, None], NEUTRAL_TROUSERS, NEUTRAL_CLOTH)
    return colours


def likely_colours(
    surface: Surface, vertices: FloatArray, colours: FloatArray, known: BoolArray, skin: FloatArray, part: IntArray
) -> Pull:
    """Guesses for a mesh's vertices, and how strongly to pull there.

    Args:
        surface: the body's triangles.
        vertices: [V,3] canonical pose, facing -y, metres.
        colours: [V,3] in 0..255, of the known vertices.
        known: [V] bool.
        skin: [3] the skin's tone.
        part: [V] parts; a part is guessed from itself, one of which nothing is known gets a neutral colour.
    """
    target, strength = neutral_cloth(part), np.zeros(len(vertices))
    target[surface.feet] = NEUTRAL_SHOE
    for number in np.unique(part[~surface.hands & ~surface.head]):
        own = (part == number) & ~surface.hands & ~surface.head
        if (known & own).any():
            cloth = _cloth(surface, vertices, colours, known & own, skin)
            near, front = _front_for_back(vertices, colours, cloth, ~known & own)
            target[near], strength[near] = front, LIKELY_PULL
        else:
            strength[own] = LIKELY_PULL
    normals = vertex_normals(surface, vertices)
    share = _head_share(vertices, vertices[surface.head][:, 2])
    top = surface.head & known & (share > TOP_OF_HEAD)
    if top.any():
        back = surface.head & (share > BACK_OF_HEAD) & (normals[:, 1] > 0)
        target[back], strength[back] = np.median(colours[top], axis=0), LIKELY_PULL
    bare = surface.hands | face_points(vertices, normals, surface.head, vertices[surface.head][:, 2])
    target[bare], strength[bare] = skin, LIKELY_PULL
    return Pull(target, strength)


def _cloth(
    surface: Surface, vertices: FloatArray, colours: FloatArray, known: BoolArray, skin: FloatArray
) -> BoolArray:
    """Which known vertices of a part tell what its back looks like: not the skin in a collar, behind which is cloth.

    Where at least half of a part looks like skin, it is bare, or cloth of that colour, and all of it counts.
    """
    lab = little_lightness(np.vstack([colours[known], skin]))
    bare = np.linalg.norm(lab[:-1] - lab[-1], axis=1) < SKIN_LIKE
    if not surface.head.any() or bare.mean() >= 0.5:
        return known
    near = cKDTree(vertices[surface.head]).query(vertices[known])[0] < COLLAR_REACH
    cloth = known.copy()
    cloth[np.flatnonzero(known)[bare & near]] = False
    return cloth


def _front_for_back(
    vertices: FloatArray, colours: FloatArray, known: BoolArray, wanted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Vertex numbers [M] of those wanted that have something known before (or behind) them, and its colours [M,3]."""
    squash = np.array([1.0, DEPTH_WEIGHT, 1.0])
    sources, targets = np.flatnonzero(known), np.flatnonzero(wanted)
    count = min(FRONT_VERTICES, len(sources))
    distance, index = cKDTree(vertices[sources] * squash).query(vertices[targets] * squash, k=count)
    distance, index = distance.reshape(len(targets), count), index.reshape(len(targets), count)
    near = distance[:, 0] < FRONT_REACH
    return targets[near], np.median(colours[sources[index[near]]], axis=1)


def vertex_normals(surface: Surface, vertices: FloatArray) -> FloatArray:
    """Outward unit normals [V,3], faces weighted by area."""
    a, b, c = (vertices[surface.faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    normal = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normal, surface.faces[:, corner], area)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
