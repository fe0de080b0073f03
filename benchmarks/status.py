"""How long the status of a large batch takes: `python -m benchmarks.status --videos 10000 --json OUT`.

The batch is synthetic, its rows written one by one as runs write them (`storage_schema.tables.Tables.append`, by
`--writers` processes side by side): per video a row when it is scheduled, when it starts and when it ends, and one per
stage; one attempt in twenty fails in some stage and is tried again (`--together N` writes the rows of N
videos in one append, to save time where only the reading is asked for). Then `status` runs `--repeats` times in a fresh
process each, on one core: `status_s` is its wall time with the interpreter's start and all imports, `status_cpu_s` its
CPU time. `files` and `bytes` are what it found in the store.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ahoy_core.cost import machine
from storage_schema.batches import BatchEntry, BatchManifest, submit
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

BATCH = "synthetic"
STAGES = ("ingest", "perceive", "texture", "coarse", "animate", "report")
MEAN_S = {"ingest": 2.0, "perceive": 21.0, "texture": 9.0, "coarse": 33.0, "animate": 12.0, "report": 1.0}
FAIL_RATE = 0.05  # of attempts
ERROR = {"error_class": "ValueError", "error_message": "expected a person in some frame, got none"}
Row = dict[str, Any]
STATUS = """
import sys
from storage_schema.status import batch_status
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables
store = ArtifactStore(sys.argv[1])
status = batch_status(store, Tables(store), sys.argv[2])
print(status.total, status.videos["done"])
"""


def write_batch(url: str, videos: int, writers: int = 2, together: int = 0) -> None:
    """Submit a batch of `videos` and write the rows of all its runs."""
    store = ArtifactStore(url, workers=writers)
    names = [f"video-{i:05d}" for i in range(videos)]
    submit(store, BatchManifest.of(BATCH, [BatchEntry(name, f"/videos/{name}.mp4", i) for i, name in enumerate(names)]))
    with multiprocessing.get_context("spawn").Pool(writers) as pool:
        pool.starmap(_write_videos, [(url, names[i::writers], together) for i in range(writers)])


def _write_videos(url: str, names: list[str], together: int) -> None:
    tables = Tables(ArtifactStore(url))
    for start in range(0, len(names), together or 1):
        videos = [rows_of(name) for name in names[start : start + (together or 1)]]
        for k, table in enumerate(("attempts", "stages")):
            rows = [row for video in videos for row in video[k]]
            for group in [rows] if together else [[row] for row in rows]:
                tables.append(table, group, batch=BATCH)


def rows_of(name: str) -> tuple[list[Row], list[Row]]:
    """Rows of `attempts` and of `stages` that the runs of a video leave."""
    rng, attempts, stages = random.Random(name), [], []
    for number in (1, 2, 3):
        failing = rng.choice(STAGES) if rng.random() < FAIL_RATE else None
        run = {"video_id": name, "run_id": f"{name}-{number}", "attempt_number": number}
        now = datetime.now(UTC)
        attempts.append({**run, "seq": 0, "state": "scheduled", "at": now})
        attempts.append({**run, "seq": 1, "state": "running", "at": now, "worker": "host:1"})
        made = STAGES[: STAGES.index(failing) + 1] if failing else STAGES
        stages += [_stage_row(run, seq, stage, failing, rng) for seq, stage in enumerate(made)]
        end = {"state": "failed", **ERROR} if failing else {"state": "done"}
        attempts.append({**run, "seq": 9, "at": now, **end})
        if not failing:
            break
    return attempts, stages


def _stage_row(run: Row, seq: int, stage: str, failing: str | None, rng: random.Random) -> Row:
    wall = rng.gammavariate(4.0, MEAN_S[stage] / 4)
    row = {**run, "seq": seq, "stage": stage, "stage_version": 1, "started_at": datetime.now(UTC), "wall_s": wall}
    row |= {"cpu_s": wall, "key": f"{rng.getrandbits(256):064x}", "knobs": {f"knob_{i}": i / 8 for i in range(12)}}
    return row | ({"state": "failed", **ERROR} if stage == failing else {"state": "done", "attempt": f"a-{seq}"})


def measure_status(url: str, repeats: int) -> dict[str, Any]:
    """Wall and CPU seconds of `status` in a fresh process on one core, median and range."""
    walls, cpus = [], []
    for _ in range(repeats):
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([sys.executable, "-c", STATUS, url, BATCH], check=True, preexec_fn=_one_core)
        walls.append(time.perf_counter() - started)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpus.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return {
        "status_s": round(statistics.median(walls), 3),
        "status_s_range": [round(min(walls), 3), round(max(walls), 3)],
        "status_cpu_s": round(statistics.median(cpus), 3),
    }


def _one_core() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def main() -> None:
    """Write, measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=int, default=10_000)
    parser.add_argument("--writers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--together", type=int, default=0, help="videos in one append; by default every row its own")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = str(Path(folder) / "store")
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        write_batch(url, arguments.videos, arguments.writers, arguments.together)
        wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        files = [path for path in (Path(url) / "tables").rglob("*") if path.is_file()]
        result = {
            "videos": arguments.videos,
            "together": arguments.together,
            "files": len(files),
            "bytes": sum(path.stat().st_size for path in files),
            "write_s": round(wall, 1),
            "write_cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
            **measure_status(url, arguments.repeats),
            "machine": machine(),
        }
    print(json.dumps(result, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(result) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
