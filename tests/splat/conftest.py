"""The backends that the one suite runs on."""

from __future__ import annotations

import importlib.util

import pytest
import torch


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def backend(request: pytest.FixtureRequest) -> str:
    """Device whose backend renders: "cpu" (Numba) or "cuda" (gsplat)."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("backend cuda: no NVIDIA GPU here")
        if importlib.util.find_spec("gsplat") is None:
            pytest.skip("backend cuda: gsplat is not installed (pip install ahoy-avatars[cuda])")
    return str(request.param)
