"""The viewer: what it explains, what a click finds, and that a browser shows it."""

from __future__ import annotations

import shutil
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ahoy_core.avatar import save_avatar
from ahoy_core.formats.images import read_png
from ahoy_core.view.explain import MODES, explained_colors, nearest_hit, source_frame
from tests.scene.things import avatar, body

viser = pytest.importorskip("viser", reason="needs the extra ahoy-avatars[view]")

from tasks.view import Viewed, Viewer, find  # noqa: E402


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def half_seen():
    """An avatar whose front was observed."""
    who = avatar()
    seen = (who.template.rotations[:, 1, 2] < 0).float()
    return replace(who, template=replace(who.template, observed=seen))


def test_colours_tell_observed_from_invented():
    who = half_seen()
    front = who.observed > 0.5
    for mode in MODES:
        assert explained_colors(who, mode).shape == (len(who), 3)
    shown = explained_colors(who, "observed")
    assert torch.unique(shown[front], dim=0).shape[0] == 1 and torch.unique(shown[~front], dim=0).shape[0] == 1
    assert float((shown[front][0] - shown[~front][0]).abs().max()) > 0.5


def test_a_ray_meets_the_nearest_gaussian_and_knows_the_frame_it_came_from():
    who = half_seen()
    posed = who.pose(body(), torch.zeros(body().n_joints, 3))
    chest = posed.means[(posed.means[:, 2] - 0.4).abs() < 0.1].mean(0)
    front = nearest_hit(
        posed.means, posed.covars, posed.opacities, chest - torch.tensor([0.0, 3, 0]), torch.tensor([0.0, 2, 0])
    )
    back = nearest_hit(
        posed.means, posed.covars, posed.opacities, chest + torch.tensor([0.0, 3, 0]), torch.tensor([0.0, -1, 0])
    )
    assert front is not None and back is not None
    assert float(posed.means[front, 1]) < float(chest[1]) < float(posed.means[back, 1])
    assert (
        nearest_hit(posed.means, posed.covars, posed.opacities, torch.tensor([0.0, -3, 9]), torch.tensor([0.0, 1, 0]))
        is None
    )
    frames = np.full((64, 64), -1, np.int32)
    u, v = who.uv[front].tolist()
    frames[int((1 - v) * 64), int(u * 64)] = 7
    assert source_frame(who, front, frames) == 7
    assert source_frame(who, front, np.full((64, 64), -1, np.int32)) is None


@pytest.fixture
def viewer():
    frames = np.zeros((3, 8, 8, 3), np.uint8)
    frames[2] = 200
    made = Viewer(
        Viewed({"coarse": half_seen(), "full": avatar()}, frames, np.full((32, 32), 2, np.int32)), free_port()
    )
    yield made
    made.close()


def test_motion_expression_mode_and_avatar_change_what_is_sent(viewer: Viewer):
    def sent() -> tuple[np.ndarray, np.ndarray]:
        viewer.refresh()
        return viewer.handle.centers.copy(), viewer.handle.rgbs.copy()

    viewer.playing.value = False
    still, plain = sent()
    viewer.name, viewer.mode = "coarse", "coverage"
    assert not np.array_equal(sent()[1], plain)
    viewer.motion_name, viewer.frame = "walk", 9
    assert np.abs(sent()[0] - still).max() > 0.05
    walking = sent()[0]
    viewer.expression[body().expression_names.index("jawOpen")] = 1.0
    assert 5e-3 < np.abs(sent()[0] - walking).max() < 0.1


def test_a_click_shows_the_frame_and_a_miss_says_so(viewer: Viewer):
    said, picture = viewer.pick((0.0, -3.0, 1.1), (0.0, 1.0, 0.0))
    assert "frame 2" in said and picture is not None and int(picture.max()) == 200
    said, picture = viewer.pick((0.0, -3.0, 9.0), (0.0, 1.0, 0.0))
    assert said == "Nothing there." and picture is None


def test_what_is_there_is_found(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="expected an avatar"):
        find(tmp_path)
    save_avatar(avatar(), tmp_path / "talk-1234")
    assert list(find(tmp_path).avatars) == ["talk-1234"]
    for made in ("early", "late"):
        save_avatar(avatar(), tmp_path / "store" / "artifacts" / "coarse" / "key" / "attempts" / made)
    assert list(find(tmp_path).avatars) == list(find(tmp_path / "talk-1234").avatars) == ["coarse", "talk-1234"]
    save_avatar(avatar(), tmp_path / "walk-1234")
    assert list(find(tmp_path).avatars) == ["talk-1234", "walk-1234"], "of two people, whose coarse one?"


def test_a_browser_shows_the_avatar(viewer: Viewer, tmp_path: Path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("needs Chromium (the Debian package chromium) to look at the page")
    shot = tmp_path / "page.png"
    flags = (
        "--headless",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--window-size=900,700",
    )
    url = f"http://127.0.0.1:{viewer.server.get_port()}"
    command = [
        chromium,
        *flags,
        f"--user-data-dir={tmp_path / 'profile'}",
        "--virtual-time-budget=20000",
        f"--screenshot={shot}",
        url,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert shot.is_file(), done.stderr[-500:]
    picture = read_png(shot)[..., :3].astype(int)
    # The dressed template's red top and blue trousers are nowhere else on the page.
    red = (picture[..., 0] > picture[..., 1] + 60) & (picture[..., 0] > picture[..., 2] + 60)
    blue = (picture[..., 2] > picture[..., 0] + 40) & (picture[..., 2] > picture[..., 1] + 20)
    assert red.sum() > 300 and blue.sum() > 300
