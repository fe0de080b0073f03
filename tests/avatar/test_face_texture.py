"""Face views out of the head's texture: where a texel lands, what has a weight, and that no face is invented."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ahoy_core.avatar.avatar import AvatarInfo
from ahoy_core.avatar.face_role import face_cameras
from ahoy_core.avatar.face_texture import AZIMUTHS, FILLED, GRAZING, MARGIN, SHARE, reprojected_faces
from ahoy_core.avatar.face_views import observed_faces
from ahoy_core.avatar.full import train_full
from ahoy_core.avatar.full_config import ABLATIONS, FullConfig
from ahoy_core.avatar.head import FaceViews, join_faces
from ahoy_core.avatar.supervision import CoarseInputs
from ahoy_core.formats.images import read_png
from ahoy_core.texture.rays import Caster, HitMap, hit_map, to_camera
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_map, texel_normals
from ahoy_core.texture.texture import canonical_vertices
from ahoy_core.texture.tones import FACE_SPAN, face_points
from tasks.face_views import ChosenFaces, choose_faces, draw_faces, prior_filled
from tasks.fills import Fills
from tasks.stage import StageContext
from tests.avatar.full_scenes import TINY_FULL, faces, full_inputs, kinematics
from tests.avatar.scenes import body, coarse_inputs, template

SIZE = 128  # of the atlas: a texel of the head is about 5 mm
SIDE = 96
RED = np.array([1.0, 0.0, 0.0], dtype=np.float32)


@cache
def head() -> tuple[Surface, np.ndarray, TexelMap, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Surface, vertices, texels, their points and normals, and which are on the head and in the face."""
    surface, vertices = Surface.of(body()), canonical_vertices(body(), body().default_betas.numpy())
    texels = texel_map(surface, SIZE)
    points, normals = texels.points(vertices, surface.faces), texel_normals(texels, vertices, surface)
    on_head = surface.head[surface.faces[texels.face]].all(1)
    return surface, vertices, texels, points, normals, on_head, _face(points, normals, on_head, vertices, surface)


def _face(points: Any, normals: Any, on_head: Any, vertices: Any, surface: Surface) -> np.ndarray:
    return np.asarray(face_points(points, normals, on_head, vertices[surface.head][:, 2]))


def _textured(seen: np.ndarray, colours: np.ndarray | None = None) -> CoarseInputs:
    """The small scene with an atlas: which texels [N] were seen, and their colours [N,3] (grey by default)."""
    texels = head()[2]
    coverage, atlas = np.zeros(SIZE * SIZE, np.float32), np.full((SIZE * SIZE, 3), 0.5, np.float32)
    coverage[texels.flat] = seen
    if colours is not None:
        atlas[texels.flat] = colours
    picture = torch.from_numpy(atlas.reshape(SIZE, SIZE, 3)).permute(2, 0, 1)
    return replace(coarse_inputs(), atlas=picture, atlas_coverage=torch.from_numpy(coverage.reshape(SIZE, SIZE)))


def _views(inputs: CoarseInputs, prior_filled: bool = True) -> FaceViews:
    views = reprojected_faces(inputs, template(), prior_filled, SIDE).views
    assert views is not None
    return views


@cache
def _whole() -> FaceViews:
    """Views of a head that was observed all over."""
    return _views(_textured(np.ones(len(head()[3]))))


def _hits(views: FaceViews, number: int) -> tuple[HitMap, np.ndarray]:
    """What a view's pixels see, and their points [H,W,3] in the world (NaN where nothing)."""
    camera = views.cameras
    return _cast(tuple(camera.viewmats[number].flatten().tolist()), tuple(camera.Ks[number].flatten().tolist()))


@cache
def _cast(viewmat: tuple[float, ...], K: tuple[float, ...]) -> tuple[HitMap, np.ndarray]:
    surface, vertices, *_ = head()
    caster = Caster(to_camera(vertices, np.array(viewmat).reshape(4, 4)), surface.faces)
    hits = hit_map(caster, np.array(K).reshape(3, 3), SIDE, SIDE)
    points = (vertices[surface.faces[hits.face]] * hits.bary[..., None]).sum(2)
    points[hits.face < 0] = np.nan
    return hits, points


def _pixel_kinds(views: FaceViews, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a view's pixels [H,W]: on the head, in the face, where a prior may fill."""
    surface, vertices, *_ = head()
    hits, points = _hits(views, number)
    a, b, c = (vertices[surface.faces[hits.face]][:, :, i] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-20)
    on_head = (hits.face >= 0) & surface.head[surface.faces[hits.face]].all(2)
    flat = (points.reshape(-1, 3), normals.reshape(-1, 3), on_head.ravel())
    face = _face(*flat, vertices, surface).reshape(SIDE, SIDE)
    low, high = vertices[surface.head].min(0), vertices[surface.head].max(0)
    above = points[..., 2] > low[2] + FACE_SPAN[1] * (high[2] - low[2])
    behind = (normals[..., 1] > 0) & (points[..., 1] > (low[1] + high[1]) / 2)
    assert not (face & (above | behind)).any()
    return on_head, face, on_head & (above | behind)


@pytest.mark.parametrize("toward", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-0.7, 0.7, 0.1)])
def test_a_spot_of_paint_appears_where_the_camera_projects_it(toward):
    """A spot on the nose's side, over an ear, behind: the oracle is `Cameras.project`, which casts no ray."""
    _, _, _, points, normals, on_head, _ = head()
    centre = points[on_head].mean(0) + np.array([0, 0, 0.04])
    along = (points - centre) @ np.array(toward)
    aside = np.linalg.norm(points - centre - along[:, None] * np.array(toward), axis=1)
    chosen = np.flatnonzero(on_head & (aside < 0.03))
    spot = points[chosen[along[chosen].argmax()]]
    painted = np.linalg.norm(points - spot, axis=1) < 0.02
    inputs = _textured(np.ones(len(points)), np.where(painted[:, None], RED, np.float32(0.5)))
    views = _views(inputs, prior_filled=False)
    pixels = views.cameras.project(torch.from_numpy(spot).float()[None]).pixels[:, 0]
    away = torch.nn.functional.normalize(views.cameras.centers - torch.from_numpy(spot).float(), dim=1)
    facing = away @ torch.from_numpy(normals[painted].mean(0)).float()
    looked = torch.nonzero(facing > 0.8)[:, 0].tolist()
    assert looked
    for view in looked:
        x, y = (float(v) for v in pixels[view])
        assert views.images[view, :, int(y), int(x)].tolist() == pytest.approx([1, 0, 0], abs=0.02)
        red = (views.images[view, 0] - views.images[view, 1]).clamp(min=0)
        ys, xs = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
        # A spot 2 cm round is 10 pixels wide and bent: its middle is within two of its centre's.
        assert abs(float((red * xs).sum() / red.sum()) - x) < 2 and abs(float((red * ys).sum() / red.sum()) - y) < 2


def test_a_face_that_was_never_seen_has_no_weight_and_nothing_depends_on_what_a_prior_gives_there():
    _, _, _, points, _, on_head, face = head()
    seen = ~on_head | (points[:, 0] > 0.02)  # one half of the head, and the body
    hidden = face & ~seen
    colours = np.random.default_rng(0).random((len(points), 3)).astype(np.float32)
    other = np.where(hidden[:, None], np.float32(1) - colours, colours)
    first, second = _views(_textured(seen, colours)), _views(_textured(seen, other))
    for name in ("images", "alphas", "weights", "shares"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name
    assert hidden.sum() > 100 and not np.array_equal(colours, other)
    counted = 0
    for number in range(len(first)):
        _, in_face, _ = _pixel_kinds(first, number)
        _, where = _hits(first, number)
        unseen = in_face & (where[..., 0] < 0.02 - 0.01)  # a texel, which is half observed at the border, is 5 mm
        counted += int(unseen.sum())
        assert float(first.weights[number][torch.from_numpy(unseen)].sum()) == 0
    assert counted > 200
    trained = [_trained(views) for views in (first, second)]
    assert torch.equal(trained[0], trained[1])
    # It is no matter of nothing ever mattering: the same change of the hair's fill trains another head.
    hair = on_head & ~face & ~seen
    changed = _views(_textured(seen, np.where(hair[:, None], np.float32(1) - colours, colours)))
    assert not torch.equal(first.images, changed.images) and not torch.equal(trained[0], _trained(changed))


def _trained(views: FaceViews) -> Tensor:
    inputs = replace(full_inputs(with_faces=False), faces=views, sequences=())
    config = TINY_FULL.model_copy(update={"steps": 2, "faces_per_step": 2})
    return train_full(inputs, config, AvatarInfo(body="test")).avatar.colors


def test_a_prior_fills_hair_and_the_back_of_the_head_alone_and_with_less_weight():
    nothing = _textured(np.zeros(len(head()[3])))
    views = _views(nothing)
    assert float(views.weights.max()) == pytest.approx(FILLED)
    behind = 0
    for number in range(len(views)):
        on_head, _, hair = _pixel_kinds(views, number)
        assert not (views.weights[number].numpy() > 0)[~hair].any()
        behind += int((views.weights[number].numpy() > 0).sum() > 0.5 * on_head.sum())
    assert behind >= 6  # of 24 cameras: those behind
    made = reprojected_faces(nothing, template(), True, SIDE)
    assert made.observed == 0 and 0.2 < made.filled < 0.7


def test_where_no_prior_filled_what_was_not_seen_has_no_weight():
    points = head()[3]
    left = points[:, 0] > 0
    made = reprojected_faces(_textured(left), template(), False, SIDE)
    assert made.views is not None and made.filled == 0 and 0.4 < made.observed < 0.6
    assert set(made.views.weights.unique().tolist()) == {0.0, 1.0}
    for number in range(len(made.views)):
        _, where = _hits(made.views, number)
        assert not (made.views.weights[number].numpy() > 0)[where[..., 0] < -0.005].any()
    # Whoever is seen from the right alone shows the cameras on the left next to nothing: no views, or little share.
    whole = _whole()
    assert len(made.views) < len(whole)
    assert float(made.views.shares.min()) < 0.3 * float(whole.shares.min())


def test_the_outline_of_the_bare_head_has_no_weight():
    views = _whole()
    pixel = 1.0 / float(views.cameras.Ks[0, 0, 0])  # metres, at the cameras' distance of 1 m
    for number in range(len(views)):
        on_head, *_ = _pixel_kinds(views, number)
        hits, _ = _hits(views, number)
        inside = distance_transform_edt(on_head) * pixel
        counts = views.weights[number].numpy() > 0
        assert float(inside[counts].min()) > MARGIN and float(hits.cosine[counts].min()) >= GRAZING
        assert 0.2 < counts.sum() / on_head.sum() < 0.95
        assert torch.equal(views.alphas[number] > 0, views.weights[number] > 0)
    assert float(views.shares.max()) < SHARE and len(views) == 2 * len(AZIMUTHS)


def test_nothing_observed_too_little_and_no_head_give_no_views_and_the_reason():
    points, on_head = head()[3], head()[5]
    nothing = reprojected_faces(_textured(np.zeros(len(points))), template(), False)
    assert nothing.views is None and "no part of the head" in nothing.reason
    one = np.zeros(len(points))
    one[np.flatnonzero(on_head)[:1]] = 1
    little = reprojected_faces(_textured(one), template(), False)
    assert little.views is None and "too little" in little.reason and 0 < little.observed < 0.01
    headless = replace(body(), regions={**body().regions, "head": torch.zeros_like(body().regions["head"])})
    inputs = replace(_textured(np.ones(len(points))), body=headless)
    assert "no head" in reprojected_faces(inputs, template(), True).reason
    bare = replace(template(), head=torch.zeros_like(template().head))
    assert "no head" in reprojected_faces(_textured(np.ones(len(points))), bare, True).reason


def test_two_sets_together_keep_their_weight_and_their_cameras():
    large, small = replace(faces(3), shares=torch.full((3,), 0.5)), _whole()
    both = join_faces(large, small)
    assert len(both) == 3 + len(small) and both.images.shape[2:] == (SIDE, SIDE)
    for part, own in ((slice(0, 3), large), (slice(3, None), small)):
        # What a view drawn at random is expected to weigh: the set's mean, as if it were alone.
        assert float(both.shares[part].sum() / len(both)) == pytest.approx(float(own.shares.mean()), rel=1e-5)
        height, width = own.images.shape[2:]
        assert torch.equal(both.images[part, :, :height, :width], own.images)
        assert torch.equal(both.cameras.Ks[part], own.cameras.Ks)
        assert float(both.weights[part].sum()) == float(own.weights.sum())


def test_a_view_counts_by_its_share():
    whole = faces(2)
    config = TINY_FULL.model_copy(update={"steps": 1})
    heads = []
    for share in (1.0, 0.5):
        inputs = replace(full_inputs(), sequences=(), faces=replace(whole, shares=torch.full((2,), share)))
        heads.append(train_full(inputs, config, AvatarInfo(body="test")).losses[0].head)
    assert heads[0] > 0 and heads[1] == pytest.approx(heads[0] / 2, rel=1e-5)


def test_the_cameras_of_a_generator_are_those_in_front_and_ours_go_all_round():
    centre = template().means[template().head].mean(0)
    assert float((face_cameras(template(), 32).centers - centre)[:, 1].max()) < 0
    assert float((face_cameras(template(), 32, AZIMUTHS).centers - centre)[:, 1].max()) > 0.5


class _Faces:
    """A role that paints every head green."""

    def __call__(self, references: Tensor, expressions: Tensor, cameras: Any, seed: int = 0) -> Tensor:
        return torch.tensor([0.0, 1.0, 0.0])[None, :, None, None].expand(len(cameras), 3, cameras.height, cameras.width)


class _Filled(Fills):
    def get(self, role: str) -> Any:
        return _Faces() if role == "face" else None


def _chosen(
    inputs: CoarseInputs, folder: Path, used: bool | None, fills: Fills | None = None, **knobs: Any
) -> ChosenFaces:
    given = {}
    if used is not None:
        (folder / "complete.json").write_text(json.dumps({"prior_used": used}), encoding="utf-8")
        given["complete"] = folder
    ctx = StageContext(given, {}, folder, lambda done, total, note="": None, fills=fills or Fills())
    expression = torch.zeros(len(inputs.frames), body().n_expressions)
    return choose_faces(inputs, template(), expression, FullConfig(**knobs), ctx)


def _seen_well() -> CoarseInputs:
    """Frames large enough for faces, and a texture of which the left half was seen."""
    textured = _textured(head()[3][:, 0] > 0)
    return replace(coarse_inputs(3, 96), atlas=textured.atlas, atlas_coverage=textured.atlas_coverage)


def test_the_summary_says_which_face_views_and_what_they_rest_on(tmp_path):
    inputs = _seen_well()
    both = _chosen(inputs, tmp_path, True, face_views="both")
    assert both.note.startswith("face views: 3 frames of the video and the head's own texture from ")
    made = reprojected_faces(inputs, template(), True)
    for words in (f"{made.observed:.0%} was observed", f"{made.filled:.0%} filled by the prior"):
        assert words in both.note and not words.startswith("0%")
    assert f"{1 - made.observed - made.filled:.0%} left alone" in both.note
    assert "0% filled by the prior" in _chosen(inputs, tmp_path, False, face_views="both").note
    alone = _chosen(inputs, tmp_path, True, face_views="reprojected")
    assert alone.note.startswith("face views: the head's own texture") and alone.views is not None
    observed = _chosen(inputs, tmp_path, True, face_views="observed")
    assert (
        observed.note.startswith("face views: 3 frames of the video; of the head ") and len(observed.views or ()) == 3
    )
    for words in (f"{made.observed:.0%} was observed", f"anything of the other {1 - made.observed:.0%}"):
        assert words in observed.note
    blind = replace(inputs, masks=torch.zeros_like(inputs.masks), atlas_coverage=torch.zeros(SIZE, SIZE))
    none = _chosen(blind, tmp_path, False, face_views="both")
    assert none.views is None and "never seen" in none.reason and "no part of the head" in none.reason


def test_without_the_stage_that_asks_a_prior_none_filled_anything(tmp_path):
    assert not prior_filled(StageContext({}, {}, tmp_path, lambda done, total, note="": None))


def test_without_a_head_path_no_face_view_is_made(tmp_path):
    for knobs in ({"switches": ABLATIONS["D"]}, {"weights": {"head": 0}}):
        off = _chosen(_seen_well(), tmp_path, True, **knobs)
        assert off.views is None and off.note == ""


def test_who_fills_the_role_face_is_asked_instead(tmp_path):
    green = _chosen(_seen_well(), tmp_path, True, _Filled(), face_views="both")
    assert 'by the role "face", from 3 frames' in green.note
    assert green.views is not None and float((green.views.images[:, 1] - 1).abs().max()) == 0
    assert torch.equal(green.views.shares, torch.ones(len(green.views)))


def test_the_picture_of_the_face_views_is_blue_where_nothing_counts(tmp_path):
    views = faces(2)
    weights = views.weights.clone()
    weights[:, :, :16] = 0
    draw_faces(replace(views, weights=weights), tmp_path / "faces.png")
    picture = read_png(tmp_path / "faces.png").astype(int)
    blue = (picture[..., 2] - picture[..., 0] > 80).sum()
    assert blue == 2 * 16 * 32


def test_observed_faces_weigh_less_than_a_generator():
    seen, _ = observed_faces(coarse_inputs(3, 96), template(), kinematics())
    assert seen is not None and torch.equal(seen.shares, torch.full((3,), 0.15))
