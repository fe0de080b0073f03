"""`ahoy cost end-to-end --repeats` on a shared capture: whole runs, each in a store of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from ahoy_core.cost.sweep import read_jsonl
from flows.cli import app

TINY = (
    "prior=none", "ingest.max_frames=4", "ingest.max_size=128", "perceive.iterations=1", "perceive.passes=1",
    "texture.atlas_size=64", "texture.canonical_height=64", "texture.canonical_width=48", "coarse.map_size=32",
    "coarse.steps=1", "avatar.steps=1", "animate.turntable_frames=8", "animate.motion_frames=8",
)  # fmt: skip


@pytest.mark.shared
def test_every_repeat_of_a_whole_run_is_made_anew_and_makes_the_same(tmp_path: Path, shared_dir: Path) -> None:
    out = tmp_path / "out"
    options = [word for knob in TINY for word in ("--set", knob)]

    def sweep(repeats: int) -> str:
        result = CliRunner().invoke(app, [
            "cost", "end-to-end", "--dataset", str(shared_dir / "captures"), "--only", "a", "--presets", "",
            "--knob", "coarse.steps=1", "--repeats", str(repeats), "--size", "64", "--out", str(out), *options,
        ])  # fmt: skip
        assert result.exit_code == 0, result.output
        return result.output

    sweep(1)
    (once,) = read_jsonl(out / "rows.jsonl")
    sweep(2)
    (twice,) = read_jsonl(out / "rows.jsonl")
    assert once.cpu_s is not None and twice.cpu_s is not None
    assert (once.cpu_s.repeats, twice.cpu_s.repeats) == (1, 2) and once.errors == twice.errors
    assert twice.cpu_s.low < twice.cpu_s.high, "two runs, not one bill read twice"
    avatars = [
        sorted(path.read_bytes() for path in store.glob("artifacts/avatar/*/attempts/*/avatar.safetensors"))
        for store in (out / "store", out / "repeats" / "2")
    ]
    assert avatars[0] == avatars[1] and len(avatars[0]) == 1
    assert "end to end" not in sweep(2), "both are there"
