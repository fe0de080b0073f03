"""`ahoy render` and `ahoy export` on a saved avatar: plans, records, resuming, labels, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from ahoy_core.avatar import save_avatar
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.formats.cameras import CameraFileError
from ahoy_core.formats.glb import read_glb
from ahoy_core.formats.images import read_png
from ahoy_core.formats.npz import load_npz
from ahoy_core.formats.ply import read_ply, write_ply
from ahoy_core.formats.spz import read_spz
from ahoy_core.scene.cost import Rates
from ahoy_core.scene.plan import EFFECT_NAMES
from flows.cli import app
from tasks.render import RenderRequest, buried_share, prepare, render_clip
from tests.scene.things import avatar, body, puppet, room, wall

SMALL = ("--size", "48x48", "--frames", "3", "--fps", "8")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("avatar")
    save_avatar(avatar(), folder)
    return folder


def ahoy(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_a_walk_in_the_room_is_planned_rendered_and_recorded(tmp_path: Path, saved: Path):
    out = tmp_path / "v.mp4"
    result = ahoy("render", saved, "--motion", "walk", "--scene", "room", "--explain", "--out", out, *SMALL)
    assert result.exit_code == 0, result.output
    assert all(name in result.output for name in EFFECT_NAMES) and "hidden_share" in result.output
    record = json.loads((tmp_path / "v.mp4.json").read_text())
    assert [effect["name"] for effect in record["effects"]] == list(EFFECT_NAMES)
    assert record["rendered"] == record["frames"] == 3 and record["estimated_seconds"] > 0
    for effect in record["effects"]:
        assert (effect["calls"] > 0) is effect["on"], effect
        assert (effect["measured_seconds"] > 0) is effect["on"]
    with av.open(str(out)) as video:
        assert video.streams.video[0].frames == 3
        assert "Synthetic media" in video.metadata["comment"] and "a test" in video.metadata["description"]
    assert not (tmp_path / "v.mp4.frames").exists()


def request(saved: Path, **more: object) -> RenderRequest:
    return RenderRequest.model_validate(
        {"avatars": (str(saved),), "motions": ("walk",), "width": 32, "height": 32, "frames": 4, "fps": 8.0, **more}
    )


def test_a_killed_run_goes_on_where_it_stopped_and_another_request_starts_anew(tmp_path: Path, saved: Path):
    job = prepare(request(saved), Rates())
    folder = tmp_path / "frames"
    render_clip(job, folder)
    first = {path.name: (path.stat().st_mtime_ns, read_png(path)) for path in sorted(folder.glob("0*.png"))}
    assert len(first) == 4
    (folder / "00001.png").unlink()
    (folder / "00002.png").write_bytes((folder / "00002.png").read_bytes()[:50])  # as a kill or a full disk leaves it
    assert render_clip(job, folder)["rendered"] == 2
    for name, (when, picture) in first.items():
        assert np.array_equal(read_png(folder / name), picture)
        assert ((folder / name).stat().st_mtime_ns == when) is (name in ("00000.png", "00003.png"))
    assert render_clip(job, folder)["rendered"] == 0
    assert render_clip(prepare(request(saved, background=0.2), Rates()), folder)["rendered"] == 4


def test_frames_do_not_depend_on_how_many_are_rendered_at_a_time(tmp_path: Path, saved: Path):
    job = prepare(request(saved, scene="room"), Rates())
    for workers in (1, 3):
        render_clip(job, tmp_path / str(workers), workers=workers)
    for path in (tmp_path / "1").glob("0*.png"):
        assert np.array_equal(read_png(path), read_png(tmp_path / "3" / path.name))


def test_two_avatars_scenes_from_files_and_the_pull_are_taken(tmp_path: Path, saved: Path):
    scene = room()
    write_ply(tmp_path / "s.ply", scene.gaussians, sh_rest=scene.sh_rest)
    job = prepare(
        request(
            saved, avatars=(str(saved), str(saved)), places=((-0.5, 0.0, 0.0), (0.6, 0.5, 90.0)), pca=0.5,
            scene=str(tmp_path / "s.ply"), scene_up="z", scene_scale=1.0,
        ),
        Rates(),
    )  # fmt: skip
    assert len(job.puppets) == 2 and job.scene.ground is not None
    start = [p.motion.transl[0] + p.rest[0] for p in job.puppets]
    assert torch.allclose(start[0][:2], torch.tensor([-0.5, 0.0]), atol=1e-5)
    assert torch.allclose(start[1][:2], torch.tensor([0.6, 0.5]), atol=1e-5)
    assert len(job.pull) == 2 and len(job.pull[0]) == 4 and max(job.pull[0]) > 0


def test_an_avatar_inside_a_wall_is_noticed():
    assert buried_share(wall(0.0), puppet()) > 0.05
    assert buried_share(wall(1.0), puppet()) == 0.0
    assert buried_share(room(), puppet(at=(0.0, 0.0, 0.0))) < 0.01


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--effects", "sparkle"), "expected auto, all, none"),
        (("--size", "big"), "WIDTHxHEIGHT"),
        (("--at", "here"), "X,Y"),
        (("--motion", "jump"), "turn, wave, walk"),
        (("--scene", "nowhere.ply"), "nowhere.ply"),
        (("--camera", "1,2/x,y"), "x,y,z/x,y,z"),
        (("--shutter", "3"), "shutter"),
    ],
)
def test_bad_options_say_what_was_expected(tmp_path: Path, saved: Path, words: tuple[str, ...], message: str):
    result = ahoy("render", saved, "--out", tmp_path / "v.mp4", *SMALL, *words)
    assert result.exit_code == 2 and message in result.output, result.output
    assert not (tmp_path / "v.mp4").exists()


def test_a_missing_avatar_or_camera_file_is_refused(tmp_path: Path, saved: Path):
    assert ahoy("render", tmp_path, "--out", tmp_path / "v.mp4", *SMALL).exit_code == 2
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(CameraFileError):
        prepare(request(saved, camera=str(tmp_path / "transforms.json")), Rates())


@pytest.mark.parametrize("kind", ["ply", "spz", "glb"])
@pytest.mark.parametrize("posed", [False, True])
def test_exports_hold_the_avatar_upright_in_their_own_axes_with_flags_and_label(
    tmp_path: Path, saved: Path, kind: str, posed: bool
):
    out = tmp_path / f"a.{kind}"
    extra = ("--motion", "walk", "--frame", "5") if posed else ()
    result = ahoy("export", saved, "--format", kind, "--out", out, *extra)
    assert result.exit_code == 0, result.output
    who, flags = avatar(), (avatar().observed >= 0.5).tolist()
    if kind == "ply":
        ply = read_ply(out)
        gaussians, says = ply.gaussians, " ".join(ply.comments)
        assert (ply.extra["observed"] > 0.5).tolist() == flags
    elif kind == "glb":
        glb = read_glb(out)
        gaussians, says = glb.gaussians, json.dumps(glb.extras)
        assert (glb.extra["observed"] > 0.5).tolist() == flags
    else:
        gaussians, says = read_spz(out).gaussians, (tmp_path / "a.spz.json").read_text()
        assert [flag == "1" for flag in json.loads(says)["observed"]] == flags
    assert "Synthetic media" in says and "invented_share" in says and "a test" in says
    pose = canonical_pose(body()) if not posed else puppet("walk", frames=9, fps=24.0).motion.pose[5]
    truth = who.pose(body(), pose)
    x, y, z = (truth.means - truth.means.mean(0)).unbind(1)
    turned = torch.stack([x, -z, y] if kind == "ply" else [x, z, -y], 1)
    found = gaussians.means - gaussians.means.mean(0)
    assert float((found - turned).abs().max()) < 1e-3  # spz keeps a quarter of a millimetre
    tall = gaussians.covariances().diagonal(dim1=1, dim2=2).sum(1)
    assert torch.allclose(tall, truth.covars.diagonal(dim1=1, dim2=2).sum(1), rtol=0.15, atol=1e-7)


def test_the_rig_skins_to_the_same_pose_by_the_stated_formula(tmp_path: Path, saved: Path):
    """A reader that knows only the file: forward kinematics in numpy."""
    assert ahoy("export", saved, "--format", "npz", "--out", tmp_path / "rig.npz").exit_code == 0
    rig = load_npz(tmp_path / "rig.npz")
    motion = puppet("walk", frames=6, fps=12.0).motion
    pose, shift = motion.pose[4].double().numpy(), motion.transl[4].double().numpy()

    def world(angles: np.ndarray, at: np.ndarray) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        placed = np.zeros((len(angles), 4, 4))
        for joint, (omega, parent) in enumerate(zip(angles, rig["parents"], strict=True)):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_rotvec(omega).as_matrix()
            rest = rig["rest_joints"][joint].astype(float)
            local[:3, 3] = rest + at if parent < 0 else rest - rig["rest_joints"][parent]
            placed[joint] = local if parent < 0 else placed[parent] @ local
        return placed

    there = world(pose, shift) @ np.linalg.inv(world(rig["canonical_pose"].astype(float), np.zeros(3)))
    means = np.concatenate([rig["means"], np.ones((len(rig["means"]), 1))], 1)
    carried = np.einsum("nk,nkij,nj->ni", rig["skin_weights"], there[rig["skin_indices"]], means)[:, :3]
    truth = avatar().pose(body(), motion.pose[4], motion.transl[4]).means
    assert np.abs(carried - truth.numpy()).max() < 1e-4
    assert "Synthetic media" in str(rig["synthetic_media"]) and len(rig["observed"]) == len(rig["means"])


def test_frames_are_exported_one_file_each_and_bad_requests_are_refused(tmp_path: Path, saved: Path):
    result = ahoy("export", saved, "--format", "frames", "--motion", "wave", "--fps", "1", "--out", tmp_path / "seq")
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "seq").iterdir()) == ["00000.ply", "00001.ply", "00002.ply"]
    for words in (("--format", "fbx"), ("--axes", "up"), ("--motion", "turn", "--frame", "999")):
        assert ahoy("export", saved, "--out", tmp_path / "x.ply", *words).exit_code == 2
