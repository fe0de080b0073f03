"""Keys: what a result depends on, as one hash.

A key covers the stage and its version, the validated configuration, the content of the inputs and the weights of the
models; never a path, a time or a run id. Equal keys mean that the stored result can be used instead of running the
stage.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_STAGE = re.compile(r"[a-z][a-z0-9_]{0,63}")
# Hashes, versions and names such as "sha256:..." or "packaged@3"; no separator, so that a path cannot get into a key.
_CONTENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@+-]{0,255}")
_CHUNK = 1 << 20


def canonical(value: object, where: str = "value") -> Any:
    """`value` as plain JSON types, with everything refused that JSON cannot hold exactly.

    Args:
        value: None, bool, int, finite float, str, list, tuple (becomes a list), or a mapping with str keys, nested.
        where: how errors name the place.

    Returns:
        The same value made of None, bool, int, float, str, list and dict.

    Raises:
        ValueError: a NaN or an infinity, or text that is not valid Unicode.
        TypeError: any other type, or a key that is not a str.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{where}: expected a finite number, got {value}; JSON has no such value, use None")
        return float(value)
    if isinstance(value, str):
        return _text(value, where)
    if isinstance(value, list | tuple):
        return [canonical(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(
                    f"{where}: expected str keys, got {key!r} of type {type(key).__name__}; convert it to str"
                )
        return {_text(key, where): canonical(item, f"{where}.{key}") for key, item in value.items()}
    raise TypeError(
        f"{where}: expected None, bool, int, float, str, list or dict, got {type(value).__name__}; convert it first "
        "(array.tolist(), scalar.item(), model.model_dump(mode='json')); a file goes in by its content hash"
    )


def canonical_json(value: object, where: str = "value") -> bytes:
    """One byte string per value: sorted keys, no spaces, floats in their shortest exact form, UTF-8.

    Args:
        value: see `canonical`.
        where: how errors name the place.

    Returns:
        JSON; equal for equal values whatever the order of their keys, different otherwise. 1, 1.0 and true are three
        different values.

    Raises:
        ValueError: see `canonical`.
        TypeError: see `canonical`.
    """
    plain = canonical(value, where)
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode("utf-8")


def stage_key(
    stage: str, version: int, config: Mapping[str, Any], inputs: Mapping[str, str], weights: Mapping[str, str]
) -> str:
    """The key under which a stage's result is stored.

    Args:
        stage: the stage's name, lower case.
        version: the stage's version, from 1, raised when its code changes what it gives.
        config: its validated configuration as JSON types.
        inputs: input name -> content hash of that input.
        weights: role -> hash of the weights that fill it (or name@version where there are none).

    Returns:
        64 hexadecimal digits (SHA-256 of the canonical JSON of all five).

    Raises:
        ValueError: a NaN, a bad stage name or version, or an input or weight given as a path.
        TypeError: a value that is not JSON.
    """
    check_stage(stage)
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ValueError(f"version of stage {stage}: expected an int from 1, got {version!r}")
    for label, hashes in (("inputs", inputs), ("weights", weights)):
        for name, content in hashes.items():
            if not isinstance(content, str) or not _CONTENT.fullmatch(content):
                raise ValueError(
                    f"{label}[{name!r}]: expected a content hash, got {content!r}; use file_sha256 for a file"
                )
    document = {"config": config, "inputs": inputs, "stage": stage, "version": version, "weights": weights}
    return hashlib.sha256(canonical_json(document, "key")).hexdigest()


def check_stage(stage: str) -> None:
    """Refuse a stage name that could not be a folder name everywhere.

    Raises:
        ValueError: not lower-case letters, digits and underscores, starting with a letter.
    """
    if not isinstance(stage, str) or not _STAGE.fullmatch(stage):
        raise ValueError(f"stage: expected lower-case letters, digits and '_', starting with a letter, got {stage!r}")


def file_sha256(path: str | Path, progress: Callable[[int], object] | None = None) -> str:
    """SHA-256 of a file's bytes, in constant memory.

    Args:
        path: the file.
        progress: called with the number of bytes after each piece.

    Returns:
        64 hexadecimal digits.

    Raises:
        OSError: the file cannot be read.
    """
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while piece := file.read(_CHUNK):
            digest.update(piece)
            if progress is not None:
                progress(len(piece))
    return digest.hexdigest()


def _text(value: str, where: str) -> str:
    try:
        value.encode("utf-8")
    except UnicodeEncodeError as error:
        raise ValueError(
            f"{where}: expected valid Unicode, got {value!r}; decode the bytes it came from properly"
        ) from error
    return str.__str__(value)
