"""Readers of data sets, on tiny trees of their true layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures import Capture, View, drive, read_dataset, true_joints
from ahoy_core.captures.capture import ANCHORS
from ahoy_core.captures.surface import TrueSurface
from ahoy_core.motion.smpl import SMPL_PELVIS
from tests.body import licensed
from tests.captures import trees


def _pixel(capture: Capture, camera: str, joint: str, moment: str = "view", row: int = 0) -> np.ndarray:
    """Where a true joint is in a camera, pixels."""
    body = load_packaged_body()
    joints = true_joints(capture.bodies[moment])[row]
    return capture.cameras[camera].project(joints[body.joint_names.index(joint)][None]).pixels[0, 0].numpy()


def test_our_captures_give_views_of_both_motions_and_the_input(tmp_path: Path) -> None:
    trees.ours(tmp_path, "one")
    trees.ours(tmp_path, "two")
    one, two = read_dataset(tmp_path)
    assert (one.name, two.name, one.kind, one.stands) == ("one", "two", "ours", True)
    assert {(view.camera, view.frame) for view in one.of("view")} == {
        ("front", 0),
        ("front", 2),
        ("back", 0),
        ("back", 2),
    }
    assert {view.frame for view in one.of("pose")} == {0, 1} and {view.frame for view in one.of("input")} == {0, 2}
    whole, seen = one.picture(View("view", "front", 2)), one.picture(View("input", "front", 2))
    assert whole.rgb[:, 20, 30].mul(255).round().tolist() == [152, 100, 20] and bool(whole.known.all())
    assert seen.alpha.sum() < whole.alpha.sum()  # what is hidden is in the truth, and not in the input
    assert abs(float(seen.rgb[0, 20, 30]) * 255 - 200) < 8


def test_the_true_body_of_our_captures_stands_where_its_camera_sees_it(tmp_path: Path) -> None:
    capture = read_dataset(trees.ours(tmp_path))[0]
    body = load_packaged_body()
    root = body(torch.zeros(1, body.n_joints, 3), body.default_betas[None], torch.zeros(1, 3)).joints[0, 0]
    x, y, z = (root + torch.tensor([0.1, 0.2, 0.0])).tolist()
    expected = [60 * x / (y + 3) + 32, 60 * (1 - z) / (y + 3) + 24]
    assert np.allclose(_pixel(capture, "front", "root"), expected, atol=1e-3)


def test_a_driven_body_of_another_shape_stands_where_the_true_joints_do(tmp_path: Path) -> None:
    capture, body = read_dataset(trees.ours(tmp_path))[0], load_packaged_body()
    truth = capture.bodies["view"]
    rows = [body.joint_names.index(name) for name in ANCHORS]
    pose, transl = drive(truth, body, body.default_betas)
    same = body(pose, body.default_betas[None], transl).joints
    assert torch.allclose(same, true_joints(truth), atol=1e-4)
    heavy = body.default_betas.clone()
    heavy[body.beta_names.index("weight")] = 1.0
    pose, transl = drive(truth, body, heavy)
    off = body(pose, heavy[None], transl).joints - true_joints(truth)
    assert off[:, rows].mean(1).abs().max() < 1e-4  # no shift of all of them would be nearer
    assert off[:, 0].norm(dim=1).min() > 1e-3  # the root is no anchor
    assert torch.allclose(pose[:, 0, 2], 0.1 * torch.arange(4), atol=1e-5)


def test_behave_masks_its_objects_turns_its_world_and_asks_for_blurred_faces(tmp_path: Path) -> None:
    (capture,) = read_dataset(trees.behave(tmp_path))
    assert capture.blur_faces and capture.input_camera == "k1" and not capture.stands
    assert {view.frame for view in capture.of("view")} == {0, 1, 2} and {view.frame for view in capture.of("pose")} == {
        3
    }
    assert len(capture.frames()) == 3  # the unseen poses are not in the input
    picture = capture.picture(View("view", "k2", 1))
    assert not picture.known[34, 30] and picture.known[20, 30]  # the object is in front of the person's legs
    assert picture.known[2, 2] and picture.alpha[20, 30] > 0.9
    for camera, shift in (("k1", 0.0), ("k2", 0.5)):
        expected = [60 * (0.2 - shift) / 2.5 + 32, 60 * 0.1 / 2.5 + 24]
        assert np.allclose(_pixel(capture, camera, "root"), expected, atol=1e-3)
    joints = true_joints(capture.bodies["view"])[0]
    above = _pixel(capture, "k1", "head")[1] < _pixel(capture, "k1", "root")[1]
    assert above and torch.isfinite(joints).all()  # the person is not upside down


def test_behave_without_the_plain_parameters_is_refused_and_pickles_are_never_read(tmp_path: Path) -> None:
    root = trees.behave(tmp_path)
    (root / "sequences" / "Date01_Sub01_box" / "smpl_fit_all.npz").unlink()
    with pytest.raises(ValueError, match="never read"):
        read_dataset(root)


@pytest.mark.parametrize("as_json", [False, True])
def test_multiview_folders_put_the_person_before_their_cameras(tmp_path: Path, as_json: bool) -> None:
    (capture,) = read_dataset(trees.multiview(tmp_path, as_json=as_json))
    assert capture.input_camera == "01" and set(capture.cameras) == {"01", "02"}
    assert [view.frame for view in capture.of("input")] == [0, 1, 2]
    picture = capture.picture(View("pose", "02", 3))
    assert picture.alpha[20, 30] == 1 and picture.alpha[2, 2] == 0  # labels of parts, not a faint alpha
    x, z, y = SMPL_PELVIS[0], SMPL_PELVIS[1], -SMPL_PELVIS[2]  # Rh turns SMPL's y up into the world's z up
    for camera, shift in (("01", 0.0), ("02", 0.5)):
        expected = [60 * (x - shift) / (y + 3) + 32, 60 * (1 - z) / (y + 3) + 24]
        assert np.allclose(_pixel(capture, camera, "root"), expected, atol=1e-3)


def test_the_bodys_own_file_gives_the_true_pelvis(tmp_path: Path) -> None:
    model = licensed.write(tmp_path, "smpl")
    capture = read_dataset(trees.multiview(tmp_path / "m"), truth_body=model)[0]
    rough = read_dataset(tmp_path / "m" / "seq")[0]
    assert not capture.notes and "average body" in rough.notes[0]
    moved = (capture.bodies["view"].pose.root - rough.bodies["view"].pose.root).norm(dim=1)
    assert (moved > 1e-3).all() and (moved < 0.5).all()


def test_plain_videos_are_captures_without_true_pictures(tmp_path: Path) -> None:
    source = trees.ours(tmp_path / "x") / "front.mp4"
    (tmp_path / "clips").mkdir()
    for name in ("one.mp4", "two.mp4"):
        (tmp_path / "clips" / name).write_bytes(source.read_bytes())
    one, two = read_dataset(tmp_path / "clips")
    assert (one.name, two.name, one.views, one.kind) == ("one", "two", (), "videos")
    assert read_dataset(tmp_path / "clips" / "two.mp4")[0].name == "two"


def test_a_folder_of_nothing_known_is_refused_with_the_layouts(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"docs/metrics\.md"):
        read_dataset(tmp_path)
    with pytest.raises(ValueError, match="nothing there"):
        read_dataset(tmp_path / "gone")
    with pytest.raises(ValueError, match="kind of data set"):
        read_dataset(tmp_path, "films")


def test_surface_that_the_masks_hide_was_never_observed(tmp_path: Path) -> None:
    capture = read_dataset(trees.ours(tmp_path))[0]
    surface, camera = TrueSurface(capture), capture.cameras["front"]
    body = load_packaged_body()
    assert 0.02 < surface.seen.mean() < 0.6
    # Seen from behind, next to nothing was observed; from the front, what the mask shows was.
    front = surface.look("view", 0, camera).observed
    back = surface.look("view", 0, capture.cameras["back"]).observed
    inside = torch.from_numpy(trees.person_mask(hidden_rows=8) > 0)
    assert front[inside].float().mean() > back[inside].float().mean() + 0.2
    normals = np.cross(*(np.diff(body.mean_vertices.numpy()[body.faces.numpy()], axis=1)[:, i] for i in (0, 1)))
    assert surface.seen[normals[:, 1] < 0].mean() > 4 * surface.seen[normals[:, 1] > 0].mean()  # the front faces -y
