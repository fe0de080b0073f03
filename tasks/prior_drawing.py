"""A sheet of what the prior draws from words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.prior.video import load_video
from ahoy_core.prior.words import drawn_from_words
from tasks.prior_folder import prior_folder

_ENLARGED: Final = 2  # times, so that a prompt fits above its views
_COLUMNS: Final = 2


def draw_words(source: str, prompts: Sequence[str], path: Path, steps: int = 1, seed: int = 0) -> None:
    """Write a PNG: the four views of each prompt side by side, under it.

    Args:
        source: "packaged", or a prior's folder.
        prompts: what is asked for.
        path: of the PNG.
        steps: see `drawn_from_words`.
        seed: likewise.
    """
    rows = drawn_from_words(load_video(prior_folder(source)), prompts, steps, seed)
    strips = [np.concatenate([to_uint8(view) for view in row], axis=1) for row in rows]
    enlarged = [strip.repeat(_ENLARGED, 0).repeat(_ENLARGED, 1) for strip in strips]
    write_png(path, contact_sheet(enlarged, prompts, columns=min(_COLUMNS, len(enlarged))))
