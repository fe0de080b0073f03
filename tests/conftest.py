"""Fixtures shared by the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with captures and real clips of a development machine; the test is skipped where there is none."""
    root = Path(os.environ.get("AHOY_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    if not (root / "captures").is_dir():
        pytest.skip("needs captures and clips: set AHOY_SHARED to a folder that holds captures/ and videos/")
    return root
