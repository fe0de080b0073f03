"""Keeps what was read of tables, so that looking again reads the new files only."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence

from storage_schema.rows import Part

_CACHE_BYTES = 256 << 20


class PartCache:
    """Files that were read, which never change under their names; the least used go when they are too many."""

    def __init__(self, limit: int = _CACHE_BYTES) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._bytes = 0
        self._parts: OrderedDict[tuple[str, tuple[str, ...]], Part] = OrderedDict()

    def get(self, path: str, columns: Sequence[str]) -> Part | None:
        """The file, if it was read with these columns."""
        key = (path, tuple(columns))
        with self._lock:
            if (part := self._parts.get(key)) is not None:
                self._parts.move_to_end(key)
            return part

    def put(self, path: str, columns: Sequence[str], part: Part) -> None:
        """Keep a file that was read."""
        key = (path, tuple(columns))
        with self._lock:
            if key in self._parts:
                return
            self._bytes += part.rows.nbytes
            self._parts[key] = part
            while self._bytes > self._limit:
                self._bytes -= self._parts.popitem(last=False)[1].rows.nbytes
