"""Threads for the kernels: our own, as Numba's only guaranteed threading layer is neither thread- nor fork-safe.

The kernels release the GIL and work on a part of a static partition, so which thread runs a part never changes a bit.
Several callers may share the pool (parts never wait for each other), and a forked child starts a pool of its own.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch

T = TypeVar("T")

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_size = 0


def _forget() -> None:
    """Threads do not survive a fork, and a lock may have been held by one of them."""
    global _lock, _pool, _size
    _lock, _pool, _size = threading.Lock(), None, 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _executor(workers: int) -> ThreadPoolExecutor:
    """The shared pool with at least this many threads; a smaller one is left to finish what it has."""
    global _pool, _size
    with _lock:
        if _pool is None or _size < workers:
            _pool, _size = ThreadPoolExecutor(workers, thread_name_prefix="ahoy-splat"), workers
        return _pool


def resolve_threads(num_threads: int | None) -> int:
    """The number of threads to use: the one asked for, or PyTorch's.

    Raises:
        ValueError: If it is not positive.
    """
    count = torch.get_num_threads() if num_threads is None else num_threads
    if not isinstance(count, int) or count < 1:
        raise ValueError(f"num_threads: expected an integer >= 1, got {num_threads!r}; pass None for PyTorch's number")
    return count


def run_parts(task: Callable[[int], T], parts: int) -> list[T]:
    """Results of task(0), ..., task(parts - 1); the caller's thread does the first one."""
    if parts == 1:
        return [task(0)]
    others = [_executor(parts - 1).submit(task, part) for part in range(1, parts)]
    first = task(0)
    return [first, *(other.result() for other in others)]


def split(count: int, threads: int, least: int = 1024) -> list[tuple[int, int]]:
    """Contiguous ranges that cover [0, count), one per thread, none much shorter than `least`."""
    parts = max(1, min(threads, count // least))
    return [(count * p // parts, count * (p + 1) // parts) for p in range(parts)]


def run_spans(function: Callable[..., T], spans: list[tuple[int, int]], *args: Any, each: Any = ()) -> list[T]:
    """Results of function(start, stop, *args) for every span; with `each`, that span's own last argument is added."""
    return run_parts(lambda p: function(*spans[p], *args, *each[p : p + 1]), len(spans))
