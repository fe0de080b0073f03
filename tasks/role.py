"""Who filled a role, as the report, the ledger and the keys know it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Role:
    """Who filled a role (pose, mask, body, ...): shown in the report; `weights_sha256` is part of the stage's key."""

    name: str
    licence: str
    weights_sha256: str = ""
