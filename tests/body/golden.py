"""Writes golden_captures.npz: three frames of each capture, so that `convert_pose` is tested without them.

Run `python -m tests.body.golden CAPTURES_FOLDER` to make it again.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

FILE = Path(__file__).with_name("golden_captures.npz")
FRAMES = (0, 17, 41)
KEYS = ("pose_local_ref", "bone_heads_world", "joints24")


def main(captures: Path) -> None:
    arrays: dict[str, np.ndarray] = {}
    for name in "ab":
        with np.load(captures / name / "motion.npz") as motion:
            arrays |= {f"{name}_{key}": motion[key][list(FRAMES)] for key in KEYS}
            arrays |= {f"{name}_{key}": motion[key] for key in ("bone_names", "joints24_names", "phenotype")}
    np.savez_compressed(FILE, allow_pickle=False, **arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
