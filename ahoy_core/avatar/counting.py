"""How much work a network does, counted and not timed: the same on every machine and on every run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn


def multiplications(network: nn.Module, run: Callable[[], Any]) -> int:
    """Those of the network's convolutions while `run` runs: each output value takes one for every weight behind it."""
    counts: list[int] = []

    def count(module: nn.Module, inputs: Any, output: Tensor) -> None:
        weight = module.weight
        if isinstance(weight, Tensor) and weight.ndim == 4:
            counts.append(output.numel() * (weight.numel() // weight.shape[0]))

    hooks = [layer.register_forward_hook(count) for layer in network.modules() if hasattr(layer, "weight")]
    try:
        run()
    finally:
        for hook in hooks:
            hook.remove()
    return sum(counts)
