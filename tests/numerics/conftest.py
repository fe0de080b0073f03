"""The hard cases run on every backend."""

from __future__ import annotations

import pytest

from ahoy_core.splat import rasterization
from tests.numerics.hard import Render
from tests.splat.scenes import on_gpu


@pytest.fixture
def render(backend: str) -> Render:
    """`rasterization`, on the CPU or there and back over a GPU."""
    return on_gpu if backend == "cuda" else rasterization
