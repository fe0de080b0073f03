"""Batches: which videos were submitted under a name, written once.

Layout, beside what `storage_schema.store` describes:

    batches/<batch>/manifest.json    written by one create-if-absent, never changed
    batches/<batch>/cancelled.json   there while the batch is cancelled

A batch's manifest is a promise of work; Prefect's runs are attempts at it, and the tables say how they went
(`storage_schema.status`).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from typing import Any

from storage_schema.errors import BatchExistsError, CorruptError, UnknownBatchError
from storage_schema.manifest import check_name
from storage_schema.sealed import BodyUpgrade, seal, unseal
from storage_schema.secrets import redact_json, redact_url
from storage_schema.store import ArtifactStore

BATCH_VERSION = 1
# Version -> what turns the body of a batch manifest of that version into one of the next.
UPGRADES: Mapping[int, BodyUpgrade] = {}
_NAMED = 5  # how many differences are spelt out before the rest is counted


@dataclass(frozen=True)
class BatchEntry:
    """One video of a batch.

    Attributes:
        video_id: unique in the batch; also a folder name.
        source: path or URL, without credentials: those come from the environment of the worker.
        line: where it stood in the list, from 1; 0 if it did not come from a list.
        options: what differs from the batch's defaults for this video (subject, time span, preset, overrides).
    """

    video_id: str
    source: str
    line: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BatchManifest:
    """What was submitted under a name.

    Attributes:
        schema_version: of this format.
        batch: the name.
        created_at: UTC, ISO 8601, by the submitter's clock: for people, not for ordering.
        defaults: what holds for every video unless its options say otherwise (preset, overrides, settings).
        entries: the videos, in the order of the list.
    """

    schema_version: int
    batch: str
    created_at: str
    defaults: Mapping[str, Any]
    entries: tuple[BatchEntry, ...]

    @classmethod
    def of(cls, batch: str, entries: Iterable[BatchEntry], defaults: Mapping[str, Any] | None = None) -> BatchManifest:
        """A manifest of now, with every credential taken out.

        Raises:
            ArtifactError: the batch or a video's id is not a name.
            ValueError: no entries, or two with one id.
        """
        check_name(batch, "batch")
        kept = tuple(
            BatchEntry(entry.video_id, redact_url(entry.source), entry.line, redact_json(entry.options))
            for entry in entries
        )
        if not kept:
            raise ValueError(f"batch {batch}: expected at least one video, got none; correct the list")
        _check_ids(kept)
        now = datetime.now(UTC).isoformat(timespec="microseconds")  # two submits within one are told apart by it
        return cls(BATCH_VERSION, batch, now, redact_json(defaults or {}), kept)

    def entry(self, video_id: str) -> BatchEntry:
        """The entry of a video.

        Raises:
            KeyError: there is none; the message names those that look like it.
        """
        for entry in self.entries:
            if entry.video_id == video_id:
                return entry
        close = difflib.get_close_matches(video_id, [entry.video_id for entry in self.entries], 3, 0.3)
        raise KeyError(f"batch {self.batch} has no video {video_id!r}" + (f"; like it are {close}" if close else ""))

    def to_json(self) -> bytes:
        """Readable JSON with a checksum of itself."""
        return seal(asdict(self), "batch")

    @classmethod
    def from_json(cls, data: bytes) -> BatchManifest:
        """Read what `to_json` wrote, at this or an older version.

        Raises:
            CorruptError: the bytes are not a whole, unchanged batch manifest.
            StoreVersionError: a newer version of this software wrote it.
        """
        body = unseal(data, "batch", BATCH_VERSION, UPGRADES)
        if set(body) != {field.name for field in fields(cls)}:
            raise CorruptError(
                f"batch manifest has fields {sorted(body)}, expected {sorted(field.name for field in fields(cls))}"
            )
        entries = tuple(BatchEntry(**entry) for entry in body.pop("entries"))
        return cls(entries=entries, **body)


def submit(store: ArtifactStore, manifest: BatchManifest) -> tuple[BatchManifest, bool]:
    """Write a batch's manifest unless it is there.

    Returns:
        The manifest that counts, and whether it is this one. A second submit of the same list, by whomever and at the
        same time, gets the first's.

    Raises:
        BatchExistsError: another list was submitted under this name; the message says what differs.
        CorruptError, StoreVersionError: what is there cannot be read.
        StoreFullError: no room; nothing was written.
    """
    if store.backend.create(batch_path(manifest.batch), manifest.to_json()):
        return manifest, True
    there = read_batch(store, manifest.batch)
    if there == manifest:
        # The answer to our own write was lost on the way and the client asked again.
        return there, True
    if differences := _differences(there, manifest):
        raise BatchExistsError(
            f"batch {manifest.batch} was submitted before ({there.created_at}) with another list: "
            f"{'; '.join(differences)}. Submit under another name, or submit the list it was made from"
        )
    return there, False


def read_batch(store: ArtifactStore, batch: str) -> BatchManifest:
    """The manifest of a batch.

    Raises:
        ArtifactError: not a name.
        UnknownBatchError: there is none; the message names those there are.
        CorruptError: it is damaged; the message says what to do.
        StoreVersionError: a newer version of this software wrote it.
    """
    check_name(batch, "batch")
    path = batch_path(batch)
    try:
        manifest = BatchManifest.from_json(store.backend.read(path))
    except FileNotFoundError:
        raise UnknownBatchError(_unknown(batch, list_batches(store), store.url)) from None
    except (CorruptError, TypeError) as error:
        raise CorruptError(
            f"{store.url}/{path}: {error}. Move the file away and submit the list again under the same name: "
            "finished stages are found by their content and not made again"
        ) from error
    if manifest.batch != batch:
        raise CorruptError(f"{store.url}/{path} is of batch {manifest.batch}; move it back to its own folder")
    return manifest


def list_batches(store: ArtifactStore) -> list[str]:
    """Names of all batches, sorted; also those whose manifest cannot be read."""
    return [name for name in store.backend.names("batches") if store.backend.names(f"batches/{name}")]


def cancel_batch(store: ArtifactStore, batch: str, reason: str = "") -> bool:
    """Mark a batch as cancelled: nothing of it may be started from now on.

    Returns:
        Whether this call did it; False if it was cancelled before.

    Raises:
        UnknownBatchError: there is no such batch.
    """
    read_batch(store, batch)
    marker = {"schema_version": 1, "cancelled_at": datetime.now(UTC).isoformat(), "reason": redact_json(reason)}
    return store.backend.create(_marker(batch), seal(marker, "cancelled"))


def is_cancelled(store: ArtifactStore, batch: str) -> bool:
    """Whether a batch is cancelled; cheap enough to be asked before every video and stage. A damaged marker counts."""
    check_name(batch, "batch")
    try:
        return store.backend.size(_marker(batch)) >= 0
    except FileNotFoundError:
        return False


def resume_batch(store: ArtifactStore, batch: str) -> None:
    """Take the mark of `cancel_batch` away; nothing happens if there is none."""
    check_name(batch, "batch")
    store.backend.remove(_marker(batch))


def batch_path(batch: str) -> str:
    """Where the manifest of a batch lies, relative to the root of the store."""
    return f"batches/{batch}/manifest.json"


def _marker(batch: str) -> str:
    return f"batches/{batch}/cancelled.json"


def _check_ids(entries: Sequence[BatchEntry]) -> None:
    lines: dict[str, int] = {}
    for entry in entries:
        check_name(entry.video_id, f"video_id of line {entry.line}")
        if entry.video_id in lines:
            raise ValueError(
                f"lines {lines[entry.video_id]} and {entry.line} have the same video_id {entry.video_id!r}; "
                "drop one of them or give them different ids"
            )
        lines[entry.video_id] = entry.line


def _differences(there: BatchManifest, new: BatchManifest) -> list[str]:
    """What a person would call different; lines and dates are not, nor is the order."""
    old, now = ({e.video_id: e for e in m.entries} for m in (there, new))
    found = []
    for label, ids in (
        ("new here", [i for i in now if i not in old]),
        ("missing here", [i for i in old if i not in now]),
        ("another source", [i for i in now if i in old and now[i].source != old[i].source]),
        ("other options", [i for i in now if i in old and now[i].options != old[i].options]),
        ("other defaults", [k for k in {**there.defaults, **new.defaults} if _differs(there, new, k)]),
    ):
        if ids:
            more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
            found.append(f"{label}: {', '.join(sorted(ids)[:_NAMED])}{more}")
    return found


def _differs(there: BatchManifest, new: BatchManifest, key: str) -> bool:
    missing = object()
    return bool(there.defaults.get(key, missing) != new.defaults.get(key, missing))


def _unknown(batch: str, names: list[str], url: str) -> str:
    close = difflib.get_close_matches(batch, names, 3, 0.5) or names[:_NAMED]
    have = f"it has {', '.join(close)}" if names else "it has none yet"
    return f"no batch {batch!r} in {url}; {have}. Check the name and --store"
