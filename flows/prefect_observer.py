"""Shows a run on Prefect's run page: progress, time per stage, and pictures.

Pictures go into markdown artifacts as small inline JPEGs: the server may not be able to read the store.
"""

from __future__ import annotations

import base64
import contextlib
import time
from pathlib import Path
from uuid import UUID

import cv2
from prefect.artifacts import create_markdown_artifact, create_progress_artifact, update_progress_artifact
from prefect.exceptions import MissingContextError
from prefect.logging import get_run_logger

from ahoy_core.formats.images import read_png
from tasks.stage import StageRef

UPDATE_S = 2.0  # an API call per frame would cost more than the frame
PICTURE_WIDTH = 640


class PrefectObserver:
    """An `Observer` for use inside a flow run."""

    def __init__(self) -> None:
        self._bars: dict[str, UUID] = {}
        self._last = 0.0

    def started(self, stage: str) -> None:
        """Log the stage's start."""
        with contextlib.suppress(MissingContextError):
            get_run_logger().info("%s: started", stage)

    def progress(self, stage: str, done: int, total: int, note: str) -> None:
        """Move the stage's progress artifact, at most every `UPDATE_S` seconds."""
        now = time.monotonic()
        if now - self._last < UPDATE_S and done < total:
            return
        self._last = now
        percent = 100.0 * done / max(total, 1)
        if stage in self._bars:
            update_progress_artifact(self._bars[stage], percent, description=note or None)
        else:
            made = create_progress_artifact(percent, key=f"progress-{stage}", description=note or stage)
            self._bars[stage] = made if isinstance(made, UUID) else UUID(str(made))

    def finished(self, ref: StageRef, folder: Path) -> None:
        """Publish the stage's bill and its pictures."""
        bill = ref.bill
        lines = [
            f"**{ref.stage}**: {ref.state}, {bill.wall_s:.1f} s, {bill.cpu_s:.1f} s CPU, {bill.peak_rss_mb:.0f} MB",
            f"artifact `{ref.key[:16]}`",
        ]
        lines += [f"![{path.name}](data:image/jpeg;base64,{_thumbnail(path)})" for path in sorted(folder.glob("*.png"))]
        create_markdown_artifact("\n\n".join(lines), key=f"stage-{ref.stage}", description=f"what {ref.stage} made")


def _thumbnail(path: Path) -> str:
    picture = read_png(path)[..., :3]
    scale = min(1.0, PICTURE_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return base64.b64encode(
        cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    ).decode()
