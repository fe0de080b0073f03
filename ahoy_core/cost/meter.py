"""What a piece of work cost: wall and CPU seconds, and the most memory the process held."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from types import TracebackType

import psutil

SAMPLE_S = 0.1  # memory is sampled: a peak shorter than this can be missed


@dataclass(frozen=True)
class Bill:
    """Seconds and mebibytes; zeros for what cost nothing."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0


class Meter:
    """Measures the whole process (all threads) between entering and leaving; `read` works inside and after."""

    def __init__(self) -> None:
        self._process = psutil.Process(os.getpid())
        self._stop = threading.Event()
        self._peak = 0
        self._start: tuple[float, float] | None = None
        self._final: Bill | None = None

    def __enter__(self) -> Meter:
        self._start = time.perf_counter(), time.process_time()
        self._sample()
        self._thread = threading.Thread(target=self._watch, name="ahoy-meter", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._final = self.read()

    def read(self) -> Bill:
        """Return the bill so far; after leaving, the final one; before entering, an empty one."""
        if self._final is not None:
            return self._final
        if self._start is None:
            return Bill()
        self._sample()
        wall, cpu = time.perf_counter() - self._start[0], time.process_time() - self._start[1]
        return Bill(round(wall, 6), round(cpu, 6), round(self._peak / 2**20, 1))

    def _sample(self) -> None:
        self._peak = max(self._peak, self._process.memory_info().rss)

    def _watch(self) -> None:
        while not self._stop.wait(SAMPLE_S):
            self._sample()
