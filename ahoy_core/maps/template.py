"""The canonical Gaussian template and its maps (paper section 3.1, "Canonical Gaussian maps").

Gaussians sit on the body's surface in the canonical pose, one per map pixel. See `ahoy_core.maps.charts` for which
view gives which pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel
from ahoy_core.maps.charts import VIEWS, Chart, Packer, Surface, scattered, view_charts

REACH = 0.015
"""Metres: a piece of surface counts as covered when a Gaussian is this near (docs/architecture.md, "Geometry")."""
TOP_K = 8
"""Skinning weights kept per Gaussian; the packaged body has at most nine a vertex, the ninth is below 1%."""
IN_CHANNELS_PER_SIDE = 7
"""Channels of one side's map: position, colour, observed."""

# Standard deviation of a disk over the distance to its neighbours: 0.7 leaves under 3% light through a grid of opaque
# disks and still keeps two neighbours apart; less shows holes, more blurs.
_SPREAD = 0.7
# Disks on a surface seen at a glancing angle are stretched by 1/cos, at most this much: beyond it another view fills
# the gaps, and a longer disk would stand out from a thin limb, seen from aside, as a bristle.
_MAX_STRETCH = 1.5
_THICKNESS = 0.15
_OPACITY = 0.98
_SURFACE_SAMPLES = 40_000
# Samples that no view gives are added where the nearest is further than this share of `REACH`.
_FAR = 0.8


@dataclass(frozen=True)
class Template:
    """N Gaussians on the body's surface in the canonical pose.

    Attributes:
        map_size: Side S of the maps.
        pitch: Metres between neighbouring pixels of the front map.
        pixels: [N,3] int64 (side, row, column), all different.
        means: [N,3] canonical positions, metres.
        rotations: [N,3,3] columns: two tangents, outward normal.
        scales: [N,3] standard deviations along those columns, metres.
        opacities: [N] in (0,1).
        colors: [N,3] sRGB in [0,1].
        observed: [N] in [0,1], how much of it the video showed.
        faces: [N] int64 body faces.
        barycentric: [N,3] within them.
        uv: [N,2] texture coordinates, origin lower left.
        skin_indices: [N,K] int64 joints.
        skin_weights: [N,K] weights of those joints, rows sum to 1.
        head: [N] bool, on the head.
        areas: [N] m² of the surface nearest to it.
    """

    map_size: int
    pitch: float
    pixels: Tensor
    means: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    observed: Tensor
    faces: Tensor
    barycentric: Tensor
    uv: Tensor
    skin_indices: Tensor
    skin_weights: Tensor
    head: Tensor
    areas: Tensor

    def __len__(self) -> int:
        return len(self.means)

    def paint(self, colors: Tensor, observed: Tensor) -> Template:
        """The same template with colours [N,3] and observed [N] in [0,1] (sampled from an atlas at `uv`)."""
        for name, value, shape in (("colors", colors, (len(self), 3)), ("observed", observed, (len(self),))):
            if tuple(value.shape) != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {tuple(value.shape)}; sample the atlas at uv")
        return replace(self, colors=colors.to(self.means), observed=observed.to(self.means).clamp(0, 1))

    def maps(self, positions: Tensor | None = None) -> Tensor:
        """The network's input, [1,14,S,S]: seven channels for the front, then for the back.

        Position (-1..1 over the canonical body's box), colour (-1..1), observed; zero where there is no Gaussian.

        Args:
            positions: [N,3] of the Gaussians in another pose, metres; the canonical ones by default.
        """
        low, high = self.means.amin(0), self.means.amax(0)
        points = self.means if positions is None else positions
        position = (points - (low + high) / 2) / ((high - low).max() / 2).clamp(min=1e-6)
        values = torch.cat([position, self.colors * 2 - 1, self.observed[:, None]], 1)
        maps = values.new_zeros(2, self.map_size, self.map_size, IN_CHANNELS_PER_SIDE)
        maps[tuple(self.pixels.T)] = values
        return maps.permute(0, 3, 1, 2).reshape(1, 2 * IN_CHANNELS_PER_SIDE, self.map_size, self.map_size)

    def gather(self, maps: Tensor) -> Tensor:
        """Read maps [1,2,C,S,S] at the Gaussians' pixels: [N,C]."""
        side, row, column = self.pixels.unbind(1)
        return maps[0, side, :, row, column]

    @property
    def observed_share(self) -> float:
        """Share of the surface's area that the video showed at all, however grazing, in [0,1]."""
        return float((self.areas * (self.observed > 0)).sum() / self.areas.sum().clamp(min=1e-12))


def textured_faces(body: BodyModel) -> Tensor:
    """[F] bool: faces that belong to the outer surface (no corner in the region "interior")."""
    return ~body.regions["interior"][body.faces].any(1)


def build_template(body: BodyModel, betas: Tensor, map_size: int = 256, max_gap: float | None = None) -> Template:
    """Sample the canonical body's surface.

    Args:
        body: The body model.
        betas: [S] shape.
        map_size: Side of the maps; 256 gives about 25,000 Gaussians.
        max_gap: Metres; samples beyond front and back view are added where none is nearer. Default: the pitch,
            at most 80% of `REACH`.

    Returns:
        The template, grey and unobserved (see `Template.paint`). With `map_size` of 128 and above at least 98% of the
        surface lies within 15 mm of a Gaussian; smaller maps have no room for that.

    Raises:
        ValueError: If betas do not fit the body or are not finite.
    """
    if betas.shape != (body.n_betas,) or not torch.isfinite(betas).all():
        raise ValueError(f"expected finite betas of shape ({body.n_betas},), got {tuple(betas.shape)}; check the fit")
    with torch.no_grad():
        posed = body(canonical_pose(body)[None].float(), betas[None].float(), torch.zeros(1, 3))
    surface_faces = torch.nonzero(textured_faces(body))[:, 0]
    surface = Surface.of(posed.vertices[0].double().numpy(), body.faces[surface_faces].numpy())
    size = surface.vertices[surface.faces.ravel()]
    pitch = float(np.ptp(size, axis=0)[[0, 2]].max()) / (map_size - 3)
    chart, pixels = _collect(surface, map_size, pitch, min(pitch, _FAR * REACH) if max_gap is None else max_gap)
    return _assemble(body, surface, surface_faces, chart, pixels, map_size, pitch)


def _collect(surface: Surface, map_size: int, pitch: float, gap: float) -> tuple[Chart, np.ndarray]:
    """All samples and their pixels [N,3]: front and back whole, then from every further view what is still missing."""
    packer = Packer(2, map_size)
    layers = {view: view_charts(surface, view, pitch) for view in VIEWS}
    charts = [layers["front"][0], layers["back"][0]]
    places = [packer.put(chart, side, 1, 1) for side, chart in enumerate(charts)]

    def add(chart: Chart) -> None:
        new = chart.select(_distances(charts, chart.points) > gap)
        where = packer.fit(new)
        charts.append(new.select(where[:, 0] >= 0))
        places.append(where[where[:, 0] >= 0])

    for chart in [layers[view][0] for view in ("left", "right", "below", "above")]:
        add(chart)
    for chart in [layer for view in VIEWS for layer in layers[view][1:]]:
        add(chart)
    add(_missed(surface, charts))
    names = ("rows", "cols", "points", "faces", "bary", "rays")
    together = Chart(*(np.concatenate([getattr(chart, name) for chart in charts]) for name in names))
    return together, np.concatenate(places)


def _distances(charts: list[Chart], points: np.ndarray) -> np.ndarray:
    """Metres from each point [M,3] to the nearest sample."""
    return cKDTree(np.concatenate([chart.points for chart in charts])).query(points.reshape(-1, 3))[0]


def _missed(surface: Surface, charts: list[Chart]) -> Chart:
    """Points where none of the views came within reach, thinned to half the reach."""
    faces, bary = sample_surface(surface, _SURFACE_SAMPLES, seed=0)
    points = surface.at(faces, bary)
    far = np.flatnonzero(_distances(charts, points) > _FAR * REACH)
    keep = np.ones(len(far), dtype=bool)
    tree = cKDTree(points[far])
    for index in range(len(far)):  # in order: whoever is still kept sends away those after it that are near
        if keep[index]:
            near = np.array(tree.query_ball_point(points[far[index]], _FAR * REACH))
            keep[near[near > index]] = False
    return scattered(surface, faces[far[keep]], bary[far[keep]])


def sample_surface(surface: Surface, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over the area: faces [count] and barycentric coordinates [count,3]."""
    rng = np.random.default_rng(seed)
    faces = rng.choice(len(surface.faces), size=count, p=surface.areas / surface.areas.sum())
    root, second = np.sqrt(rng.random(count)), rng.random(count)
    return faces, np.stack([1 - root, root * (1 - second), root * second], 1)


def _assemble(
    body: BodyModel, surface: Surface, ids: Tensor, samples: Chart, pixels: np.ndarray, map_size: int, pitch: float
) -> Template:
    faces, bary = ids[torch.from_numpy(samples.faces.astype(np.int64))], torch.from_numpy(samples.bary).float()
    corners, corner_uv = body.faces[faces], body.uvs[body.uv_faces[faces]]
    dense = (body.lbs_weights[corners].float() * bary[:, :, None]).sum(1)
    weights, indices = dense.topk(min(TOP_K, dense.shape[1]), dim=1)
    rotations, scales = _disks(surface.normals[samples.faces], samples.rays, pitch)
    count = len(samples.points)
    return Template(
        map_size=map_size,
        pitch=pitch,
        pixels=torch.from_numpy(pixels.astype(np.int64)),
        means=torch.from_numpy(samples.points).float(),
        rotations=torch.from_numpy(rotations).float(),
        scales=torch.from_numpy(scales).float(),
        opacities=torch.full((count,), _OPACITY),
        colors=torch.full((count, 3), 0.5),
        observed=torch.zeros(count),
        faces=faces,
        barycentric=bary,
        uv=(corner_uv.float() * bary[:, :, None]).sum(1),
        skin_indices=indices,
        skin_weights=weights / weights.sum(1, keepdim=True),
        head=(body.regions["head"][corners].float() * bary).sum(1) > 0.5,
        areas=_areas(surface, samples.points),
    )


def _disks(normals: np.ndarray, directions: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Flat disks in the tangent plane, stretched along the slope as the view's pixel grid is."""
    along = directions - (directions * normals).sum(1, keepdims=True) * normals
    flat = np.linalg.norm(along, axis=1) < 1e-6
    other = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    along[flat] = (other - (other * normals).sum(1, keepdims=True) * normals)[flat]
    first = along / np.linalg.norm(along, axis=1, keepdims=True)
    rotations = np.stack([first, np.cross(normals, first), normals], 2)
    slope = np.abs((directions * normals).sum(1))
    stretch = 1 / np.maximum(slope, 1 / _MAX_STRETCH)
    scales = np.stack([_SPREAD * stretch, np.full_like(stretch, _SPREAD), np.full_like(stretch, _THICKNESS)], 1)
    return rotations, scales * pitch


def _areas(surface: Surface, points: np.ndarray) -> Tensor:
    sampled = surface.at(*sample_surface(surface, _SURFACE_SAMPLES, seed=1))
    counts = np.bincount(cKDTree(points).query(sampled)[1], minlength=len(points))
    return torch.from_numpy(counts * (surface.areas.sum() / _SURFACE_SAMPLES)).float()
