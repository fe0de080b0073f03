"""The manifest: the one file whose presence says that a stage is done, and with what result."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from storage_schema.errors import ArtifactError, CorruptError
from storage_schema.keys import canonical_json
from storage_schema.sealed import BodyUpgrade, seal, unseal

SCHEMA_VERSION = 1
# Version -> what turns the body of a manifest of that version into one of the next.
UPGRADES: Mapping[int, BodyUpgrade] = {}

# Four digits sort well in a listing; more follow without harm, the order is numeric.
_MANIFEST_NAME = re.compile(r"manifest\.(\d{4,9})\.json")
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}")
_MAX_DEPTH = 4


@dataclass(frozen=True)
class BlobRef:
    """One file of an artifact.

    Attributes:
        name: as declared by the stage, relative to its folder, with `/`.
        path: where it lies, relative to the root of the store.
        size: bytes.
        sha256: of its bytes, 64 hexadecimal digits.
    """

    name: str
    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """What a committed attempt at a stage left in the store.

    Attributes:
        schema_version: of this format.
        key: the stage's key (`stage_key`).
        stage: its name.
        stage_version: its version.
        attempt: which attempt wrote the blobs.
        created_at: UTC, ISO 8601.
        config: the validated configuration.
        inputs: input name -> content hash of the input artifact.
        roles: role -> who filled it (name, licence, sha256 of the weights).
        summary: the stage's results that fit in JSON.
        blobs: its files, sorted by name.
        content_hash: hash over the names and hashes of the blobs; identical outputs have an identical one.
    """

    schema_version: int
    key: str
    stage: str
    stage_version: int
    attempt: str
    created_at: str
    config: dict[str, Any]
    inputs: dict[str, str]
    roles: dict[str, dict[str, Any]]
    summary: dict[str, Any]
    blobs: tuple[BlobRef, ...]
    content_hash: str

    def blob(self, name: str) -> BlobRef:
        """The blob called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for blob in self.blobs:
            if blob.name == name:
                return blob
        raise KeyError(f"{self.stage} has no {name!r}; it has {[blob.name for blob in self.blobs]}")

    def to_json(self) -> bytes:
        """Readable JSON with a checksum of itself, so that a damaged manifest is never taken for a whole one."""
        return seal(asdict(self), "manifest")

    @classmethod
    def from_json(cls, data: bytes) -> Manifest:
        """Read what `to_json` wrote, at this or an older version.

        Raises:
            CorruptError: the bytes are not a whole, unchanged manifest.
            StoreVersionError: a newer version of this software wrote it.
        """
        body = unseal(data, "manifest", SCHEMA_VERSION, UPGRADES)
        if set(body) != {field.name for field in fields(cls)}:
            raise CorruptError(
                f"manifest has fields {sorted(body)}, expected {sorted(field.name for field in fields(cls))}"
            )
        blobs = tuple(_checked_blob(blob) for blob in body.pop("blobs"))
        manifest = cls(blobs=blobs, **body)
        if manifest.content_hash != content_hash(blobs):
            raise CorruptError("manifest's content hash does not fit its blobs")
        return manifest


def _checked_blob(fields_of_blob: Mapping[str, Any]) -> BlobRef:
    """A blob as a manifest states it; a store may be somebody else's, so its names must not lead out of any folder."""
    try:
        blob = BlobRef(**fields_of_blob)
        check_blob_name(blob.name)
        steps = blob.path.split("/")
    except (TypeError, AttributeError, ArtifactError) as error:
        raise CorruptError(f"manifest has a blob that cannot be used ({error})") from error
    if not all(steps) or {".", ".."} & set(steps) or "\\" in blob.path or "\0" in blob.path:
        raise CorruptError(f"manifest has a blob at {blob.path!r}, expected a path below the store's root")
    return blob


def content_hash(blobs: Iterable[BlobRef]) -> str:
    """Hash over the blobs' names and hashes; where they lie and in which order they are given does not matter."""
    return hashlib.sha256(canonical_json(sorted([blob.name, blob.sha256] for blob in blobs))).hexdigest()


def manifest_name(generation: int) -> str:
    """File name of the manifest of a generation (from 1)."""
    return f"manifest.{generation:04d}.json"


def generation_of(name: str) -> int | None:
    """Generation of a manifest's file name; None if it is not one."""
    match = _MANIFEST_NAME.fullmatch(name)
    return int(match.group(1)) if match else None


def check_blob_name(name: str) -> None:
    """Refuse names that could leave the attempt's folder or differ between file systems.

    Raises:
        ArtifactError: not one to four parts joined by `/`, each of letters, digits, `.`, `_`, `-`, not starting with
            `.` or `-`.
    """
    parts = name.split("/")
    if len(parts) > _MAX_DEPTH or not all(_PART.fullmatch(part) and not part.endswith(".") for part in parts):
        raise ArtifactError(
            f"file name {name!r}: expected at most {_MAX_DEPTH} parts joined by '/', each of letters, digits, '.', '_' "
            "and '-', not starting with '.' or '-' and not ending with '.'; rename it"
        )


def check_name(name: str, what: str) -> None:
    """Refuse a key, batch or owner that could not be one folder name everywhere.

    Raises:
        ArtifactError: not letters, digits, `.`, `_`, `-`, or starting with `.` or `-`, or ending with `.`.
    """
    if not isinstance(name, str) or not _PART.fullmatch(name) or name.endswith("."):
        raise ArtifactError(
            f"{what}: expected 1 to 128 letters, digits, '.', '_' or '-', not starting with '.' or '-' "
            f"and not ending with '.', got {name!r}"
        )
