"""Fixtures shared by the whole suite."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest
import torch


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with captures and real clips of a development machine; the test is skipped where there is none."""
    root = Path(os.environ.get("AHOY_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    if not (root / "captures").is_dir():
        pytest.skip("needs captures and clips: set AHOY_SHARED to a folder that holds captures/ and videos/")
    return root


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def backend(request: pytest.FixtureRequest) -> str:
    """Device whose backend renders: "cpu" (Numba) or "cuda" (gsplat)."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("backend cuda: no NVIDIA GPU here")
        if importlib.util.find_spec("gsplat") is None:
            pytest.skip("backend cuda: gsplat is not installed (pip install ahoy-avatars[cuda])")
    return str(request.param)
