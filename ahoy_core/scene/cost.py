"""What rendering costs: rates of this machine for estimates, and a ledger of what each effect really took.

The rasterizer's time is close to linear in four counts: Gaussians, those that are visible, tile intersections and
pixels. The coefficients were fitted by `python -m benchmarks.render --fit`; a machine differs by one factor, which
`calibrate` measures in under a second.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras, look_at, perspective_K
from ahoy_core.splat import Window, footprints, rasterization

_TILE = 16


class RasterLoad(NamedTuple):
    """Counts that decide what one rasterization costs."""

    gaussians: float
    visible: float
    intersections: float
    pixels: float

    def plus(self, other: RasterLoad) -> RasterLoad:
        """The load of both sets in one picture."""
        return RasterLoad(
            self.gaussians + other.gaussians,
            self.visible + other.visible,
            self.intersections + other.intersections,
            max(self.pixels, other.pixels),
        )


@dataclass(frozen=True)
class Rates:
    """CPU-seconds of one unit of work.

    Attributes:
        gaussian, visible, intersection, pixel: Of the rasterizer, per unit of `RasterLoad`.
        skin: Per avatar and frame: its body posed.
        joints: Per avatar and frame: its joints' transforms alone.
        map: Per multiplication of the network that gives a full avatar its Gaussians for a pose.
        pose: Per Gaussian of an avatar that is posed.
        carry: Per surface point whose normal is carried along.
        pair: Per pair of occluder and receiver of a contact shadow.
        shade: Per Gaussian whose colour is changed.
        pick: Per Gaussian of a scene that is looked through for those in a window.
        paste: Per pixel of a picture into which a window is drawn.
        curve: Per Gaussian of an avatar that is put between two poses.
        blend: Per pixel that is summed into a picture of several samples.
        write: Per pixel of a picture that is stored.
        face: Per avatar with an expression, once: what each action does; a frame then takes under a millisecond.
    """

    gaussian: float = 7.1e-8
    visible: float = 0.0
    intersection: float = 1.7e-7
    pixel: float = 1.8e-8
    skin: float = 0.0035
    joints: float = 0.0025
    map: float = 3.3e-10
    pose: float = 3.7e-7
    carry: float = 2.4e-7
    pair: float = 6.5e-9
    shade: float = 1.9e-7
    pick: float = 2.4e-8
    paste: float = 1.5e-9
    curve: float = 6.5e-9
    blend: float = 3.5e-8
    write: float = 6.5e-8
    face: float = 0.29

    def scaled(self, factor: float) -> Rates:
        """The same on a machine that takes `factor` times as long."""
        return Rates(*(value * factor for value in vars(self).values()))

    def raster(self, load: RasterLoad) -> float:
        """Seconds of one rasterization."""
        return (
            load.gaussians * self.gaussian
            + load.visible * self.visible
            + load.intersections * self.intersection
            + load.pixels * self.pixel
        )


def raster_load(
    means: Tensor, covars: Tensor, opacities: Tensor, cameras: Cameras, window: Window | None = None
) -> RasterLoad:
    """The load of rendering N Gaussians through the first of `cameras`, or a part of its picture.

    Args:
        means: [N,3] world.
        covars: [N,3,3].
        opacities: [N].
        cameras: The first one counts.
        window: The part of the picture; Gaussians that do not reach into it are not in the load.
    """
    view, K = cameras.viewmats[:1].contiguous(), cameras.Ks[:1].contiguous()
    box = footprints(means, covars, opacities, view, K, cameras.width, cameras.height)[0]
    return box_load(box, len(means), window or (0, 0, cameras.width, cameras.height), window is not None)


def box_load(box: Tensor, count: int, window: Window, picked: bool) -> RasterLoad:
    """The load of drawing a window over `count` Gaussians with footprints [N,4], or only those in it (`picked`)."""
    left, top, width, height = window
    low = torch.maximum(box[:, :2] - box.new_tensor([left, top]), box.new_zeros(2))
    high = torch.minimum(box[:, 2:] - box.new_tensor([left, top]), box.new_tensor([width, height]))
    seen = (high > low).all(1)
    tiles = ((high[seen] - 1).div(_TILE).floor() - low[seen].div(_TILE).floor() + 1).prod(1)
    visible = float(seen.sum())
    return RasterLoad(visible if picked else float(count), visible, float(tiles.sum()), float(width * height))


def calibrate(seconds: float = 0.4) -> Rates:
    """Rates of this machine: the standard ones times how long a small rasterization takes here, over what it should.

    Args:
        seconds: CPU time to spend, about; the fastest run counts, as other work only ever slows one down.
    """
    generator = torch.Generator().manual_seed(0)
    count, size = 40_000, 512
    means = torch.randn(count, 3, generator=generator) * torch.tensor([0.5, 0.5, 0.9])
    covars = (0.01**2 * torch.eye(3)).expand(count, 3, 3).contiguous()
    opacities, colors = torch.full((count,), 0.8), torch.rand(count, 3, generator=generator)
    view = look_at(torch.tensor([0.0, -4.0, 0.0]), torch.zeros(3))
    cameras = Cameras(view[None], perspective_K(0.7, size, size)[None], size, size)
    expected = Rates().raster(raster_load(means, covars, opacities, cameras))
    rasterize(means, covars, opacities, colors, cameras)
    best, spent = float("inf"), 0.0
    while spent < seconds:
        start = time.thread_time()
        rasterize(means, covars, opacities, colors, cameras)
        took = time.thread_time() - start
        best, spent = min(best, took), spent + max(took, 1e-3)
    return Rates().scaled(best / expected)


def rasterize(
    means: Tensor, covars: Tensor, opacities: Tensor, colors: Tensor, cameras: Cameras, window: Window | None = None
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """One rasterization on one thread: premultiplied colours [C,H,W,D], alphas [C,H,W,1], and the rasterizer's meta."""
    return rasterization(
        means,
        None,
        None,
        opacities,
        colors,
        cameras.viewmats,
        cameras.Ks,
        cameras.width,
        cameras.height,
        camera_model=cameras.camera_model,
        covars=covars,
        num_threads=1,
        window=window,
    )


@dataclass
class Ledger:
    """Calls, CPU-seconds and bytes of results of each part of the work, summed over threads."""

    calls: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Time a piece of work of this thread; what never enters here has no entry."""
        start = time.thread_time()
        try:
            yield
        finally:
            took = time.thread_time() - start
            with self._lock:
                self.calls[name] = self.calls.get(name, 0) + 1
                self.seconds[name] = self.seconds.get(name, 0.0) + took
