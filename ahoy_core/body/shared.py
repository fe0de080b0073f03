"""What is worth finding once for each body."""

from __future__ import annotations

from collections.abc import Hashable
from functools import lru_cache
from typing import cast

from torch import Tensor

from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.model import BodyModel


def shared_canonical_pose(body: BodyModel) -> Tensor:
    """The canonical pose [J,3] of a body, which costs more to find than a frame's transforms together."""
    return _found(cast(Hashable, body))


@lru_cache(maxsize=2)
def _found(body: Hashable) -> Tensor:
    return canonical_pose(cast(BodyModel, body))
