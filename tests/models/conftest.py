"""Tiny checkpoints, built and loaded once for all tests that only read them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import adapter
from tests.models.checkpoints import build

Tiny = Callable[[str, str], Fill]
Load = Callable[[str, str], Any]


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Tiny:
    """Builds the checkpoint (or the command) of a role's adapter."""
    built: dict[tuple[str, str], Fill] = {}

    def once(role: str, name: str) -> Fill:
        if (role, name) not in built:
            built[role, name] = build(role, name, tmp_path_factory.mktemp(f"{role}-{name}"))
        return built[role, name]

    return once


@pytest.fixture(scope="session")
def load(tiny: Tiny) -> Load:
    """Loads each adapter."""
    loaded: dict[tuple[str, str], Any] = {}

    def once(role: str, name: str) -> Any:
        if (role, name) not in loaded:
            loaded[role, name] = adapter(role, name).open(tiny(role, name))
        return loaded[role, name]

    return once
