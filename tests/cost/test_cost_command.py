"""`ahoy cost` on a tiny capture: the real texture stage on the true body, through the real store."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from ahoy_core.cost.sweep import read_jsonl
from ahoy_core.formats.npz import load_npz
from flows.cli import app
from flows.replay_cli import find_made
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tests.captures import trees

SMALL = [
    word
    for knob in ("texture.canonical_height=32", "texture.canonical_width=24", "texture.atlas_size=32")
    for word in ("--set", knob)
]


def _ahoy(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def _cost(root: Path, *more: str) -> Result:
    return _ahoy(
        "cost", "texture", "--dataset", str(root / "data"), "--out", str(root / "out"), "--repeats", "2",
        "--knob", "texture.atlas_size=24,32,7", "--knob", "texture.fill=symmetric,both", *SMALL, *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    root = tmp_path_factory.mktemp("cost")
    trees.ours(root / "data", "one")
    result = _cost(root, "--measured", str(root / "set.json"))
    assert result.exit_code == 0, result.output
    return root, result


def test_rows_hold_errors_times_and_memory_and_what_failed_is_an_omission(swept: tuple[Path, Result]) -> None:
    root, _ = swept
    rows = {(row.sweep, json.dumps(dict(row.setting))): row for row in read_jsonl(root / "out" / "rows.jsonl")}
    assert len(rows) == 5
    failed = rows["texture.atlas_size", '{"atlas_size": 7}']
    assert "greater than or equal to 16" in failed.failed and failed.cpu_s is None
    for row in rows.values():
        if row is not failed:
            assert row.errors["texel_l1"] > 0 and row.capture == "one" and row.knobs["clip.frames"] == trees.COUNT
            assert row.cpu_s is not None and row.cpu_s.repeats == 2 and row.cpu_s.median > 0
            assert row.peak_mb is not None and row.peak_mb.median > 50
    # The base's atlas is 32: the sweep of the fill finds that row under the first knob, and needs no run of its own.
    base, again = rows["texture.atlas_size", '{"atlas_size": 32}'], rows["texture.fill", '{"fill": "both"}']
    assert (base.made_of, base.cpu_s) == (again.made_of, again.cpu_s)


def test_page_table_diagram_and_set_are_written(swept: tuple[Path, Result]) -> None:
    root, _ = swept
    page = (root / "out" / "cost.md").read_text()
    assert "| atlas_size | 24 |" in page and "Pareto" in page and "preset draft" in page
    assert (
        "texture.atlas_size = 7, capture one: ValidationError" in page and "perceive.passes: not measured yet" in page
    )
    assert (root / "out" / "cost-texture.png").stat().st_size > 5000
    table = pq.read_table(root / "out" / "rows.parquet").to_pylist()
    assert len(table) == 5 and {"cpu_s_median", "error_texel_l1", "failed"} <= set(table[0])
    said = json.loads((root / "set.json").read_text())
    assert len(said["rows"]) == 4 and said["unit_cpu_s"] > 0


def test_a_second_sweep_measures_what_is_not_there_alone(swept: tuple[Path, Result]) -> None:
    root, _ = swept
    before = (root / "out" / "rows.jsonl").read_text().splitlines()
    again = _cost(root, "--knob", "texture.frame_stride=1")
    assert again.exit_code == 0, again.output
    assert (
        "texture.atlas_size: 1 of 3" in again.output and "texture.fill: 0 of 2" in again.output
    )  # a failure is retried
    after = (root / "out" / "rows.jsonl").read_text().splitlines()
    kept = [line for line in before if json.loads(line)["failed"] == ""]
    assert set(kept) <= set(after)


def test_without_a_data_set_the_page_is_made_of_the_rows(swept: tuple[Path, Result], tmp_path: Path) -> None:
    root, _ = swept
    result = _ahoy("cost", "--out", str(root / "out"), "--page", str(tmp_path / "docs" / "cost.md"))
    assert result.exit_code == 0 and (tmp_path / "docs" / "cost-texture.png").is_file()
    for options, expected in (
        (["--out", str(tmp_path / "none")], "got none"),
        (["fly", "--dataset", str(root / "data"), "--out", str(root / "out")], "expected stages among"),
        (["--dataset", str(root / "data"), "--out", str(root / "out"), "--knob", "fly.high=1"], "STAGE.KNOB"),
    ):
        refused = _ahoy("cost", *options)
        assert refused.exit_code == 2 and expected in refused.output.replace("\n", " "), refused.output


def test_the_truth_stands_in_perceptions_place_with_masks_and_bodies(swept: tuple[Path, Result]) -> None:
    store = ArtifactStore(swept[0] / "out" / "store")
    row = next(row for row in Tables(store).read("stages").to_pylist() if row["stage"] == "truth")
    manifest = store.lookup(row["key"], stage="truth")
    assert manifest is not None
    fit, masks = load_npz(store.fetch(manifest) / "body.npz"), load_npz(store.fetch(manifest) / "masks.npz")
    assert np.allclose(fit["pose"][:, 0, 2], 0.1 * np.arange(trees.COUNT), atol=1e-5)
    assert np.array_equal(masks["visible"][0], trees.person_mask(hidden_rows=8))
    hidden = (masks["amodal"][0] > 0) & (masks["visible"][0] == 0)
    assert masks["occluded"][0] == pytest.approx(hidden.sum() / (masks["amodal"][0] > 0).sum())
    assert 0 < (masks["head"][0] > 0).sum() < (masks["visible"][0] > 0).sum()


def test_the_latest_output_of_a_stage_is_found_by_run_or_video_and_item() -> None:
    def row(run: str, stage: str, key: str | None, seq: int, **more: object) -> dict:
        base = {"run_id": run, "video_id": "v", "stage": stage, "key": key, "state": "done", "reason": None}
        return {**base, "knobs": "{}", "started_at": seq, "seq": seq, **more}

    rows = [
        row("r1", "texture", "old", 1), row("r2", "texture", "new", 2), row("r2", "texture", None, 3, state="failed"),
        row("r2", "hallucinate", "turn", 4, knobs='{"item": "turn-0"}'),
        row("r2", "identity", None, 5, state="skipped", reason="no prior"),
    ]  # fmt: skip
    assert find_made(rows, "v", "texture").key == "new" and find_made(rows, "r1", "texture").key == "old"
    assert find_made(rows, "v", "hallucinate/turn-0").key == "turn"
    assert find_made(rows, "r2", "texture").skipped == {"identity": "no prior"}
    for name, title, expected in (("v", "avatar", "expected avatar"), ("w", "texture", "the store has v")):
        with pytest.raises(ValueError, match=expected):
            find_made(rows, name, title)
    with pytest.raises(ValueError, match="expected hallucinate"):
        find_made(rows, "v", "hallucinate")


def test_a_swept_row_is_measured_again_when_the_stage_has_changed(
    swept: tuple[Path, Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tasks.cost import declared

    root, _ = swept
    old = declared.STAGE_SWEEPS["texture"]
    newer = replace(old, stage=replace(old.stage, version=old.stage.version + 1))
    monkeypatch.setattr("tasks.cost.declared.STAGE_SWEEPS", {**declared.STAGE_SWEEPS, "texture": newer})
    again = _cost(root)
    assert again.exit_code == 0 and "texture.atlas_size: 3 of 3" in again.output
