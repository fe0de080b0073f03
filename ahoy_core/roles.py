"""The embedded fillings of the roles, in one explicit table; real models are in `ahoy_core.models.catalogue`.

Nothing registers itself; a new filling is one entry here. The protocols are in `ahoy_core.models.contracts`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from torch import Tensor

from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.smpl_load import load_smpl
from ahoy_core.metrics.perceptual import Perceptual
from ahoy_core.metrics.stlpips import load_stlpips
from ahoy_core.texture.fill import fill_atlas
from ahoy_core.texture.fillings import TexturedBody
from ahoy_core.texture.selfcheck import Completion


def _prior_inpaint(*arguments: Any, **named: Any) -> Tensor:
    """`PriorBody.inpaint`; the prior's libraries are imported with the first call."""
    from ahoy_core.prior.views import PriorBody

    return PriorBody.inpaint(*arguments, **named)


def _prior_views(*arguments: Any, **named: Any) -> tuple[Tensor, tuple[float, ...]]:
    """`PriorBody.views`, likewise."""
    from ahoy_core.prior.views import PriorBody

    return PriorBody.views(*arguments, **named)


__all__ = ["COMPLETIONS", "FILLINGS", "Perceptual"]

COMPLETIONS: Final[Mapping[str, Completion]] = {
    "symmetry + harmonic": partial(fill_atlas, fill="both"),
    "harmonic": partial(fill_atlas, fill="harmonic"),
    "symmetry": partial(fill_atlas, fill="symmetric"),
}
"""Fillings of the atlas, for `ahoy_core.texture.selfcheck.score_fillings`."""

FILLINGS: Final[Mapping[str, Mapping[str, Callable[..., Any]]]] = {
    "body": {"packaged": load_packaged_body, "smpl": load_smpl},
    "inpaint": {"textured body": TexturedBody.inpaint, "embedded prior": _prior_inpaint},
    "views": {"textured body": TexturedBody.views, "embedded prior": _prior_views},
    "perceptual": {"ST-LPIPS": load_stlpips},
}
"""Role -> name -> what fills it: loaders of bodies, methods of a person's `TexturedBody` or `PriorBody`."""
