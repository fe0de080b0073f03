"""Named arrays in a `.npz` file, with the same bytes whenever the arrays are the same."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.errors import NpzError

_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
_PERMISSIONS = 0o644 << 16


def save_npz(path: str | Path, arrays: Mapping[str, np.ndarray], *, compress: bool = False) -> None:
    """Write arrays so that equal names, dtypes, shapes and values always give equal file bytes.

    Names are sorted, memory order and byte order are normalised, and no time is stored, so a content hash repeats. With
    `compress` the bytes also depend on the version of zlib.

    Args:
        path: target; replaced only when the new file is complete.
        arrays: name -> array of numbers, booleans or fixed-length strings.
        compress: deflate the arrays (masks shrink a lot, photographs hardly).

    Raises:
        NpzError: an array of Python objects, or a name that is no plain file name.
    """
    for name, array in arrays.items():
        if not name or "/" in name or "\\" in name:
            raise NpzError(f"expected plain array names, got {name!r}: rename it")
        if np.asarray(array).dtype.hasobject:
            raise NpzError(f"expected numbers, got Python objects in {name!r}: convert it to a numeric array")
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", method) as archive:
        for name in sorted(arrays):
            entry = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
            entry.compress_type = method
            entry.create_system = 3
            entry.external_attr = _PERMISSIONS
            with archive.open(entry, "w", force_zip64=True) as member:
                npy.write_array(member, _normalised(arrays[name]), allow_pickle=False)


def load_npz(path: str | Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Read arrays written by `save_npz` (or `numpy.savez`); nothing in the file is ever executed.

    Args:
        path: the file.
        names: read only these; all of them if None.

    Returns:
        Name -> array.

    Raises:
        FileNotFoundError: no such file.
        NpzError: not a `.npz`, damaged, holding Python objects, or lacking one of `names`.
    """
    source = Path(path)
    try:
        archive = np.load(source, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise NpzError(f"expected a .npz archive, got a single array in {source.name!r}")
        with archive:
            wanted = list(archive.files) if names is None else list(names)
            missing = sorted(set(wanted) - set(archive.files))
            if missing:
                raise NpzError(f"expected arrays {missing} in {source.name!r}, got only {sorted(archive.files)}")
            return {name: archive[name] for name in wanted}
    except FileNotFoundError:
        raise
    except NpzError:
        raise
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise NpzError(
            f"expected a complete .npz of plain arrays, got {source.name!r} ({error}): make it again"
        ) from error


def npz_names(path: str | Path) -> tuple[str, ...]:
    """Names of the arrays in a `.npz` file; none of them is read.

    Raises:
        FileNotFoundError: no such file.
        NpzError: not a `.npz`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple(name.removesuffix(".npy") for name in archive.namelist())
    except zipfile.BadZipFile as error:
        raise NpzError(f"expected a .npz archive, got {Path(path).name!r} ({error}): make it again") from error


def _normalised(array: np.ndarray) -> np.ndarray:
    """Little-endian, C order, same shape (also for zero-dimensional arrays)."""
    values = np.asarray(array)
    return values.astype(values.dtype.newbyteorder("<"), order="C", copy=False)
