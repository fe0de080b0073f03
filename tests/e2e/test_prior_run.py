"""A run that may ask a prior: a prior that loses changes nothing, one that is believed reaches the avatar."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from storage_schema.manifest import Manifest
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.hallucinate import read_supervision
from tasks.motions import read_sequence
from tests.e2e.conftest import SmallRun
from tests.prior.conftest import embedded_folder  # noqa: F401  (a session fixture)

SHORT = ("complete.regions=1", "identity.steps=2", "identity.frames=2", "motions.limit=2")
BELIEVED = ("complete.believe=prior", *SHORT)


def _latest(run: SmallRun) -> list[dict[str, Any]]:
    rows = Tables(ArtifactStore(run.out / "store")).read("stages").to_pylist()
    last = max(rows, key=lambda row: row["started_at"])["run_id"]
    return sorted((row for row in rows if row["run_id"] == last), key=lambda row: row["seq"])


def _manifest(run: SmallRun, row: dict[str, Any]) -> tuple[Manifest, Path]:
    store = ArtifactStore(run.out / "store")
    manifest = store.lookup(row["key"], stage=row["stage"])
    assert manifest is not None
    return manifest, store.fetch(manifest)


def test_without_a_prior_its_stages_are_skipped_with_the_reason(small_run: SmallRun) -> None:
    small_run.again(knobs=["prior=none"])
    skipped = {row["stage"]: row["reason"] for row in _latest(small_run) if row["state"] == "skipped"}
    assert skipped["complete"] == "switched off (prior=none)"
    assert set(skipped) == {"complete", "identity", "motions", "hallucinate"}
    page = (small_run.folder / "report.html").read_text()
    assert "switched off (prior=none)" in page


def test_the_packaged_prior_is_asked_where_a_run_says_nothing_else(small_run: SmallRun) -> None:
    small_run.again(knobs=["prior=packaged", *SHORT])
    complete = next(row for row in _latest(small_run) if row["stage"] == "complete")
    manifest, folder = _manifest(small_run, complete)
    assert "embedded prior" in manifest.roles["video"]["name"]
    errors = json.loads((folder / "complete.json").read_text())["errors"]
    assert set(errors) == {"symmetric fill", "prior, clean-up", "prior, inversion"}


def test_a_prior_that_loses_its_self_check_changes_nothing(small_run: SmallRun, embedded_folder: Path) -> None:  # noqa: F811
    small_run.again(knobs=["prior=none"])
    before = {row["stage"]: row["key"] for row in _latest(small_run)}
    output = small_run.again(knobs=[f"prior={embedded_folder}", *SHORT]).output
    rows = {row["stage"]: row for row in _latest(small_run)}
    assert "did not win this video's self-check" in rows["identity"]["reason"], output
    manifest, folder = _manifest(small_run, rows["complete"])
    found = json.loads((folder / "complete.json").read_text())
    assert found["winner"] == "symmetric fill" and found["confidence"] == min(found["errors"].values())
    assert manifest.roles["video"]["weights_sha256"]
    texture = _manifest(small_run, rows["texture"])[1]
    for name in ("atlas.npz", "canonical.npz"):
        assert (folder / name).read_bytes() == (texture / name).read_bytes()
    assert {rows[stage]["state"] for stage in ("identity", "motions", "hallucinate")} == {"skipped"}
    store = ArtifactStore(small_run.out / "store")
    for stage in ("coarse", "avatar"):
        then, now = store.lookup(before[stage], stage=stage), store.lookup(rows[stage]["key"], stage=stage)
        assert then is not None and now is not None
        assert then.blob("avatar.safetensors").sha256 == now.blob("avatar.safetensors").sha256, stage


@pytest.fixture(scope="module")
def believed(small_run: SmallRun, embedded_folder: Path) -> tuple[SmallRun, list[dict[str, Any]]]:  # noqa: F811
    result = small_run.again(knobs=[f"prior={embedded_folder}", *BELIEVED])
    assert result.exit_code == 0, result.output
    return small_run, _latest(small_run)


def test_a_believed_prior_recolours_only_what_the_video_never_showed(
    believed: tuple[SmallRun, list[dict[str, Any]]],
) -> None:
    run, rows = believed
    folders = {row["stage"]: _manifest(run, row)[1] for row in rows if row["stage"] in ("texture", "complete")}
    before, after = (np.load(folders[stage] / "atlas.npz") for stage in ("texture", "complete"))
    seen = before["coverage"] > 0
    assert np.array_equal(before["filled_rgb"][seen], after["filled_rgb"][seen])
    unseen = before["chart"] & ~seen
    assert not np.array_equal(before["filled_rgb"][unseen], after["filled_rgb"][unseen])
    assert np.array_equal(before["observed_rgb"], after["observed_rgb"])


def test_each_planned_motion_is_an_artifact_with_what_rendered_it(
    believed: tuple[SmallRun, list[dict[str, Any]]],
) -> None:
    run, rows = believed
    plan, folder = next(_manifest(run, row) for row in rows if row["stage"] == "motions")
    made = [_manifest(run, row) for row in rows if row["stage"] == "hallucinate"]
    assert [manifest.config["item"] for manifest, _ in made] == plan.summary["items"] and len(made) == 2
    for manifest, place in made:
        planned, sequence = read_sequence(folder, manifest.config["item"]), read_supervision(place)
        for name in ("map_pose", "pose", "transl"):
            assert torch.equal(getattr(planned, name), getattr(sequence, name)), name
        assert torch.equal(planned.cameras.viewmats, sequence.cameras.viewmats) and sequence.factor == 2
        torch.testing.assert_close(sequence.cameras.Ks[:, :2], 2 * planned.cameras.Ks[:, :2])
        assert sequence.kind == planned.kind and sequence.alphas is not None
        assert 0.05 < float(sequence.alphas.mean()) < 0.6 and 0 < float(sequence.coverage.mean()) < 0.6


def test_the_avatar_is_supervised_by_them_and_the_report_shows_them(
    believed: tuple[SmallRun, list[dict[str, Any]]],
) -> None:
    run, rows = believed
    avatar, _ = next(_manifest(run, row) for row in rows if row["stage"] == "avatar")
    assert any("supervised by 2 hallucinated sequences" in note for note in avatar.summary["notes"])
    assert sum(name.startswith("hallucinate/") for name in avatar.inputs) == 2
    page = (run.folder / "report.html").read_text()
    for expected in ("Prior or symmetric fill", "The subject in the prior", "Hallucinated: ", "colour error of"):
        assert expected in page, expected
    assert "What was not done" not in page


def test_a_folder_that_holds_no_prior_is_named(small_run: SmallRun, tmp_path: Path) -> None:
    result = small_run.again(knobs=[f"prior={tmp_path}"])
    assert result.exit_code != 0
    assert "model_index.json" in result.output + str(result.exception)
