"""Built-in baselines and what other systems are given."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ahoy_core.formats.npz import save_npz
from tasks.evaluation.baseline_inputs import export_inputs, first_occluded
from tasks.evaluation.baselines import MeshRenderer
from tasks.evaluation.renderers import Driver
from tasks.evaluation.truths import Truths
from tests.evaluation import people

SIDE = 64


def _atlas(seen: bool) -> dict[str, np.ndarray]:
    red, blue = (np.full((SIDE, SIDE, 3), color, np.uint8) for color in ((200, 20, 20), (20, 20, 200)))
    coverage = np.full((SIDE, SIDE), 1.0 if seen else 0.0, np.float32)
    return {"observed_rgb": red, "filled_rgb": blue, "coverage": coverage, "chart": np.ones((SIDE, SIDE), bool)}


def _middle(completed: bool, seen: bool, tmp_path: Path) -> tuple[np.ndarray, float]:
    """Mean colour where the mesh is, and the share of it that is within the true silhouette."""
    capture = people.capture(tmp_path)
    driver = Driver(people.body(), people.body().default_betas, capture, None)
    renderer = MeshRenderer(_atlas(seen), completed, people.body(), driver)
    truths = Truths(capture, None, people.SIZE, None)
    shot = truths.shot("novel-view-gt", truths.views("novel-view-gt")[0][0])
    assert shot is not None
    made = renderer(shot)
    assert made.rgb.shape == shot.truth.rgb.shape and made.alpha is not None
    inside, true = made.alpha > 0.5, shot.truth.alpha > 0.5
    within = float((inside & true).sum() / inside.sum()) if inside.sum() > 100 else 0.0
    return made.rgb[:, made.alpha > 0.99].mean(1).numpy() * 255, within


def test_the_mesh_shows_what_was_seen_grey_elsewhere_or_what_was_filled(tmp_path: Path) -> None:
    seen, within = _middle(completed=False, seen=True, tmp_path=tmp_path)
    assert np.allclose(seen, (200, 20, 20), atol=2)
    assert within > 0.97  # the same body and pose; the Gaussians stand well beyond the skin
    assert np.allclose(_middle(completed=False, seen=False, tmp_path=tmp_path)[0], 128, atol=2)
    assert np.allclose(_middle(completed=True, seen=False, tmp_path=tmp_path)[0], (20, 20, 200), atol=2)


def test_the_first_occluded_frame_is_the_first_usable_one_that_hides_enough() -> None:
    hidden = np.array([0.0, 0.3, 0.02, 0.2, 0.4])
    assert first_occluded(hidden, np.array([1, 0, 1, 1, 1], bool)) == 3
    assert first_occluded(np.array([0.0, 0.01, 0.0]), np.ones(3, bool)) == 1
    with pytest.raises(ValueError, match="fitted body"):
        first_occluded(hidden, np.zeros(5, bool))


def test_other_systems_get_the_frame_with_its_mask_and_the_canonical_front(tmp_path: Path) -> None:
    ingest, perceive, texture = (tmp_path / name for name in ("ingest", "perceive", "texture"))
    for folder in (ingest, perceive, texture):
        folder.mkdir()
    frames = np.stack([np.full((4, 6, 3), 10 * t, np.uint8) for t in range(3)])
    save_npz(ingest / "frames.npz", {"frames": frames, "index": np.array([0, 5, 9])})
    visible = np.full((3, 4, 6), 255, np.uint8)
    save_npz(perceive / "masks.npz", {"visible": visible, "occluded": np.array([0.0, 0.5, 0.6], np.float32)})
    fit = {"used": np.ones(3, bool), "K": np.eye(3, dtype=np.float32), "viewmat": np.eye(4, dtype=np.float32)}
    save_npz(perceive / "body.npz", fit)
    views = np.zeros((4, 8, 5, 4), np.uint8)
    views[0] = (1, 2, 3, 255)
    cameras = {
        "viewmats": np.tile(np.eye(4, dtype=np.float32), (4, 1, 1)),
        "Ks": np.tile(np.eye(3, dtype="f4"), (4, 1, 1)),
    }
    save_npz(texture / "canonical.npz", {"views": views, **cameras})
    paths = export_inputs(ingest, perceive, texture, tmp_path / "out")
    frame, front = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths[:2])
    assert frame.shape == (4, 6, 4) and frame[0, 0].tolist() == [10, 10, 10, 255]
    assert front[0, 0].tolist() == [3, 2, 1, 255]  # BGRA as OpenCV reads it
    assert json.loads(paths[2].read_text())["first occluded frame"]["frame"] == 5
