"""The texture stage on a path-traced capture with the true pose, camera and mask."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.captures import read_dataset
from ahoy_core.captures.fit import read_clip, true_fit
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface, interpolate_uv
from ahoy_core.texture.texels import pad_charts, sample_atlas
from ahoy_core.texture.texture import Texture, build_texture


@pytest.fixture(scope="module")
def capture(shared_dir: Path) -> tuple[Path, PackagedBody, dict[str, np.ndarray], Texture]:
    (truth,) = read_dataset(shared_dir / "captures" / "a")
    clip = read_clip(truth)
    body = load_packaged_body()
    fit = true_fit(truth, body)
    config = TextureConfig(atlas_size=256, frame_stride=8, canonical_height=256, canonical_width=192)
    return truth.folder, body, fit, build_texture(clip.frames, clip.visible, fit, body, config)


@pytest.mark.shared
def test_seen_texels_show_the_true_person(capture: tuple) -> None:
    folder, body, fit, texture = capture
    surface = Surface.of(body)
    seen = pad_charts((texture.coverage > 0).astype(np.float32), texture.chart)
    errors = []
    for t in (0, 24):
        truth = cv2.cvtColor(cv2.imread(str(folder / "gt" / f"front_{t:03d}.png"), -1), cv2.COLOR_BGRA2RGBA)
        posed = body(*(torch.from_numpy(a)[None] for a in (fit["pose"][t], fit["betas"], fit["transl"][t]))).vertices[0]
        hits = hit_map(Caster(to_camera(posed.numpy(), fit["viewmat"]), surface.faces), fit["K"], 256, 256)
        where = (hits.face >= 0) & (truth[..., 3] > 250)
        uv = interpolate_uv(surface, hits.face[where], hits.bary[where])
        known = sample_atlas(seen, uv) > 0.9
        errors.append(np.abs(sample_atlas(texture.filled_rgb, uv) - truth[where][:, :3])[known])
    # 12.5 measured, of which 7 are the capture's own noise; the stripes of the shirt put any wrong place above 25.
    assert np.concatenate(errors).mean() < 16


@pytest.mark.shared
def test_shirt_jeans_and_face_come_to_their_places(capture: tuple) -> None:
    _, _, _, texture = capture
    front = texture.partial[..., :3].astype(float)
    known = texture.partial[..., 3] == 255
    rows = np.flatnonzero((texture.views[0, ..., 3] > 0).any(axis=1))
    top, height = rows[0], rows[-1] - rows[0]

    def band(low: float, high: float, columns: slice) -> np.ndarray:
        box = np.zeros_like(known)
        box[top + int(low * height) : top + int(high * height), columns] = True
        assert (box & known).sum() > 30
        return np.median(front[box & known], axis=0)

    middle = slice(86, 106)
    face, shirt, jeans = band(0.05, 0.1, middle), band(0.22, 0.42, middle), band(0.5, 0.6, slice(60, 132))
    assert face[0] > 150 and face[0] > face[2] + 30
    assert shirt[0] > shirt[2] + 10 and shirt.max() < 150
    assert jeans[2] > jeans[0] + 10


@pytest.mark.shared
def test_the_back_is_not_claimed_as_observed(capture: tuple) -> None:
    _, _, _, texture = capture
    back = texture.view_coverage[2][texture.views[2, ..., 3] > 250]
    assert back.mean() < 0.1 * 255
    assert 0.15 < texture.notes["observed_share"] < 0.45
