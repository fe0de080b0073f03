"""Procedural garments: layers lifted off the body's surface, a skirt round the legs, and a cap of short hair."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ahoy_core.body.packaged import PackagedBody
from ahoy_core.prior.corpus.outfits import Shell

Array = NDArray[Any]

_SKIRT_ROWS, _SKIRT_COLUMNS = 10, 36
_LIMBS = {
    "arm": (("upperarm01", "upperarm02"), ("lowerarm01", "lowerarm02"), "upperarm01", "lowerarm01", "wrist"),
    "leg": (("upperleg01", "upperleg02"), ("lowerleg01", "lowerleg02"), "upperleg01", "lowerleg01", "foot"),
}


@dataclass(frozen=True, eq=False)
class Layer:
    """A mesh at rest: vertices [V,3] metres, lbs_weights [V,J], faces [F,3]."""

    vertices: Array
    lbs_weights: Array
    faces: Array


@dataclass(frozen=True, eq=False)
class BodyChart:
    """Where each vertex of the packaged body lies along its limb; the same for every shape.

    Attributes:
        body: the packaged body.
    """

    body: PackagedBody

    @cached_property
    def rest(self) -> tuple[Array, Array]:
        """Vertices [V,3] and joints [J,3] of the average adult at rest."""
        vertices, joints = self.body.shape(self.body.default_betas[None])
        return vertices[0].numpy(), joints[0].numpy()

    @cached_property
    def dominant(self) -> Array:
        """[V] the joint with the largest weight."""
        return self.body.lbs_weights.argmax(1).numpy()

    def along(self, limb: str) -> Array:
        """[V] position along a limb: 0 root, 0.5 elbow or knee, 1 wrist or ankle, more beyond; NaN elsewhere."""
        upper, lower, *anchors = _LIMBS[limb]
        vertices, joints = self.rest
        names = list(self.body.joint_names)
        position = np.full(len(vertices), np.nan)
        for side in ("L", "R"):
            root, middle, end = (joints[names.index(f"{anchor}.{side}")] for anchor in anchors)
            for parts, start, stop, base in ((upper, root, middle, 0.0), (lower, middle, end, 0.5)):
                inside = np.isin(self.dominant, [names.index(f"{part}.{side}") for part in parts])
                axis = stop - start
                share = (vertices[inside] - start) @ axis / (axis @ axis)
                position[inside] = base + 0.5 * np.clip(share, 0, 1)
            beyond = self._below(names.index(f"{anchors[2]}.{side}"))
            position[np.isin(self.dominant, beyond)] = 1.5
        return position

    def _below(self, joint: int) -> list[int]:
        found = [joint]
        for child, parent in enumerate(self.body.parents):
            if parent in found:
                found.append(child)
        return found

    @cached_property
    def head(self) -> Array:
        """[V] bool: skin of the head."""
        return self.body.regions["head"].numpy()

    def torso(self) -> Array:
        """[V] bool: neither limb nor head."""
        return np.isnan(self.along("arm")) & np.isnan(self.along("leg")) & ~self.head


def upper_layer(chart: BodyChart, shell: Shell, vertices: Array, normals: Array) -> Layer:
    """A shirt: torso above the waist and a share of the arms.

    Args:
        chart: of the body.
        shell: what is worn.
        vertices: [V,3] the shaped body at rest.
        normals: [V,3] its outward normals.
    """
    average, joints = chart.rest
    hip = joints[list(chart.body.joint_names).index("upperleg01.L"), 2]
    neck = joints[list(chart.body.joint_names).index("neck01"), 2] + 0.03
    leg = np.nan_to_num(chart.along("leg"), nan=-1.0)
    trunk = (chart.torso() | (leg >= 0)) & (average[:, 2] > hip + shell.waist - 0.06) & (average[:, 2] < neck)
    covered = trunk & (leg < 0.3)
    covered |= np.nan_to_num(chart.along("arm"), nan=9.0) < shell.sleeve + 0.02
    return _lifted(chart.body, covered, vertices, normals, np.full(len(vertices), shell.ease_upper))


def lower_layer(chart: BodyChart, shell: Shell, vertices: Array, normals: Array) -> Layer:
    """Trousers or shorts: torso below the waist and a share of the legs; a skirt where the shell says so."""
    average, joints = chart.rest
    hip = joints[list(chart.body.joint_names).index("upperleg01.L"), 2]
    leg = chart.along("leg")
    limb = np.nan_to_num(leg, nan=9.0)
    reach = 0.2 if shell.lower == "skirt" else shell.leg
    covered = (chart.torso() & (average[:, 2] < hip + shell.waist)) | (limb < reach)
    ease = 0.006 + shell.ease_lower * np.clip(np.nan_to_num(leg, nan=0.0), 0, 1)
    layer = _lifted(chart.body, covered, vertices, normals, ease)
    return _joined(layer, _skirt(chart, shell, vertices)) if shell.lower == "skirt" else layer


def hair_cap(chart: BodyChart, vertices: Array, normals: Array, length: float) -> Layer:
    """Short hair of some length (metres): the scalp above the ears and behind the face."""
    average, _ = chart.rest
    head = average[chart.head]
    top, front, back = head[:, 2].max(), head[:, 1].min(), head[:, 1].max()
    depth = (average[:, 1] - front) / (back - front)  # 0 at the nose, 1 behind
    line = top - 0.055 - 0.15 * np.clip((depth - 0.3) / 0.35, 0, 1)
    covered = chart.head & (average[:, 2] > line) & ~chart.body.regions["interior"].numpy()
    return _lifted(chart.body, covered, vertices, normals, np.full(len(vertices), length))


def _lifted(body: PackagedBody, covered: Array, vertices: Array, normals: Array, ease: Array) -> Layer:
    faces = body.faces.numpy()
    faces = faces[covered[faces].all(1)]
    used, compact = np.unique(faces, return_inverse=True)
    lifted = vertices[used] + ease[used, None] * normals[used]
    return Layer(lifted, body.lbs_weights.numpy()[used], compact.reshape(faces.shape).astype(np.int32))


def _joined(first: Layer, second: Layer) -> Layer:
    return Layer(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.lbs_weights, second.lbs_weights]),
        np.concatenate([first.faces, second.faces + len(first.vertices)]),
    )


def _skirt(chart: BodyChart, shell: Shell, vertices: Array) -> Layer:
    """A tube from the hips down; it follows both thighs, so it opens with them."""
    names = list(chart.body.joint_names)
    average, joints = chart.rest
    hip, knee = joints[names.index("upperleg01.L"), 2], joints[names.index("lowerleg01.L"), 2]
    ground = joints[names.index("foot.L"), 2]
    hem = hip - shell.leg * (hip - ground)
    rows = np.linspace(hip + min(shell.waist, 0.08), hem, _SKIRT_ROWS)
    angles = np.linspace(0, 2 * np.pi, _SKIRT_COLUMNS, endpoint=False)
    legs = ~np.isfinite(chart.along("arm")) & ~chart.head
    points, weights = [], []
    for level in rows:
        band = vertices[legs & (np.abs(average[:, 2] - level) < 0.03)]
        center, spread = band.mean(0), np.abs(band - band.mean(0)).max(0)
        grown = 0.01 + shell.flare * max(0.0, hip - level)
        ring = np.stack([np.cos(angles) * (spread[0] + grown), np.sin(angles) * (spread[1] + grown)], 1)
        points.append(np.column_stack([ring + center[:2], np.full(len(angles), center[2])]))
        left = 0.5 + 0.5 * np.clip(ring[:, 0] / max(spread[0], 1e-6), -1, 1)
        thigh = np.clip((hip + 0.03 - level) / max(hip - knee, 1e-6), 0, 0.85)
        row = np.zeros((len(angles), len(names)))
        row[:, 0] = 1 - thigh
        row[:, names.index("upperleg01.L")] = thigh * left
        row[:, names.index("upperleg01.R")] = thigh * (1 - left)
        weights.append(row)
    return Layer(np.concatenate(points), np.concatenate(weights), _tube_faces(len(rows), len(angles)))


def _tube_faces(rows: int, columns: int) -> Array:
    faces = []
    for r in range(rows - 1):
        for c in range(columns):
            a, b = r * columns + c, r * columns + (c + 1) % columns
            faces += [(a, b, a + columns), (b, b + columns, a + columns)]
    return np.array(faces, dtype=np.int32)
