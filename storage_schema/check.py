"""Does a folder hold what its stage declares?"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from storage_schema.artifacts import ARTIFACTS, Array, Blob
from storage_schema.errors import ArtifactError
from storage_schema.manifest import check_blob_name

# A declared array's letter -> (size, where it was first met), shared by all files of one artifact.
_Sizes = dict[str, tuple[int, str]]


def check(stage: str, folder: str | Path, artifacts: Mapping[str, Sequence[Blob]] = ARTIFACTS) -> tuple[str, ...]:
    """Compare the files in `folder` with the declaration of `stage`.

    Every declared file must be there (unless optional), not empty and a plain file; every array of an `.npz` must have
    the declared dtype and shape, letters agreeing across the artifact; a `.json` must be strict JSON. Only the headers
    of arrays are read, and nothing is ever unpickled.

    Args:
        stage: the stage's name.
        folder: what the stage wrote.
        artifacts: declarations by stage.

    Returns:
        Names of the files, sorted, relative to `folder`, with `/`.

    Raises:
        ArtifactError: something is missing, undeclared or not as declared; the message names the file and the array.
    """
    if stage not in artifacts:
        raise ArtifactError(
            f"stage {stage!r} declares no files (known: {', '.join(sorted(artifacts))}); add it to ARTIFACTS"
        )
    folder = Path(folder)
    names = list_files(folder)
    declared = {blob.name: blob for blob in artifacts[stage]}
    if extra := [name for name in names if name not in declared]:
        raise ArtifactError(
            f"stage {stage}: undeclared files {extra}; declared are {sorted(declared)}. "
            "Remove them or declare them in ARTIFACTS"
        )
    if missing := [name for name, blob in declared.items() if not blob.optional and name not in names]:
        raise ArtifactError(f"stage {stage}: declared files {missing} are missing in {folder}; it holds {names}")
    sizes: _Sizes = {}
    for name in names:
        path = folder / name
        if path.stat().st_size == 0:
            raise ArtifactError(f"stage {stage}: {name} is empty")
        if name.endswith(".npz"):
            _check_npz(path, name, declared[name].arrays, sizes)
        elif name.endswith(".json"):
            _check_json(path, name)
    return tuple(names)


def list_files(folder: Path) -> list[str]:
    """Names of all files under `folder`, sorted, relative to it, with `/`.

    Raises:
        ArtifactError: a link, a device, or a name that the store does not allow.
    """
    names = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ArtifactError(
                f"{name}: expected a plain file, got a link or a special file; copy the content into the folder"
            )
        if path.is_file():
            check_blob_name(name)
            names.append(name)
    return sorted(names)


def _check_npz(path: Path, name: str, declared: Mapping[str, Array], sizes: _Sizes) -> None:
    try:
        headers = _npz_headers(path)
    except (zipfile.BadZipFile, ValueError, EOFError, OSError) as error:
        raise ArtifactError(
            f"{name}: expected arrays written by numpy.savez, got something unreadable ({error})"
        ) from error
    if set(headers) != set(declared):
        missing, extra = sorted(set(declared) - set(headers)), sorted(set(headers) - set(declared))
        raise ArtifactError(
            f"{name}: arrays missing {missing}, undeclared {extra}; expected exactly {sorted(declared)}"
        )
    for key, array in declared.items():
        shape, dtype = headers[key]
        where = f"{name}:{key}"
        if dtype != np.dtype(array.dtype):
            raise ArtifactError(f"{where}: expected dtype {array.dtype}, got {dtype}; convert with .astype")
        _check_shape(where, shape, array.shape, sizes)


def _check_shape(where: str, shape: tuple[int, ...], declared: tuple[str | int, ...], sizes: _Sizes) -> None:
    expected = "[" + ", ".join(str(size) for size in declared) + "]"
    if len(shape) != len(declared):
        raise ArtifactError(f"{where}: expected shape {expected}, got {list(shape)}")
    for got, want in zip(shape, declared, strict=True):
        if isinstance(want, str):
            size, first = sizes.setdefault(want, (got, where))
            if got != size:
                raise ArtifactError(
                    f"{where}: expected shape {expected} with {want} = {size} as in {first}, got {list(shape)}"
                )
        elif got != want:
            raise ArtifactError(f"{where}: expected shape {expected}, got {list(shape)}")


def _npz_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and dtype of each array, and proof that its bytes are all there, without reading them."""
    headers = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                if version == (1, 0):
                    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                elif version == (2, 0):
                    shape, _, dtype = np.lib.format.read_array_header_2_0(file)
                else:
                    raise ValueError(f"{member.filename} has npy version {version}, expected 1.0 or 2.0")
                if dtype.hasobject:
                    raise ValueError(f"{member.filename} holds Python objects; store numbers only")
                whole = file.tell() + math.prod(shape) * dtype.itemsize
            if member.file_size != whole:
                raise ValueError(f"{member.filename} has {member.file_size} bytes, its header promises {whole}")
            headers[member.filename.removesuffix(".npy")] = (shape, dtype)
    return headers


def _check_json(path: Path, name: str) -> None:
    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is not JSON; write null")

    try:
        json.loads(path.read_bytes(), parse_constant=refuse)
    except (ValueError, UnicodeDecodeError) as error:
        raise ArtifactError(f"{name}: expected strict JSON, got something unreadable ({error})") from error
