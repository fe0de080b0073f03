"""Captures of our own making: pictures, cameras and bodies agree, and the evaluation's reader takes them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.captures.capture import Capture, View, drive
from ahoy_core.captures.ours import read_ours

FRAMES = 7

pytestmark = [pytest.mark.shared, pytest.mark.slow]


@pytest.fixture(scope="module")
def capture(shared_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    pytest.importorskip("anny", reason="needs the extra ahoy-avatars[train]")
    from benchmarks.rendered.captures import write_capture
    from benchmarks.rendered.people import Wardrobe

    folder = tmp_path_factory.mktemp("captures") / "v1"
    write_capture(folder, 506_000, Wardrobe(shared_dir / "assets" / "makehuman", load_packaged_body()), FRAMES)
    return read_ours(folder)


def test_there_is_a_picture_of_every_camera_at_every_moment(capture: Capture):
    assert sorted(capture.cameras) == ["back", "front", "left", "right"]
    assert {view.frame for view in capture.of("view")} == {0, 6}
    assert len(capture.of("pose")) == 4 * 8
    assert len(capture.of("input")) == 2


@pytest.mark.parametrize("moment", ["view", "pose"])
def test_true_bodies_stand_in_their_pictures(capture: Capture, moment: str):
    """Bare bodies lie within silhouettes of who wears clothes, in every camera."""
    body, truth = load_packaged_body(), capture.bodies[moment]
    betas = truth.betas
    assert betas is not None
    pose, transl = drive(truth, body, betas)
    for view in capture.of(moment):  # type: ignore[arg-type]
        row = truth.row(view.frame)
        vertices = body(pose[row][None], betas[None], transl[row][None]).vertices[0]
        points = capture.cameras[view.camera].project(vertices).pixels[0]
        alpha = capture.picture(view).alpha
        column, line = (points[:, i].floor().long() for i in (0, 1))
        within = (column >= 0) & (column < alpha.shape[1]) & (line >= 0) & (line < alpha.shape[0])
        near = torch.nn.functional.max_pool2d(alpha[None, None], 3, 1, 1)[0, 0]
        assert within.any()
        assert (near[line[within], column[within]] > 0.1).double().mean() > 0.98


def test_the_true_front_is_what_the_input_shows(capture: Capture):
    """Same light and same place, up to the video's noise; who is hidden in the input is whole in the truth."""
    for shown in capture.of("input"):
        seen, true = capture.picture(shown), capture.picture(View("view", "front", shown.frame))
        both = (seen.alpha > 0.98) & (true.alpha > 0.98)
        assert both.sum() > 100
        assert (true.alpha - seen.alpha > 0.5).sum() > 100
        assert not (seen.alpha - true.alpha > 0.1).any()
        assert (seen.rgb - true.rgb)[:, both].abs().mean() < 0.03
