"""Networks that were read before a process forked: read once for all runs of a worker, put on the GPU by each.

A GPU's context does not survive a fork, and neither do tensors on it. So the process that others are forked from reads
networks into memory, where forks share their pages, and what is left to a run is the copy to its GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

_kept: dict[tuple[object, ...], Any] = {}
_filling = False


@contextmanager
def filling() -> Iterator[None]:
    """Within the block networks stay on the CPU, whatever device they are meant for, and are kept for forks."""
    global _filling
    _filling = True
    try:
        yield
    finally:
        _filling = False


def is_filling() -> bool:
    """Whether models are being read for forks, and nothing may touch a GPU."""
    return _filling


def network(path: Path, kind: str, device: torch.device, read: Callable[[], Any]) -> Any:
    """A network on its device: read from its files, or taken from the shelf if they have not changed since.

    What is taken is gone from the shelf: who gets it may change it.

    Args:
        path: its file or folder.
        kind: what else the result depends on (class, dtype).
        device: where it is to work.
        read: reads it into the CPU's memory.
    """
    key = (str(path), kind, _stamps(path))
    if _filling:
        if key not in _kept:
            _kept[key] = read()
        return _kept[key]
    found = _kept.pop(key, None)
    return (read() if found is None else found).to(device)


def _stamps(path: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, sizes and times of the files."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return tuple((file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file())
