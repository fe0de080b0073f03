"""External commands for the tests: real programs that keep SyncHuman's and CAP4D's side of the exchange."""

from __future__ import annotations

import sys
from pathlib import Path

from ahoy_core.models.adapter import Fill

_HEAD = """
import json, sys
from pathlib import Path
import numpy as np
from ahoy_core.formats.images import read_png, write_png
given, made = Path(sys.argv[1]), Path(sys.argv[2])
"""
SYNCHUMAN = """
picture = read_png(given / "image.png")
assert picture.shape[2] == 4 and picture.shape[0] == picture.shape[1]
alpha = picture[..., 3:].astype(float) / 255
# White behind, as the model has it; a colour a view: front, right, back, left, face. Half the size, moved down.
small = np.full_like(picture[..., :3], 255)
for number, tint in enumerate(((1, 1, 1), (1, .2, .2), (.2, 1, .2), (.2, .2, 1), (0, 0, 0))):
    person = picture[..., :3] * alpha * tint + 255 * (1 - alpha)
    view = small.copy()
    half = person[::2, ::2]
    view[10:10 + half.shape[0], 20:20 + half.shape[1]] = half[: view.shape[0] - 10, : view.shape[1] - 20]
    write_png(made / f"color_{number}.png", view.astype(np.uint8))
"""
CAP4D = """
said = json.loads((given / "cameras.json").read_text())
expressions = np.load(given / "expressions.npy")
references = [read_png(path) for path in sorted((given / "references").glob("*.png"))]
assert len(said["Ks"]) == len(expressions) and references
rng = np.random.default_rng(int(sys.argv[3]))
for number, expression in enumerate(expressions):
    picture = references[number % len(references)].astype(float) + rng.normal(0, 4) + 10 * expression.sum()
    write_png(made / f"{number:03d}.png", picture.clip(0, 255).astype(np.uint8))
"""


def command(folder: Path, name: str, body: str, *more: str) -> tuple[str, ...]:
    """Write a program and return the words that run it in this Python."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.py"
    root = Path(__file__).resolve().parents[2]
    path.write_text(f"import sys\nsys.path.insert(0, {str(root)!r})\n{_HEAD}{body}", encoding="utf-8")
    return (sys.executable, str(path), "{in}", "{out}", *more)


def synchuman(folder: Path) -> Fill:
    return Fill(fill="synchuman", command=command(folder, "synchuman", SYNCHUMAN), timeout_s=250)


def cap4d(folder: Path) -> Fill:
    return Fill(fill="cap4d", command=command(folder, "cap4d", CAP4D, "{seed}"), timeout_s=250)
