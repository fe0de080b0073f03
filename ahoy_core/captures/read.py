"""A data set by its folder: which layout it has, and its captures."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from ahoy_core.captures.behave import INPUT, is_behave, read_behave
from ahoy_core.captures.capture import Capture, TruePicture, View
from ahoy_core.captures.multiview import is_multiview, read_multiview
from ahoy_core.captures.ours import is_ours, read_ours

KINDS: Final = ("auto", "ours", "behave", "multiview", "videos")
VIDEO_ENDINGS: Final = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v")
OBSERVED: Final = "observed"
"""What the camera of a plain video is called."""


def read_dataset(
    path: Path, kind: str = "auto", input_camera: str = "", truth_body: Path | None = None
) -> list[Capture]:
    """The captures of a data set, by name.

    Args:
        path: root of the data set, one capture of it, or a video.
        kind: one of `KINDS`; "auto" looks at the files.
        input_camera: which camera's pictures are the input, where a layout leaves that open.
        truth_body: the user's body file that true SMPL parameters belong to.

    Raises:
        ValueError: no such kind, or nothing of it is there.
    """
    if kind not in KINDS:
        raise ValueError(f"expected a kind of data set among {', '.join(KINDS)}, got {kind!r}")
    if not path.exists():
        raise ValueError(f"expected a data set at {path}, got nothing there; give its folder")
    if kind in ("auto", "behave") and is_behave(path):
        return read_behave(path, input_camera or INPUT, truth_body)
    folders = [path, *sorted(child for child in path.iterdir() if child.is_dir())] if path.is_dir() else []
    if kind in ("auto", "ours") and (found := [folder for folder in folders if is_ours(folder)]):
        return [read_ours(folder) for folder in found]
    if kind in ("auto", "multiview") and (found := [folder for folder in folders if is_multiview(folder)]):
        return [read_multiview(folder, input_camera, truth_body) for folder in found]
    if kind in ("auto", "videos") and (clips := _videos(path)):
        return [_plain(clip) for clip in clips]
    raise ValueError(
        f"expected captures in {path} (kind {kind}): cameras.json with front.mp4, BEHAVE's sequences/ and calibs/, "
        "intri.yml with images/, or videos; got none of these; docs/metrics.md shows each layout"
    )


def _videos(path: Path) -> list[Path]:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return [file for file in files if file.is_file() and file.suffix.lower() in VIDEO_ENDINGS]


def _plain(clip: Path) -> Capture:
    def picture(view: View) -> TruePicture:
        raise ValueError(f"{clip.name} has no true pictures beside its own frames; {view} was asked for")

    return Capture(
        name=clip.stem, folder=clip, kind="videos", views=(), picture=picture, video=clip, input_camera=OBSERVED
    )
