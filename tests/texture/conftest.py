from __future__ import annotations

import pytest

from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import TexelMap, texel_map

from .synthetic import CapsuleBody


@pytest.fixture(scope="session")
def body() -> CapsuleBody:
    return CapsuleBody()


@pytest.fixture(scope="session")
def surface(body: CapsuleBody) -> Surface:
    return Surface.of(body)


@pytest.fixture(scope="session")
def texels(surface: Surface) -> TexelMap:
    return texel_map(surface, 128)
