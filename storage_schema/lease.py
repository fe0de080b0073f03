"""Leases: a worker says that it is at work on a key, so that others do something else meanwhile.

A lease is a numbered file made by create-if-absent. The one who makes number n+1, once number n has expired, holds the
lease: of two who try, one does. It only saves work; what is published is decided by the commit alone.

Clocks of different machines need not agree. A holder renews by making the next number, so whoever watches for one time
to live by the own steady clock and sees no new number knows that the holder is gone, whatever the dates say. Dates
alone are believed on the machine that wrote them, and where they lie so far back that no clock is that wrong.
"""

from __future__ import annotations

import json
import logging
import platform
import threading
import time
import uuid
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Self

from storage_schema.backend import Backend

_LOG = logging.getLogger(__name__)
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.05, 5.0
# Clocks of machines that run a batch together are taken to agree to this; no harm but double work if they do not.
_SKEW_S = 300.0


@dataclass(frozen=True)
class Holder:
    """Who holds a lease: `owner` for people, `token` unique, until `expires_at` by the clock of `host`, in seconds."""

    owner: str
    token: str
    expires_at: float
    ttl_s: float
    host: str


class Lease:
    """See `ArtifactStore.lease`. Entering tries to take it; a thread renews it; leaving gives it back."""

    def __init__(self, backend: Backend, key: str, owner: str, ttl_s: float, wait_s: float) -> None:
        if not (ttl_s > 0 and wait_s >= 0):
            raise ValueError(f"lease: expected ttl_s > 0 and wait_s >= 0, got {ttl_s} and {wait_s}")
        self.held = False
        self._backend = backend
        self._folder = f"leases/{key}"
        self._owner = owner
        self._token = uuid.uuid4().hex
        self._ttl_s = ttl_s
        self._wait_s = wait_s
        self._stop = threading.Event()
        self._renewer: threading.Thread | None = None
        self._host = platform.node()
        self._seen: dict[int, tuple[str, float]] = {}

    def __bool__(self) -> bool:
        return self.held

    def __enter__(self) -> Self:
        deadline, pause = time.monotonic() + self._wait_s, _FIRST_WAIT_S
        self.held = self._take()
        while not self.held and time.monotonic() < deadline:
            time.sleep(min(pause, max(0.0, deadline - time.monotonic())))
            pause = min(2 * pause, _LONGEST_WAIT_S)
            self.held = self._take()
        if self.held:
            self._stop.clear()
            self._renewer = threading.Thread(target=self._renew, name="lease", daemon=True)
            self._renewer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._renewer is not None:
            self._stop.set()
            self._renewer.join()
            self._renewer = None
        if self.held:
            self.held = False
            self._release()

    def holder(self) -> Holder | None:
        """Who holds the key now; None if nobody does."""
        live = self._live()
        return live[min(live)] if live else None

    def _numbers(self) -> list[int]:
        names = (name.removesuffix(".json") for name in self._backend.names(self._folder))
        return sorted(int(name) for name in names if name.isdecimal())

    def _path(self, number: int) -> str:
        return f"{self._folder}/{number:04d}.json"

    def _live(self) -> dict[int, Holder]:
        """Holders that have not expired, by number."""
        live = {}
        for number in self._numbers():
            try:
                holder = Holder(**json.loads(self._backend.read(self._path(number))))
            except (FileNotFoundError, ValueError, TypeError):
                continue
            if not self._is_over(number, holder):
                live[number] = holder
        return live

    def _is_over(self, number: int, holder: Holder) -> bool:
        late_s = time.time() - holder.expires_at
        if holder.host == self._host:
            return late_s >= 0
        token, since = self._seen.setdefault(number, (holder.token, time.monotonic()))
        if token != holder.token:
            since = time.monotonic()
            self._seen[number] = (holder.token, since)
        return late_s > _SKEW_S or time.monotonic() - since > holder.ttl_s

    def _take(self) -> bool:
        """Make the next number, unless somebody else's lease is live."""
        numbers, live = self._numbers(), self._live()
        if any(holder.token != self._token for holder in live.values()):
            return False
        mine = max(numbers, default=0) + 1
        holder = Holder(self._owner, self._token, time.time() + self._ttl_s, self._ttl_s, self._host)
        if not self._backend.create(self._path(mine), json.dumps(asdict(holder)).encode("utf-8")):
            return False
        # A release between our look and our step can let a second one in at a lower number: that one keeps it.
        if any(other.token != self._token for number, other in self._live().items() if number < mine):
            self._backend.remove(self._path(mine))
            return False
        for number in numbers:
            self._backend.remove(self._path(number))
        return True

    def _renew(self) -> None:
        while not self._stop.wait(self._ttl_s / 3):
            try:
                held = self._take()
            except OSError as error:
                _LOG.warning("lease %s could not be renewed, trying again: %s", self._folder, error)
                continue
            if not held:
                self.held = False
                _LOG.warning(
                    "lease %s was lost: this worker was silent for longer than %.0f s", self._folder, self._ttl_s
                )
                return

    def _release(self) -> None:
        for number, holder in self._live().items():
            if holder.token == self._token:
                self._backend.remove(self._path(number))
