"""One batch on a fleet of workers and slots, as a discrete-event simulation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import simpy

WORKER = "worker"


@dataclass(frozen=True)
class MeasuredAttempt:
    """One attempt at a video: its stages and their wall seconds, in order, and what it took beside them."""

    steps: tuple[tuple[str, float], ...]
    overhead_s: float = 0.0
    done: bool = True


@dataclass(frozen=True)
class MeasuredVideo:
    """All attempts at one video, in order."""

    attempts: tuple[MeasuredAttempt, ...]


@dataclass(frozen=True)
class Fleet:
    """What the batch runs on.

    Attributes:
        workers: videos side by side.
        slots: resource (gpu, download, ...) -> how many stages may hold it at once.
        needs: stage -> resource it holds while it runs.
        per_machine: workers on one machine.
        price_per_hour: of one machine, in whatever currency.
        pause_s: between a failed attempt and the next.
    """

    workers: int
    slots: Mapping[str, int] = field(default_factory=dict)
    needs: Mapping[str, str] = field(default_factory=dict)
    per_machine: int = 1
    price_per_hour: float = 0.0
    pause_s: float = 0.0

    def __post_init__(self) -> None:
        if self.workers < 1 or self.per_machine < 1 or any(count < 1 for count in self.slots.values()):
            raise ValueError(f"fleet: expected at least one worker, worker per machine and slot, got {self}")
        if unknown := sorted(set(self.needs.values()) - set(self.slots)):
            raise ValueError(f"fleet: stages need {unknown}, of which there are no slots; have {sorted(self.slots)}")

    @property
    def machines(self) -> int:
        """How many are rented."""
        return math.ceil(self.workers / self.per_machine)

    def cost(self, seconds: float) -> float:
        """Price of renting every machine for so long."""
        return self.machines * self.price_per_hour * seconds / 3600

    def grown(self, resource: str) -> Fleet:
        """The fleet with one more worker or slot."""
        if resource == WORKER:
            return dataclasses.replace(self, workers=self.workers + 1)
        return dataclasses.replace(self, slots={**self.slots, resource: self.slots[resource] + 1})


@dataclass(frozen=True)
class Use:
    """How a resource was used.

    Attributes:
        capacity: how many may hold it.
        utilisation: share of the capacity that was at work; a worker that waits for a slot is not.
        wait_s: mean wait per request.
        waiting: mean number of requests that wait.
    """

    capacity: int
    utilisation: float
    wait_s: float
    waiting: float


@dataclass(frozen=True)
class Simulated:
    """One simulated batch."""

    makespan_s: float
    uses: Mapping[str, Use]
    attempts: int
    failed: int


def simulate(batch: Sequence[MeasuredVideo], fleet: Fleet) -> Simulated:
    """Run exactly these videos through a fleet, first come, first served.

    A worker is held for the whole attempt, also while the attempt waits for a slot. A failed attempt lets go of its
    worker; the next one queues behind what waits by then.
    """
    env = simpy.Environment()
    resources = {name: _Counted(env, size) for name, size in {WORKER: fleet.workers, **fleet.slots}.items()}
    for video in batch:
        env.process(_video(env, video, fleet, resources))
    env.run()
    makespan = max(resource.last_s for resource in resources.values())
    # A worker is held while its attempt waits for a slot, but not at work.
    idle = sum(resource.waited_s for name, resource in resources.items() if name != WORKER)
    return Simulated(
        makespan,
        {name: resource.use(makespan, idle if name == WORKER else 0.0) for name, resource in resources.items()},
        sum(len(video.attempts) for video in batch),
        sum(not video.attempts[-1].done for video in batch),
    )


class _Counted:
    """A resource that counts how long it was held and waited for."""

    def __init__(self, env: simpy.Environment, capacity: int) -> None:
        self._env = env
        self._resource = simpy.Resource(env, capacity)
        self._capacity = capacity
        self._busy_s = self.waited_s = self.last_s = 0.0
        self._requests = 0

    def held(self, body: Generator[Any, Any, None]) -> Generator[Any, Any, None]:
        """Wait for the resource and hold it while `body` runs."""
        asked = self._env.now
        with self._resource.request() as request:
            yield request
            got = self._env.now
            yield from body
        self._requests += 1
        self.waited_s += got - asked
        self._busy_s += self._env.now - got
        self.last_s = self._env.now

    def use(self, makespan_s: float, idle_s: float) -> Use:
        """Totals as rates."""
        whole = makespan_s if makespan_s > 0 else 1.0
        wait = self.waited_s / max(self._requests, 1)
        return Use(self._capacity, (self._busy_s - idle_s) / (self._capacity * whole), wait, self.waited_s / whole)


def _video(
    env: simpy.Environment, video: MeasuredVideo, fleet: Fleet, resources: Mapping[str, _Counted]
) -> Generator[Any, Any, None]:
    for number, attempt in enumerate(video.attempts):
        if number:
            yield env.timeout(fleet.pause_s)
        yield from resources[WORKER].held(_attempt(env, attempt, fleet, resources))


def _attempt(
    env: simpy.Environment, attempt: MeasuredAttempt, fleet: Fleet, resources: Mapping[str, _Counted]
) -> Generator[Any, Any, None]:
    for resource, seconds in _segments(attempt, fleet):
        if resource is None:
            yield env.timeout(seconds)
        else:
            yield from resources[resource].held(_wait(env, seconds))


def _wait(env: simpy.Environment, seconds: float) -> Generator[Any, Any, None]:
    yield env.timeout(seconds)


def _segments(attempt: MeasuredAttempt, fleet: Fleet) -> list[tuple[str | None, float]]:
    """Stages as one piece as long as they need no slot: fewer events for the same times."""
    pieces: list[tuple[str | None, float]] = [(None, attempt.overhead_s)]
    for stage, seconds in attempt.steps:
        resource = fleet.needs.get(stage)
        if resource is None and pieces[-1][0] is None:
            pieces[-1] = (None, pieces[-1][1] + seconds)
        else:
            pieces.append((resource, seconds))
    return pieces
