"""The whole flow with every role filled by its production adapter, on tiny checkpoints of the models' real formats."""

from __future__ import annotations

from pathlib import Path

import pytest

from tasks.fills import ENVIRONMENT, Fills
from tests.e2e.conftest import ahoy, small_options
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
    "perceptual": "lpips-alex",
}
# Untrained models find people where they are told to look, whatever the overlap; NLF has to speak of the body's family.
KNOBS = {
    "pose": {"family": "smplx", "min_overlap": 0.0},
    "mask": {"mode": "image", "min_score": 0.0, "min_overlap": 0.0},
    "surface": {"min_overlap": 0.0},
}


def chosen(folder: Path) -> Fills:
    fills = {}
    for role, name in CHOSEN.items():
        fill = build(role, name, folder / role)
        fills[role] = fill.model_copy(update={"options": {**fill.options, **KNOBS.get(role, {})}})
    return Fills(fills)


@pytest.mark.slow
def test_every_role_filled_by_its_production_adapter(
    models: None, demo_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fills = chosen(tmp_path / "models")
    monkeypatch.setenv(ENVIRONMENT, fills.to_json())
    out = tmp_path / "out"
    result = ahoy("run", str(demo_clip), "--out", str(out), *small_options(), "--set", "ingest.max_frames=4")
    assert result.exit_code == 0, result.output
    page = next(out.glob("*/report.html")).read_text()
    for role in CHOSEN:
        who = fills.role(role)
        if role == "body":
            assert "SMPLX_NEUTRAL (your file)" in page
        else:
            assert who is not None and who.name in page, role
