"""Pictures of an evaluation: input, made, truth and error of every frame, and the chart of the scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ahoy_core.captures.capture import View
from ahoy_core.conventions import GREY, Cameras
from ahoy_core.formats.images import contact_sheet, to_uint8, write_png
from ahoy_core.metrics.compare import Row
from ahoy_core.metrics.score import REFERENCES
from tasks.evaluation.tables import Spread, spread
from tasks.evaluation.truths import Shot, Truths

ERROR_GAIN = 4  # mean absolute error of the channels, shown this many times brighter
CHARTED = ("novel-view-gt", "novel-pose-gt", "novel-view-est", "held-out-frame")
_BLUR = 0.35  # of the head's box


@dataclass(frozen=True)
class Picture:
    """One picture that was made: rgba [H,W,4] uint8, RGB over grey 0.5 and alpha."""

    protocol: str
    view: View
    rgba: np.ndarray


def draw_pictures(truths: Truths, config: str, pictures: Sequence[Picture], rows: Sequence[Row], out: Path) -> int:
    """Write a PNG per picture: input, made, truth, error; faces are blurred where the data set asks for it.

    Args:
        truths: of the capture.
        config: name of the configuration.
        pictures: what it made.
        rows: its scores, for the labels.
        out: folder for the files.

    Returns:
        How many were written.
    """
    out.mkdir(parents=True, exist_ok=True)
    scores = {(r["protocol"], r["camera"], r["frame"]): r["psnr"] for r in rows if r["region"] == "box"}
    for picture in pictures:
        view, shot = picture.view, truths.shot(picture.protocol, picture.view)
        if shot is None:
            continue
        psnr = scores.get((picture.protocol, view.camera, view.frame))
        label = config if psnr is None else f"{config} {psnr:.2f} dB"
        panels = _panels(truths, shot, picture.rgba[..., :3])
        sheet = contact_sheet(panels, ("input", label, "ground truth", f"error x{ERROR_GAIN}"), columns=4)
        write_png(out / f"{picture.protocol}_{view.camera}_{view.frame:03d}.png", sheet)
    return len(pictures)


def _panels(truths: Truths, shot: Shot, made: np.ndarray) -> list[np.ndarray]:
    truth = shot.truth
    target = to_uint8(truth.rgb * truth.alpha + GREY * (1 - truth.alpha))
    if shot.view.moment == "input":
        alpha = truth.alpha.numpy()[..., None]
        made = (made * alpha + 255 * GREY * (1 - alpha)).round().astype(np.uint8)
    error = np.abs(made.astype(np.int16) - target).mean(-1) * truth.known.numpy()
    shown = cv2.applyColorMap(np.clip(error * ERROR_GAIN, 0, 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    panels = [made, target, np.ascontiguousarray(shown[..., ::-1])]
    if truths.capture.blur_faces:
        head = truth.head or (0, 0, made.shape[1], made.shape[0] // 3)
        panels = [*(_blurred(panel, head) for panel in panels[:2]), panels[2]]
    return [_input(truths, shot, target.shape), *panels]


def _input(truths: Truths, shot: Shot, shape: tuple[int, ...]) -> np.ndarray:
    """The input at that moment; grey where the input does not show it."""
    fitted, view = truths.fitted, shot.view
    if fitted is None or view.moment == "pose":
        return np.full(shape, round(255 * GREY), np.uint8)
    rows = np.flatnonzero(fitted.index == view.frame)
    if not len(rows):
        return np.full(shape, round(255 * GREY), np.uint8)
    frame: np.ndarray = fitted.frames[int(rows[0])]
    if not truths.capture.blur_faces or truths.surface is None:
        return frame
    own = truths.capture.cameras[truths.capture.input_camera]
    scale = frame.shape[1] / own.width
    Ks = own.Ks.clone()
    Ks[:, :2] *= scale
    camera = Cameras(own.viewmats, Ks, frame.shape[1], frame.shape[0])
    head = truths.surface.look("view", view.frame, camera).head
    return _blurred(frame, head or (0, 0, frame.shape[1], frame.shape[0] // 3))


def _blurred(picture: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
    x0, y0, x1, y1 = box
    out = picture.copy()
    sigma = max(1.0, _BLUR * max(x1 - x0, y1 - y0))
    out[y0:y1, x0:x1] = cv2.GaussianBlur(out[y0:y1, x0:x1], (0, 0), sigma)
    return out


def draw_chart(rows: Sequence[Row], path: Path) -> bool:
    """PSNR in the mask box by configuration, a panel a protocol: bars with intervals, or every capture as a dot."""
    chosen = {
        protocol: same
        for protocol in CHARTED
        if (same := [row for row in rows if row["protocol"] == protocol and row["region"] == "box"])
        and len({row["protocol_id"] for row in same}) == 1
    }
    if not chosen:
        return False
    figure = Figure(figsize=(max(4.5, 4.2 * len(chosen)), 4), dpi=110, layout="constrained")
    for axes, (protocol, same) in zip(figure.subplots(1, len(chosen), squeeze=False)[0], chosen.items(), strict=True):
        _bars(axes, spread(same), protocol)
    figure.savefig(path)
    return True


def _bars(axes: Axes, found: Mapping[str, Spread], title: str) -> None:
    names = list(found)
    colours = ["0.7" if name in REFERENCES else "C0" for name in names]
    axes.bar(range(len(names)), [found[name][0] for name in names], color=colours)
    for place, name in enumerate(names):
        mean, between, values = found[name]
        if between:
            span = [[mean - between[0]], [between[1] - mean]]
            axes.errorbar(place, mean, span, color="k", capsize=4)
        else:
            axes.plot([place] * len(values), values, "k.", ms=6)
        axes.annotate(f"{mean:.1f}", (place, 0), (0, 4), textcoords="offset points", ha="center", color="w", size=8)
    axes.set(title=title, ylabel="PSNR in the mask box, dB")  # from 0: a bar's length must mean something
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
