"""Checkpoints of a training: written whole or not at all, read without running anything that is in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

State = dict[str, Any]
"""Tensors, numbers, strings, and lists and dicts of them."""


def save_checkpoint(path: Path, fingerprint: str, state: State) -> None:
    """Replace the checkpoint in one step: a kill leaves the old one or the new one.

    Args:
        path: The file; its folder is made if absent.
        fingerprint: What the state belongs to; only the same one gets it back.
        state: What `load_checkpoint` returns.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    torch.save({"fingerprint": fingerprint, "state": state}, partial)
    partial.replace(path)


def load_checkpoint(path: Path, fingerprint: str) -> State | None:
    """The state saved at `path`, or None where there is none, a damaged one, or one of another training."""
    if not path.is_file():
        return None
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # a damaged file fails in whichever way its bytes happen to say
        return None
    if not isinstance(found, dict) or found.get("fingerprint") != fingerprint:
        return None
    state: State = found["state"]
    return state
