"""What a batch's manifest says of a video, as parameters of the flow `process-video`."""

from __future__ import annotations

from typing import Any

from storage_schema.batches import BatchEntry, BatchManifest


def video_parameters(manifest: BatchManifest, entry: BatchEntry, attempt: int, store_url: str) -> dict[str, Any]:
    """Return the fields of a `VideoRequest`: the batch's defaults, then what is said of this video alone."""
    return {
        **manifest.defaults,
        **entry.options,
        "video": entry.source,
        "video_id": entry.video_id,
        "batch": manifest.batch,
        "store": store_url,
        "attempt": attempt,
    }
