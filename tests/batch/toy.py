"""Three stages that do nothing but what their video tells them, in the real flow, on a real server and real workers.

A toy video is a JSON file: its name, and per stage what the first, second, ... execution does: `ok`, `hold` (until a
file appears), `nap`, `die` (SIGKILL), `crash` (a segmentation fault), `bad` (input), `break` (a connection), `bug`.
Each execution leaves a line in `<video>.effects` before it starts and one when it is done, so that tests can count.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.process_video import as_flow
from storage_schema.artifacts import Blob
from tasks.errors import BadInputError
from tasks.settings import Settings
from tasks.stage import Stage, StageContext, StageOutput

NAMES = ("ingest", "perceive", "texture")
HELD_S = 120.0


@dataclass(frozen=True)
class Toy:
    """A toy video on disk."""

    path: Path

    @classmethod
    def make(cls, folder: Path, name: str, **does: list[str]) -> Toy:
        """Write one; stages that are not named do `ok`."""
        path = folder / f"{name}.mp4"
        path.write_text(json.dumps({"name": name, "effects": str(folder / f"{name}.effects"), "does": does}))
        return cls(path)

    @property
    def effects(self) -> Path:
        return self.path.with_suffix(".effects")

    def release(self) -> None:
        """Let what holds go on."""
        self.path.with_suffix(".go").touch()

    def lines(self) -> list[list[str]]:
        """Stage, `start` or `made`, process id, time: in the order in which they happened."""
        return [line.split() for line in self.effects.read_text().splitlines()] if self.effects.exists() else []

    def count(self, what: str) -> Counter[str]:
        """Stage -> how often it started or was made."""
        return Counter(line[0] for line in self.lines() if line[1] == what)

    def pid(self, stage: str) -> int | None:
        """The process at work on a stage, None if it has not come to it."""
        pids = [int(line[2]) for line in self.lines() if line[:2] == [stage, "start"]]
        return pids[-1] if pids else None


def _note(script: dict[str, Any], stage: str, what: str) -> int:
    """Append a line; how many executions of the stage there were before."""
    path = Path(script["effects"])
    before = Toy(path.with_suffix(".mp4")).count("start")[stage]
    with path.open("a") as file:
        file.write(f"{stage} {what} {os.getpid()} {time.time():.6f}\n")
    return before


def _act(action: str, script: dict[str, Any]) -> None:
    if action == "hold":
        deadline = time.monotonic() + HELD_S
        while not Path(script["effects"]).with_suffix(".go").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
    elif action == "nap":
        time.sleep(0.5)
    elif action == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    elif action == "crash":
        ctypes.string_at(0)
    elif action == "bad":
        raise BadInputError(f"expected a video, got {script['name']!r}; give another")
    elif action == "break":
        raise ConnectionResetError("the connection was lost")
    elif action == "bug":
        raise RuntimeError("a defect of ours")


def _stage(name: str, need: str) -> Stage:
    def run(config: Any, ctx: StageContext) -> StageOutput:
        given = ctx.inputs[need]
        script = json.loads((given if given.is_file() else given / "script.json").read_text())
        actions = script["does"].get(name, [])
        number = _note(script, name, "start")
        _act(actions[number] if number < len(actions) else "ok", script)
        (ctx.out / "script.json").write_text(json.dumps(script))
        _note(script, name, "made")
        return StageOutput(summary={"facts": {"name": script["name"]}})

    slots = (lambda config: ("gpu",)) if name == "texture" else (lambda config: ())
    return Stage(name, 1, Settings.model_fields[name].annotation, (need,), run, slots=slots)


STAGES = tuple(_stage(name, need) for name, need in zip(NAMES, ("source", *NAMES), strict=False))
ARTIFACTS = {name: (Blob("script.json"),) for name in NAMES}

process_video = as_flow(STAGES, ARTIFACTS)
