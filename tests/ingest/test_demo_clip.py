"""The clip that comes with the package is small, sound and explained."""

from __future__ import annotations

from importlib import resources

import numpy as np

from ahoy_core.ingest import ingest


def test_bundled_clip_is_small_and_reads_without_a_warning() -> None:
    with resources.as_file(resources.files("ahoy_core.assets") / "demo.mp4") as path:
        assert path.stat().st_size < 1_000_000
        result = ingest(path)
    assert result.frames.shape == (48, 256, 256, 3)
    assert np.allclose(result.pts, np.arange(48) / 15)
    assert set(result.shot) == {0} and result.notes == ()


def test_origin_of_the_bundled_clip_is_stated() -> None:
    text = (resources.files("ahoy_core.assets") / "demo.md").read_text(encoding="utf-8")
    assert "rendering made for this project" in text
