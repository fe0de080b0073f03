"""`ahoy run` from the video to the files a person opens."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import torch

from ahoy_core.avatar.files import load_avatar
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.formats.ply import read_ply
from ahoy_core.formats.video import read_frames
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.replaying import replay
from tasks.stage import Run
from tasks.texture import TEXTURE
from tests.e2e.conftest import SmallRun, ahoy

STAGES = ["ingest", "perceive", "texture", "coarse", "avatar", "animate", "report"]


def _rows(run: SmallRun, table: str) -> list[dict]:
    return Tables(ArtifactStore(run.out / "store")).read(table).to_pylist()


def test_the_paths_of_avatar_video_and_report_are_printed_and_are_there(small_run: SmallRun) -> None:
    for name in ("avatar.ply", "avatar.safetensors", "turntable.mp4", "motion.mp4", "report.html"):
        assert re.search(rf"{re.escape(name)}\s+\S", small_run.output), small_run.output
        assert (small_run.folder / name).stat().st_size > 0


def test_a_second_run_finds_every_stage_in_the_store(small_run: SmallRun) -> None:
    output = small_run.again().output
    assert [line.split()[0] for line in output.splitlines() if "found in the store" in line] == STAGES


def test_a_changed_knob_reruns_its_stage_and_what_depends_on_it(small_run: SmallRun) -> None:
    output = small_run.again(knobs=["animate.motion_frames=4"]).output
    found = [line.split()[0] for line in output.splitlines() if "found in the store" in line]
    assert found == STAGES[:5]


def test_the_report_is_one_file_that_asks_the_network_for_nothing(small_run: SmallRun) -> None:
    page = (small_run.folder / "report.html").read_text()
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)
    for expected in (
        "Synthetic media",
        "was invented",
        "turntable",
        "switched off (prior=none)",
        "The full avatar",
        "ablation B2",
        "peak memory",
        "Anny",
        "mediapipe",
    ):
        assert expected in page, expected
    assert page.count("data:image/png") >= 6 and page.count("data:video/mp4") == 2


def test_the_ply_holds_the_whole_avatar_with_what_was_observed(small_run: SmallRun) -> None:
    cloud = read_ply(small_run.folder / "avatar.ply")
    avatar = load_avatar(small_run.folder)
    assert len(cloud.gaussians.means) == len(avatar)
    assert torch.allclose(cloud.gaussians.means, avatar.means, atol=1e-6)


def test_the_avatar_can_be_loaded_and_posed_again(small_run: SmallRun) -> None:
    avatar, body = load_avatar(small_run.folder), load_packaged_body()
    pose = canonical_pose(body)
    assert torch.allclose(avatar.pose(body, pose).means, avatar.means, atol=1e-4)
    turned = pose.clone()
    turned[0] = torch.tensor([0.0, 0.0, torch.pi])
    means = avatar.pose(body, turned).means
    assert torch.isfinite(means).all() and (means[:, 0] + avatar.means[:, 0]).abs().max() < 0.5


def test_the_turntable_shows_somebody_in_every_frame(small_run: SmallRun) -> None:
    with av.open(small_run.folder / "turntable.mp4") as container:
        assert "Synthetic media" in container.metadata["comment"]
    frames = [frame.image for frame in read_frames(small_run.folder / "turntable.mp4")]
    assert len(frames) == 8
    for frame in frames:
        differs = np.abs(frame.astype(int) - 128).max(-1) > 24
        assert 0.05 < differs.mean() < 0.8


def test_the_tables_hold_the_bill_the_frames_and_the_scores(small_run: SmallRun) -> None:
    rows = sorted(_rows(small_run, "stages"), key=lambda row: row["started_at"])
    made = {row["stage"]: row for row in rows if row["state"] == "done" and row["run_id"] == rows[0]["run_id"]}
    assert set(made) == set(STAGES)
    assert all(row["cpu_s"] > 0 and row["peak_rss_mb"] > 0 for row in made.values())
    frames = [row for row in _rows(small_run, "frames") if row["used"]]
    assert frames and {len(row["transl"]) for row in frames} == {3}


def test_the_report_has_the_bill_beside_its_prediction(small_run: SmallRun) -> None:
    page = (small_run.folder / "report.html").read_text()
    assert "predicted CPU seconds" in page and "times as many" in page


def test_a_stage_replayed_alone_gives_what_it_gave(small_run: SmallRun) -> None:
    result = ahoy("replay", str(small_run.folder), "texture")
    assert result.exit_code == 0, result.output
    assert result.output.count("the same, bit for bit") == 5 and "not as it was" not in result.output
    refused = ahoy("replay", str(small_run.folder), "ingest")
    assert refused.exit_code == 2 and "--video" in refused.output


def test_a_replay_that_differs_says_where_and_what_has_changed_since(small_run: SmallRun, tmp_path: Path) -> None:
    store = ArtifactStore(small_run.out / "store")
    row = next(row for row in Tables(store).read("stages").to_pylist() if row["stage"] == "texture" and row["key"])
    manifest = store.lookup(row["key"], stage="texture")
    assert manifest is not None
    run = Run(store, Tables(store), "replay", row["video_id"], "r", None)  # type: ignore[arg-type]
    wider = replace(manifest, stage_version=1, config={**manifest.config, "atlas_size": 64})
    done = replay(TEXTURE, wider, run, tmp_path, lambda done, total, note="": None)
    said = {one.name: one.said for one in done.files}
    assert not done.same and "coverage: (96, 96) then, (64, 64) now" in said["atlas.npz"]
    assert done.changed == (f"version 1 of the stage then, {TEXTURE.version} now",)


def test_stages_not_asked_for_are_skipped_with_the_reason(small_run: SmallRun) -> None:
    output = small_run.again("--stages", "texture").output
    assert re.search(r"coarse\s+skipped: not asked for", output)


def test_bad_settings_are_refused_with_what_is_known(small_run: SmallRun) -> None:
    for option, expected in (
        (["--set", "coarse.stepz=3"], "coarse.steps"),
        (["--set", "coarse.steps=-1"], "greater than or equal to 1"),
        (["--preset", "best"], "'draft', 'standard' or 'high'"),
        (["--stages", "fly"], "ingest, perceive"),
    ):
        result = small_run.again(*option)
        assert result.exit_code == 2 and expected in result.output.replace("\n", " "), result.output


def test_what_is_not_a_video_is_refused_in_one_line(tmp_path: Path) -> None:
    note = tmp_path / "note.mp4"
    note.write_text("not a video")
    result = ahoy("run", str(note), "--out", str(tmp_path / "out"))
    assert result.exit_code == 2 and "Traceback" not in result.output and "error:" in result.output
    result = ahoy("run", str(tmp_path / "gone.mp4"), "--out", str(tmp_path / "out"))
    assert result.exit_code == 2 and "not there" in result.output
