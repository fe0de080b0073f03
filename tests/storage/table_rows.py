"""Rows of every table, with all that is optional and without, and a look at what lies in the store."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np

from storage_schema.tables import Tables

NOW = datetime(2026, 1, 2, 3, 4, 5, 678901, tzinfo=UTC)
REQUIRED: dict[str, dict[str, Any]] = {
    "videos": {"video_id": "v", "source": "https://host/v.mp4"},
    "attempts": {"video_id": "v", "run_id": "r", "attempt_number": 1, "seq": 0, "state": "running", "at": NOW},
    "effects": {
        "video_id": "v",
        "key": "k",
        "scene": "s",
        "effect": "shadow",
        "enabled": False,
        "reason": "no ground in the scene",
    },
    "stages": {
        "attempt_number": 2,
        "seq": 7,
        "video_id": "v",
        "run_id": "r",
        "stage": "ingest",
        "stage_version": 1,
        "state": "done",
        "started_at": NOW,
        "wall_s": 0.1,
    },
    "frames": {"video_id": "v", "key": "k", "frame": 0, "index": 2**40, "pts": 0.1, "used": True, "confidence": 0.5},
    "metrics": {
        "video_id": "v",
        "key": "k",
        "capture": "c",
        "config": "full",
        "protocol": "p",
        "protocol_id": "id",
        "region": "mask",
        "camera": "0",
        "frame": 0,
    },
}
OPTIONAL: dict[str, dict[str, Any]] = {
    "videos": {
        "content_hash": "h",
        "title": "<b>walk</b>",
        "duration_s": 4.5,
        "fps": 29.97,
        "width": 640,
        "height": 360,
        "frames": 135,
        "options": {"subject": 1},
    },
    "attempts": {
        "stage": "coarse",
        "flow_run_id": "f",
        "worker": "host:12",
        "error_class": "OSError",
        "error_message": "gone",
        "wall_s": 2.5,
        "cpu_s": 1.5,
    },
    "effects": {"predicted_s": 0.5, "measured_s": 0.25},
    "stages": {
        "attempt": "a",
        "key": "k",
        "reason": "no face",
        "error_class": "ValueError",
        "error_message": "é\n",
        "cpu_s": 0.3,
        "peak_rss_mb": 12.5,
        "knobs": {"b": 0.1, "a": [1, None]},
        "accuracy": {"px": 3.5},
    },
    "frames": {
        "pose": np.arange(6).reshape(2, 3),
        "transl": [0, 1, 2],
        "K": np.eye(3),
        "viewmat": np.eye(4),
        "box": (0, 1, 2, 3),
    },
    "metrics": {
        "psnr": math.inf,
        "ssim": 0.5,
        "perceptual": 0.25,
        "perceptual_name": "net",
        "iou": 1.0,
        "input_setting": "video",
        "roles": {"pose": "net"},
    },
}
STORED = {
    "knobs": '{"a":[1,null],"b":0.1}',
    "roles": '{"pose":"net"}',
    "accuracy": '{"px":3.5}',
    "options": '{"subject":1}',
    "pose": [0, 1, 2, 3, 4, 5],
    "transl": [0, 1, 2],
    "K": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "viewmat": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "box": [0, 1, 2, 3],
}


def parquet_files(tables: Tables, table: str = "frames") -> list[str]:
    return [path for path in tables._backend.files(f"tables/{table}/batch=b") if path.endswith(".parquet")]


def frames(tables: Tables) -> list[int]:
    return Tables(tables._store).read("frames", "b")["frame"].to_pylist()
