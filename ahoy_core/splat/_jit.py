"""How the kernels are compiled: once per machine, without the GIL, and announced."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, Final

import numba
from numba.core import event
from numba.extending import intrinsic as _intrinsic

_LOGGER = logging.getLogger("ahoy_core.splat")

kernel: Final[Callable[[Any], Any]] = functools.partial(numba.njit, nogil=True, cache=True, error_model="numpy")
"""Decorator of everything that runs in machine code. No fastmath flag: NaN rows are told apart by comparisons."""

inlined: Final[Callable[[Any], Any]] = functools.partial(
    numba.njit, nogil=True, cache=True, error_model="numpy", forceinline=True
)
"""Of functions that hand vectors to each other: a call would push sixteen lanes through memory."""

intrinsic: Final[Callable[[Any], Any]] = _intrinsic
"""Decorator of what is written directly in LLVM's language."""


class _Announcement(event.Listener):
    """Says once that kernels are being compiled; silent when they come from the cache."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        dispatcher = event.data["dispatcher"]
        if self.said or not dispatcher.py_func.__module__.startswith(__package__):
            return
        self.said = True
        _LOGGER.warning(
            "compiling the rasterizer's kernels for this machine: up to about 30 s of CPU time, "
            "once per dtype and number of channels; cached for later runs"
        )

    def on_end(self, event: Any) -> None:
        """Nothing to say."""


event.register("numba:compile", _Announcement())
