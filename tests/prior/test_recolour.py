"""What the prior changes in the canonical views reaches the unobserved texture, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.prior.canonical import CanonicalFill
from ahoy_core.prior.completion import Pictures
from ahoy_core.prior.config import PriorConfig
from ahoy_core.prior.recolour import recoloured_atlas
from ahoy_core.prior.video import VideoModel
from ahoy_core.prior.views import PriorBody
from ahoy_core.roles import FILLINGS
from ahoy_core.texture.atlas import ObservedAtlas
from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, face_coverage, texel_map
from ahoy_core.texture.texture import canonical_vertices

SIZE = 96
FRONT, LEFT, BACK = 0, 1, 2


class Scene:
    """A body of one colour whose front half was observed."""

    def __init__(self) -> None:
        self.body: PackagedBody = load_packaged_body()
        self.surface = Surface.of(self.body)
        self.texels: TexelMap = texel_map(self.surface, SIZE)
        self.betas = self.body.default_betas.numpy()
        self.vertices = canonical_vertices(self.body, self.betas)
        self.points = self.texels.points(self.vertices, self.surface.faces)
        self.front = self.points[:, 1] < np.median(self.points[:, 1])
        rgb, coverage = np.zeros((SIZE * SIZE, 3), np.uint8), np.zeros(SIZE * SIZE, np.float32)
        rgb[self.texels.flat[self.front]], coverage[self.texels.flat[self.front]] = (120, 90, 60), 1
        source = np.where(coverage > 0, 0, -1).astype(np.int32)
        shape = (SIZE, SIZE)
        self.observed = ObservedAtlas(rgb.reshape(*shape, 3), coverage.reshape(shape), source.reshape(shape))
        self.filled = fill_atlas(self.observed, self.surface, self.texels, self.vertices).rgb
        self.fill = CanonicalFill(self.body, self.betas, self.observed)
        self.given: Pictures = self.fill(torch.from_numpy(self.fill.observed))

    def recoloured(self, made: torch.Tensor) -> np.ndarray:
        """Texels [N,3] after the prior made `made` of the views."""
        atlas = recoloured_atlas(self.observed, self.filled, self.surface, self.texels, self.vertices, self.given, made)
        return atlas.reshape(-1, 3)[self.texels.flat].astype(int)

    @property
    def before(self) -> np.ndarray:
        return self.filled.reshape(-1, 3)[self.texels.flat].astype(int)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_a_prior_that_changes_nothing_changes_nothing(scene: Scene) -> None:
    assert np.array_equal(scene.recoloured(scene.given.frames), scene.before)


def test_a_redder_back_reddens_the_unobserved_back_alone(scene: Scene) -> None:
    made = scene.given.frames.clone()
    made[BACK, 0] += 0.2
    change = scene.recoloured(made) - scene.before
    assert np.array_equal(change[scene.front], np.zeros_like(change[scene.front])), "evidence was overwritten"
    normals = np.cross(
        *(scene.vertices[scene.surface.faces][:, k] - scene.vertices[scene.surface.faces][:, 0] for k in (1, 2))
    )
    straight = (normals / np.linalg.norm(normals, axis=1, keepdims=True))[scene.texels.face][:, 1] > 0.9
    back = straight & ~scene.front
    # 0.2 of 255 is 51, less where a view of the coarse pictures sees observed and unobserved surface in one pixel.
    assert np.median(change[back, 0]) == pytest.approx(51, abs=3) and np.abs(change[back, 1:]).max() == 0


def test_a_change_where_a_view_shows_evidence_is_ignored(scene: Scene) -> None:
    made = scene.given.frames.clone()
    made[FRONT] = 1 - made[FRONT]
    change = np.abs(scene.recoloured(made) - scene.before)
    assert change[scene.front].max() == 0
    back = ~scene.front & (scene.points[:, 1] > np.quantile(scene.points[:, 1], 0.8))
    assert np.median(change[back]) == 0


def test_coverage_of_triangles_follows_the_texels(scene: Scene) -> None:
    share = face_coverage(scene.observed.coverage, scene.texels, scene.surface)
    assert share.shape == (len(scene.surface.faces),) and share.min() >= 0 and share.max() <= 1
    centres = scene.vertices[scene.surface.faces].mean(axis=1)
    textured, middle = scene.surface.textured, np.median(scene.points[:, 1])
    front, back = textured & (centres[:, 1] < middle - 0.03), textured & (centres[:, 1] > middle + 0.03)
    # A texel of 96 a side is up to 3 cm wide on the body: lookups near the border see both sides.
    assert share[front].mean() > 0.9 and share[back].mean() < 0.1
    assert not share[~textured].any()


def test_the_prior_fills_the_roles_views_and_inpaint(scene: Scene, embedded: VideoModel) -> None:
    person = PriorBody(embedded, scene.given, scene.fill.maps, scene.fill.azimuth, PriorConfig())
    front, mask = torch.rand(3, 128, 64, generator=torch.Generator().manual_seed(0)), scene.given.mask[0]
    views, azimuths = FILLINGS["views"]["embedded prior"](person, front, mask)
    assert views.shape == (4, 3, 128, 64) and azimuths == (0.0, 90.0, 180.0, 270.0)
    inside = (mask[0] > 0.999).expand(3, -1, -1)
    torch.testing.assert_close(views[0][inside], front[inside], rtol=0, atol=2e-3)
    hole = torch.zeros_like(mask)
    hole[:, 40:80] = 1
    filled = FILLINGS["inpaint"]["embedded prior"](person, front, hole, "a person", 3)
    kept = inside & (hole[0] == 0)
    torch.testing.assert_close(filled[kept], front[kept], rtol=0, atol=2e-3)
    assert float((filled - front)[inside & (hole[0] > 0)].abs().mean()) > 0.05
    with pytest.raises(ValueError, match="canonical views' size"):
        person.views(front[:, :64], mask[:, :64])
