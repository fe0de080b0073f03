"""From a list to a batch: its name, its manifest, and a feeder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.batch.queue import Queue
from flows.feed_batch import FeedRequest
from flows.lists import ListEntry
from flows.serve.install import FEED_BATCH
from storage_schema.batches import BatchEntry, BatchManifest
from storage_schema.keys import canonical_json
from tasks.sources import safe_name

_DIGITS = 8


def batch_entries(entries: Sequence[ListEntry]) -> list[BatchEntry]:
    """Return the videos with ids that are the same whenever the same line is read."""
    made = []
    for entry in entries:
        options = entry.options.model_dump(mode="json", exclude_none=True)
        video_id = f"{entry.name}-{_digest({'source': entry.source, 'options': options})}"
        made.append(BatchEntry(video_id, entry.source, entry.line, options))
    return made


def batch_manifest(
    source: str, entries: Sequence[ListEntry], defaults: Mapping[str, Any], name: str | None
) -> BatchManifest:
    """Return the manifest of a list.

    Args:
        source: the list's path, or `-`; part of the name that is made up.
        entries: its videos.
        defaults: fields of `VideoRequest` that hold for all.
        name: of the batch; by default made of the list's content and the defaults, so that the same list submitted
            twice is one batch.
    """
    videos = batch_entries(entries)
    if name is None:
        said = {"videos": sorted(video.video_id for video in videos), "defaults": dict(defaults)}
        stem = "stdin" if source == "-" else re.sub(r"\.(txt|csv|parquet|pq)$", "", Path(source).name)
        name = f"{safe_name(stem)}-{_digest(said)}"
    return BatchManifest.of(name, videos, defaults)


async def start_feeder(queue: Queue, request: FeedRequest) -> tuple[str, bool]:
    """Start feeding a batch unless somebody does so already.

    Returns:
        Id of the feeder's run, and whether this call started it.
    """
    if not request.selects:
        async for run in queue.runs(FEED_BATCH, live=True):
            return str(run.id), False
    run = await queue.start_feeder(request.model_dump(mode="json"))
    return str(run.id), True


def _digest(value: object) -> str:
    return hashlib.sha256(canonical_json(value)).hexdigest()[:_DIGITS]
