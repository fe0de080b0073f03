"""The whole flow with every role filled by its production adapter, on tiny checkpoints of the models' real formats."""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
from tasks.fills import ENVIRONMENT, Fills
from tests.body import licensed
from tests.e2e.conftest import ahoy, small_options
from tests.models.charts import write_table
from tests.models.checkpoints import build

CHOSEN = {
    "body": "smplx",
    "pose": "nlf",
    "mask": "sam3",
    "surface": "densepose",
    "head": "sapiens2",
    "inpaint": "flux-fill",
    "views": "synchuman",
    "face": "cap4d",
    "video": "wan2.2-5b",
    "perceptual": "lpips-alex",
}
# Untrained models find people where they are told to look, whatever the overlap; NLF has to speak of the body's family.
KNOBS = {
    "pose": {"family": "smplx", "min_overlap": 0.0},
    "mask": {"mode": "image", "min_score": 0.0, "min_overlap": 0.0},
    "surface": {"min_overlap": 0.0},
    "video": {"height": 64},
}
# What makes the stages of section 3.2 run whoever wins the self-check, at a size that takes seconds.
ASKED = (
    "prior=packaged", "ingest.max_frames=4",
    "complete.believe=prior", "complete.regions=1", "identity.steps=2", "identity.frames=2",
    "motions.limit=1", "motions.frames=5", "hallucinate.inversion.steps=1",
)  # fmt: skip


def chosen(folder: Path) -> Fills:
    fills = {}
    for role, name in CHOSEN.items():
        fill = build(role, name, folder / role)
        fills[role] = fill.model_copy(update={"options": {**fill.options, **KNOBS.get(role, {})}})
    write_table(folder / "surface")
    licensed.write(folder / "surface", "smpl")
    return Fills(fills)


@pytest.mark.slow
@pytest.mark.timeout(900)  # ten models' libraries are imported, and every stage runs
def test_every_role_filled_by_its_production_adapter(
    models: None, demo_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fills = chosen(tmp_path / "models")
    monkeypatch.setenv(ENVIRONMENT, fills.to_json())
    out = tmp_path / "out"
    knobs = [word for knob in ASKED for word in ("--set", knob)]
    result = ahoy("run", str(demo_clip), "--out", str(out), *small_options(), *knobs)
    assert result.exit_code == 0, result.output
    page = html.unescape(next(out.glob("*/report.html")).read_text())
    for role in CHOSEN:
        who = fills.role(role)
        if role == "body":
            assert "SMPLX_NEUTRAL (your file)" in page
        else:
            assert who is not None and who.name in page, role
    assert "What was not done" not in page, "every stage had a model for what it does"
    assert "moved to DensePose's charts" in page
    store = ArtifactStore(out / "store")
    rows = {row["stage"]: row for row in Tables(store).read("stages").to_pylist()}
    for stage in ("complete", "identity", "hallucinate"):
        manifest = store.lookup(rows[stage]["key"], stage=stage)
        assert manifest is not None and manifest.roles["video"]["name"] == "Wan 2.2 TI2V 5B", stage
    assert manifest.summary["figures"]["method"] == "inversion"
    avatar = store.lookup(rows["avatar"]["key"], stage="avatar")
    assert avatar is not None
    assert any("supervised by 1 hallucinated sequences" in note for note in avatar.summary["notes"])
