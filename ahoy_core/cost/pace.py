"""How fast this machine is now, in units that rows measured elsewhere can be scaled by.

One unit is a fixed piece of what training consists of: convolutions forward and backward, and a rasterization. It is
about as large as a step of a training: a quarter of it took twice its CPU seconds on two idle cores, which trainings do
not, because threads spent that time being woken.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from ahoy_core.conventions import look_at, perspective_K
from ahoy_core.splat import rasterization

_CHANNELS, _SIDE, _GAUSSIANS, _PICTURE = 16, 192, 30_000, 256


@dataclass(frozen=True)
class Pace:
    """Seconds of one unit.

    Attributes:
        cpu_s: CPU seconds on one thread, the fastest of several: other work only ever slows one down.
        wall_s: wall-clock seconds on as many threads as a run uses, the mean: with what else the machine is doing.
    """

    cpu_s: float
    wall_s: float


def measure_pace(seconds: float = 3.0) -> Pace:
    """Time the unit.

    Args:
        seconds: to spend, about.
    """
    unit = _unit()
    threads = torch.get_num_threads()
    unit(threads)
    try:
        torch.set_num_threads(1)
        cpu = _repeat(lambda: unit(1), time.process_time, seconds / 4)
    finally:
        torch.set_num_threads(threads)
    wall = _repeat(lambda: unit(threads), time.perf_counter, 3 * seconds / 4)
    return Pace(min(cpu), sum(wall) / len(wall))


def _repeat(work: Callable[[], None], clock: Callable[[], float], seconds: float) -> list[float]:
    took: list[float] = []
    until = time.perf_counter() + seconds
    while len(took) < 3 or time.perf_counter() < until:
        start = clock()
        work()
        took.append(clock() - start)
    return took


def _unit() -> Callable[[int], None]:
    """The unit, as a function of the number of threads that rasterize."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(1, _CHANNELS, _SIDE, _SIDE, generator=generator)
    weight = torch.randn(_CHANNELS, _CHANNELS, 3, 3, generator=generator, requires_grad=True)
    means = torch.randn(_GAUSSIANS, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.9])
    covars = (0.02**2 * torch.eye(3)).expand(_GAUSSIANS, 3, 3).contiguous()
    opacities = torch.full((_GAUSSIANS,), 0.8)
    colors: Tensor = torch.rand(_GAUSSIANS, 3, generator=generator).requires_grad_()
    viewmats = look_at(torch.tensor([0.0, -4.0, 0.0]), torch.zeros(3))[None]
    Ks = perspective_K(0.7, _PICTURE, _PICTURE)[None]

    def work(threads: int) -> None:
        value = image
        for _ in range(4):
            value = conv2d(value, weight, padding=1) * 0.1
        drawn, *_ = rasterization(
            means, None, None, opacities, colors, viewmats, Ks, _PICTURE, _PICTURE, covars=covars, num_threads=threads
        )
        (value.square().mean() + drawn.square().mean()).backward()

    return work
