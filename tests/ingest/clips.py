"""Clips that the tests encode for themselves, and measures to compare what comes back."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.reformatter import Colorspace


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth random colours with a white upper left corner, so that a wrong turn or flip is far off. uint8 [H,W,3]."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(30, 220, (6, 8, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    image[: height // 3, : width // 3] = 255
    return image


def moving(count: int, height: int = 48, width: int = 64, seed: int = 0) -> list[np.ndarray]:
    """`count` pictures that drift slowly, every one different."""
    wide = picture(height, width + count, seed)
    return [np.ascontiguousarray(wide[:, i : i + width]) for i in range(count)]


def encode(
    path: Path,
    pictures: Sequence[np.ndarray],
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    container: str | None = None,
    rate: int = 25,
    times: Sequence[int] | None = None,
    rotation: float | None = None,
    hflip: bool = False,
    pixel_aspect: Fraction | None = None,
    transfer: int | None = None,
    options: dict[str, str] | None = None,
    muxer: dict[str, str] | None = None,
) -> Path:
    """Encode RGB or RGBA pictures; `times` are milliseconds. Tagged BT.601, limited range."""
    with av.open(str(path), "w", format=container, container_options=muxer or {}) as output:
        stream = output.add_stream(codec, rate=rate, options=options or ({"crf": "8"} if codec == "libx264" else {}))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pix_fmt
        if not pix_fmt.startswith(("rgb", "bgr", "gbr", "argb")):
            stream.codec_context.colorspace = 6
        if pix_fmt == "gray":  # the conversion gives full range here
            stream.codec_context.color_range = 2
        if transfer is not None:
            stream.codec_context.color_trc = transfer
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation is not None or hflip:
            stream.set_display_rotation(rotation or 0, hflip=hflip)
        for number, image in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(image, format="rgba" if image.shape[2] == 4 else "rgb24")
            frame = frame.reformat(format=pix_fmt, dst_colorspace=Colorspace.ITU601)
            frame.pts = number if times is None else times[number]
            frame.time_base = Fraction(1, rate) if times is None else Fraction(1, 1000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    return path


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Decibels between two 8-bit pictures of one shape."""
    assert a.shape == b.shape, (a.shape, b.shape)
    error = np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))
