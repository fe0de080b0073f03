"""A body by name or by file: what the configuration's `body` means."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import torch

from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.smpl_load import load_smpl

PACKAGED: Final = "packaged"
# The makers' own names for files that belong to a model and are downloaded beside it.
UV_FILES: Final = ("uv.obj", "smpl_uv.obj", "smplx_uv.obj")
HEAD_FILES: Final = ("SMPL-X__FLAME_vertex_ids.npy",)
FLAME_FILES: Final = ("FLAME_NEUTRAL.npz", "flame2023.npz", "generic_model.npz")
FLAME_EXPRESSIONS: Final = 50
"""Of FLAME's 100 components: what trackers of faces usually fit."""


def load_body(source: str = PACKAGED, device: torch.device | str = "cpu") -> BodyModel:
    """The body that a name or a path stands for, float32 (read once a process for each version of a file).

    Args:
        source: "packaged", or the path of an SMPL, SMPL+H or SMPL-X `.npz`. Beside the latter, a texture layout
            (`UV_FILES`), the head's vertex numbers (`HEAD_FILES`) and FLAME (`FLAME_FILES`) are used if they are there.
        device: where the tensors go.

    Raises:
        FileNotFoundError: neither a known name nor a file.
        BodyFileError: the file cannot be used.
    """
    if source == PACKAGED:
        return load_packaged_body(device)
    versions = tuple((path, path.stat().st_mtime_ns) for path in body_files(source))
    return _load_licensed(versions, str(device))


def body_files(source: str) -> tuple[Path, ...]:
    """The files that a licensed body is read from, the model first; all of them belong to its hash.

    Raises:
        FileNotFoundError: neither a known name nor a file.
    """
    path = Path(source).expanduser()
    if not path.is_file():
        raise FileNotFoundError(
            f"expected body {PACKAGED!r} or the path of an SMPL, SMPL+H or SMPL-X .npz, got {source!r}: no such file"
        )
    found = (next((path.with_name(n) for n in names if path.with_name(n).is_file()), None) for names in _BESIDE)
    return (path, *(other for other in found if other is not None))


_BESIDE: Final = (UV_FILES, HEAD_FILES, FLAME_FILES)


@lru_cache(maxsize=2)
def _load_licensed(versions: tuple[tuple[Path, int], ...], device: str) -> BodyModel:
    path, *beside = (path for path, _ in versions)
    uv = next((other for other in beside if other.name in UV_FILES), None)
    head = next((other for other in beside if other.name in HEAD_FILES), None)
    flame = next((other for other in beside if other.name in FLAME_FILES), None)
    if flame is None:
        return load_smpl(path, uv=uv, head_ids=head, device=device)
    count = FLAME_EXPRESSIONS
    return load_smpl(path, uv=uv, head_ids=head, flame=flame, n_expressions=count, device=device)
