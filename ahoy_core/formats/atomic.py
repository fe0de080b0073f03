"""Files that are either complete or absent."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` if the block succeeds, delete it if not.

    An older file at `path` stays as it was until the new one is complete and on the disk.

    Args:
        path: where the file shall end up; its folder must exist.

    Yields:
        A path in the same folder with the same suffix.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"expected an existing folder, got {str(target.parent)!r}: create it first")
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.{os.urandom(4).hex()}{target.suffix}")
    try:
        yield temporary
        # Without this a power cut can leave a renamed file with no content.
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
