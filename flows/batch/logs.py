"""What the runs of a batch logged."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection

from prefect.client.schemas.filters import LogFilter, LogFilterFlowRunId
from prefect.client.schemas.sorting import LogSort

from flows.batch.queue import PAGE, Queue, seen_run


async def batch_logs(queue: Queue, videos: Collection[str]) -> AsyncIterator[str]:
    """Lines of all runs, or of those of some videos, by video and attempt.

    Args:
        queue: of the batch.
        videos: their ids; none for all.
    """
    found = [seen async for run in queue.runs() if (seen := seen_run(run)) and (not videos or seen.video_id in videos)]
    for seen in sorted(found, key=lambda seen: (seen.video_id, seen.attempt)):
        yield f"== {seen.video_id} #{seen.attempt}: {seen.state}"
        offset = 0
        while True:
            page = await queue.client.read_logs(
                LogFilter(flow_run_id=LogFilterFlowRunId(any_=[seen.flow_run_id])),
                limit=PAGE,
                offset=offset,
                sort=LogSort.TIMESTAMP_ASC,
            )
            for log in page:
                yield f"{log.timestamp:%H:%M:%S} {log.message}"
            if len(page) < PAGE:
                break
            offset += PAGE
