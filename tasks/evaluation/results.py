"""What an evaluation leaves in its folder, read from the finished cells in the store."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ahoy_core.captures.capture import View
from ahoy_core.formats.npz import load_npz
from ahoy_core.metrics.score import REFERENCES
from storage_schema.store import ArtifactStore
from tasks.evaluation.cell import COLUMNS, to_table
from tasks.evaluation.pictures import Picture, draw_chart, draw_pictures
from tasks.evaluation.tables import tables
from tasks.evaluation.truths import Truths
from tasks.stage import StageRef

METRICS, TABLE, CHART, PICTURES = "metrics.parquet", "table.md", "chart.png", "pictures"


@dataclass(frozen=True)
class Cell:
    """One capture under one configuration: its scores by reference, or why there are none.

    Attributes:
        capture, config: names.
        ref: of the stage `evaluate`.
        error: what went wrong, empty where nothing did.
        facts: of how it was made (`avatar`: hash of the avatar's tensors; `prior`: whether a video prior was used;
            `notes`: of the training).
    """

    capture: str
    config: str
    ref: StageRef | None = None
    error: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)


def read_rows(store: ArtifactStore, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """The rows of all finished cells, cell after cell."""
    return [row for cell in cells if cell.ref for row in pq.read_table(_folder(store, cell) / METRICS).to_pylist()]


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows that an evaluation left.

    Raises:
        ValueError: no such file, or another table.
    """
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"expected the metrics.parquet of an evaluation, got {path}: {error}") from error
    if missing := sorted(set(COLUMNS) - set(table.column_names)):
        raise ValueError(f"expected the columns of metrics.parquet in {path}, got none of {missing}")
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def read_pictures(store: ArtifactStore, cell: Cell) -> tuple[list[Picture], list[str]]:
    """What a cell rendered, and its notes."""
    folder = _folder(store, cell)
    described = json.loads((folder / "cell.json").read_text(encoding="utf-8"))
    arrays = load_npz(folder / "renders.npz")
    ends = np.cumsum([int(h) * int(w) for h, w in arrays["sizes"]])
    pictures = []
    for one, end, (height, width) in zip(described["pictures"], ends, arrays["sizes"], strict=True):
        rgba = arrays["pixels"][end - height * width : end].reshape(height, width, 4)
        pictures.append(Picture(one["protocol"], View(one["moment"], one["camera"], one["frame"]), rgba))
    return pictures, described["notes"]


def write_results(
    store: ArtifactStore,
    cells: Sequence[Cell],
    truths: Mapping[str, Truths],
    out: Path,
    heading: Sequence[str],
    others: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Path]:
    """Write table, metrics, pictures and chart.

    Args:
        store: where the cells are.
        cells: all of them, in order.
        truths: of each capture by name, for the pictures.
        out: folder.
        heading: paragraphs above the tables.
        others: rows of an earlier evaluation, to stand in the same tables.

    Returns:
        Paths by name.

    Raises:
        ValueError: `others` were scored under other protocol ids than these.
    """
    rows = read_rows(store, cells)
    _check_same(rows, others)
    everything = [*rows, *others]
    out.mkdir(parents=True, exist_ok=True)
    pq.write_table(to_table(everything), out / METRICS)
    paths = {METRICS: out / METRICS, TABLE: out / TABLE}
    notes = []
    for cell in cells:
        if cell.ref is None:
            continue
        pictures, mine = read_pictures(store, cell)
        notes += [f"{cell.capture}, {cell.config}: {note}" for note in mine if cell.config not in REFERENCES]
        if cell.config not in REFERENCES:
            own = [row for row in rows if row["capture"] == cell.capture and row["config"] == cell.config]
            folder = out / PICTURES / cell.capture / cell.config
            draw_pictures(truths[cell.capture], cell.config, pictures, own, folder)
            paths[PICTURES] = out / PICTURES
    if draw_chart(everything, out / CHART):
        paths[CHART] = out / CHART
    text = "\n\n".join([*heading, *_remarks(cells, notes), tables(everything)])
    (out / TABLE).write_text(text + "\n", encoding="utf-8")
    return paths


def remarks(cells: Sequence[Cell]) -> list[str]:
    """What a reader must know before comparing rows: failures, twins, and what no row here shows."""
    said = [f"- not scored: {cell.capture}, {cell.config}: {cell.error}" for cell in cells if cell.error]
    trained = [cell for cell in cells if cell.ref and "prior" in cell.facts]
    if trained and not any(cell.facts["prior"] for cell in trained):
        said.append(
            "- No video prior (paper section 3.2) was used in any row: switched off, or the symmetric fill was closer "
            "to what each video's self-check hid. `full` is the full avatar on the fallback (coarse renders as they "
            "are). `A` against `full` therefore shows what the full avatar's training adds, not what the prior adds, "
            "and `full` and `B2` train on the same data."
        )
    for capture in dict.fromkeys(cell.capture for cell in trained):
        by_avatar: dict[str, list[str]] = {}
        for cell in trained:
            if cell.capture == capture:
                by_avatar.setdefault(cell.facts["avatar"], []).append(cell.config)
        twins = [names for names in by_avatar.values() if len(names) > 1]
        said += [f"- {capture}: {' and '.join(names)} are the same avatar, bit for bit." for names in twins]
    return said


def _remarks(cells: Sequence[Cell], notes: Sequence[str]) -> list[str]:
    said = remarks(cells) + [f"- {note}" for note in dict.fromkeys(notes)]
    return ["## Before comparing", "\n".join(said)] if said else []


def _check_same(rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]) -> None:
    """Refuse rows that would stand in a table of another protocol id."""
    for key in {(row["protocol"], row["region"]) for row in others}:
        mine = {row["protocol_id"] for row in rows if (row["protocol"], row["region"]) == key}
        theirs = {row["protocol_id"] for row in others if (row["protocol"], row["region"]) == key}
        if mine and mine != theirs:
            listed = "\n  ".join(sorted(mine | theirs))
            raise ValueError(
                f"expected rows of one protocol id for {key[0]}, {key[1]}, got several:\n  {listed}\nscore both under "
                "one protocol; such rows are never put into one table"
            )


def _folder(store: ArtifactStore, cell: Cell) -> Path:
    assert cell.ref is not None
    manifest = store.lookup(cell.ref.key, stage=cell.ref.stage, verify=False)
    if manifest is None:
        raise FileNotFoundError(
            f"expected the scores of {cell.capture}, {cell.config} in the store, got none; run the same command again"
        )
    return store.fetch(manifest)
