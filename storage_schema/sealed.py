"""JSON documents that carry a checksum of themselves, so that a damaged one is never taken for a whole one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

from storage_schema.errors import CorruptError, StoreVersionError
from storage_schema.keys import canonical, canonical_json

BodyUpgrade = Callable[[dict[str, Any]], dict[str, Any]]


def seal(body: Mapping[str, Any], what: str) -> bytes:
    """Readable JSON of `body` and its SHA-256.

    Args:
        body: JSON types, with a `schema_version` of type int.
        what: what it is, in one word; also the name of the body inside the document.

    Raises:
        ValueError, TypeError: see `storage_schema.keys.canonical`.
    """
    plain = canonical(body, what)
    document = {"sha256": hashlib.sha256(canonical_json(plain)).hexdigest(), what: plain}
    return (json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode("utf-8")


def unseal(data: bytes, what: str, version: int, upgrades: Mapping[int, BodyUpgrade]) -> dict[str, Any]:
    """The body of what `seal` wrote, at the current version of its schema.

    Args:
        data: the document.
        what: as given to `seal`.
        version: the current schema version.
        upgrades: version -> what turns a body of that version into one of the next.

    Raises:
        CorruptError: the bytes are not a whole, unchanged document.
        StoreVersionError: a newer version of this software wrote it.
    """
    body = _checked_body(data, what)
    if body["schema_version"] > version:
        raise StoreVersionError(
            f"{what} of schema version {body['schema_version']}, expected at most {version}: a newer "
            "version of this software wrote this store; install that version, or use another store"
        )
    for step in range(body["schema_version"], version):
        body = {**upgrades[step](body), "schema_version": step + 1}
    return body


def sealed_version(data: bytes, what: str) -> int:
    """Schema version at which a document was written.

    Raises:
        CorruptError: the bytes are not a whole, unchanged document.
    """
    return int(_checked_body(data, what)["schema_version"])


def _checked_body(data: bytes, what: str) -> dict[str, Any]:
    try:
        document = json.loads(data)
        body, expected = document[what], document["sha256"]
        whole = hashlib.sha256(canonical_json(body)).hexdigest() == expected
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise CorruptError(f"{what} is unreadable ({error})") from error
    if not whole or not isinstance(body, dict) or not isinstance(body.get("schema_version"), int):
        raise CorruptError(f"{what} does not have the checksum it was written with")
    return body
