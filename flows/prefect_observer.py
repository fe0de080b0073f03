"""Shows a run on Prefect's run page: progress, time per stage, and pictures.

Pictures go into markdown artifacts as small inline JPEGs: the server may not be able to read the store.
"""

from __future__ import annotations

import base64
import contextlib
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import UUID

import cv2
from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.exceptions import MissingContextError
from prefect.logging import get_run_logger

from ahoy_core.formats.images import read_png
from flows.pipeline import Outcome
from storage_schema.manifest import Manifest
from tasks.stage import Run, StageRef

UPDATE_S = 2.0  # an API call per frame would cost more than the frame
PICTURE_WIDTH = 640
OVERVIEW = (("perceive", "overlay.png"), ("animate", "turntable.png"))
LINKS = (("report", "report.html"), ("animate", "avatar.ply"), ("animate", "turntable.mp4"))


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
            made = create_progress_artifact(percent, key=_key(f"progress-{stage}"), description=note or stage)
            self._bars[stage] = made if isinstance(made, UUID) else UUID(str(made))

    def showed(self, stage: str, picture: Path) -> None:
        """Publish a picture of a stage at work; a later one takes its place on the page."""
        create_markdown_artifact(_inline(picture), key=_key(f"picture-{stage}"), description=f"{stage} at work")

    def finished(self, ref: StageRef, folder: Path) -> None:
        """Publish what the stage made if there is anything to see; an artifact costs the server a tenth of a second."""
        pictures = sorted(folder.glob("*.png"))
        if ref.state == "cached" or not pictures:
            return
        bill = ref.bill
        lines = [
            f"**{ref.title}**: {ref.state}, {bill.wall_s:.1f} s, {bill.cpu_s:.1f} s CPU, {bill.peak_rss_mb:.0f} MB",
            f"artifact `{ref.key[:16]}`",
        ]
        lines += [_inline(path) for path in pictures]
        create_markdown_artifact(
            "\n\n".join(lines), key=_key(f"stage-{ref.title}"), description=f"what {ref.title} made"
        )

    def summary(self, outcome: Outcome, run: Run) -> None:
        """Publish the run as a whole: time per stage and what was skipped, scores, pictures, where things are."""
        manifests = {
            name: manifest
            for name, ref in outcome.refs.items()
            if (manifest := run.store.lookup(ref.key, stage=name, verify=False)) is not None
        }
        create_table_artifact(
            _stage_rows(outcome), key="time-per-stage", description="what ran, for how long; what was skipped, and why"
        )
        if scores := _scores(manifests):
            create_table_artifact(scores, key="scores", description="what the stages say of their results")
        if pictures := _overview(manifests, run):
            create_markdown_artifact(
                pictures, key="overview", description="the body on the video, and the avatar from all sides"
            )
        for stage, name in LINKS:
            for blob in manifests[stage].blobs if stage in manifests else ():
                if blob.name == name:
                    link = f"{run.store.url}/{blob.path}"
                    create_link_artifact(link, link_text=name, key=_key(name), description=f"{name} in the store")


def _stage_rows(outcome: Outcome) -> list[dict[str, Any]]:
    rows = [
        {
            "stage": name,
            "state": "found in the store" if ref.state == "cached" else "made now",
            "wall s": round(ref.bill.wall_s, 2),
            "CPU s": round(ref.bill.cpu_s, 2),
            "peak MB": round(ref.bill.peak_rss_mb),
            "why": "",
        }
        for name, ref in outcome.refs.items()
    ]
    blank = {"wall s": "", "CPU s": "", "peak MB": ""}
    return rows + [{"stage": name, "state": "skipped", **blank, "why": why} for name, why in outcome.skipped.items()]


def _scores(manifests: Mapping[str, Manifest]) -> list[dict[str, Any]]:
    return [
        {"stage": stage, "what": name.replace("_", " "), "value": str(value)}
        for stage, manifest in manifests.items()
        for name, value in manifest.summary.get("facts", {}).items()
    ]


def _overview(manifests: Mapping[str, Manifest], run: Run) -> str:
    shown = [
        (stage, name) for stage, name in OVERVIEW if stage in manifests and name in manifests[stage].summary["pictures"]
    ]
    paths = [run.store.fetch(manifests[stage], name) for stage, name in shown]
    return "\n\n".join(_inline(path) for path in paths)


def _inline(path: Path) -> str:
    return f"![{path.name}](data:image/jpeg;base64,{_thumbnail(path)})"


def _key(name: str) -> str:
    """Artifact keys are lower-case letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _thumbnail(path: Path) -> str:
    picture = read_png(path)[..., :3]
    scale = min(1.0, PICTURE_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return base64.b64encode(
        cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    ).decode()
