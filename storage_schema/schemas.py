"""The columns of the Parquet tables, their versions, and how old files become new ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import pyarrow as pa

from storage_schema.errors import StoreVersionError

Upgrade = Callable[[pa.Table], pa.Table]

STATES = ("done", "cached", "skipped", "failed")


@dataclass(frozen=True)
class TableSchema:
    """Columns of one table at its current version.

    Attributes:
        name: of the table.
        version: current one, from 1; raised with every change of `columns`.
        columns: as they are in files written now. The partition's `batch` is not among them: it is in the path.
        upgrades: version -> what turns a table of that version into one of the next. One for every version before the
            current.
        choices: column -> the only values it may have.
        json: columns whose values are mappings, kept as canonical JSON text.
    """

    name: str
    version: int
    columns: pa.Schema
    upgrades: Mapping[int, Upgrade] = field(default_factory=dict)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    json: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if sorted(self.upgrades) != list(range(1, self.version)):
            raise ValueError(
                f"table {self.name} version {self.version}: expected an upgrade from each of "
                f"{list(range(1, self.version))}, got {sorted(self.upgrades)}"
            )
        if "batch" in self.columns.names:
            raise ValueError(f"table {self.name}: the batch is in the path of a file, not a column of it")

    def upgraded(self, table: pa.Table, version: int) -> pa.Table:
        """`table`, as written at `version`, with the current columns.

        Raises:
            StoreVersionError: it was written by a newer version of this software.
            ValueError: an upgrade gave other columns than the current ones.
        """
        if version > self.version:
            raise StoreVersionError(
                f"table {self.name} has version {version}, expected at most {self.version}: a newer version of this "
                "software wrote it; install that version to read it"
            )
        for step in range(version, self.version):
            table = self.upgrades[step](table)
        if set(table.column_names) != set(self.columns.names):
            raise ValueError(f"table {self.name}: expected columns {self.columns.names}, got {table.column_names}")
        return table.select(self.columns.names).cast(self.columns)


def _column(name: str, kind: pa.DataType, *, optional: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=optional)


_STAGES = TableSchema(
    name="stages",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("run_id", pa.string()),
            _column("attempt", pa.string(), optional=True),  # of the artifact; null where none was made
            _column("key", pa.string(), optional=True),  # null where the stage was skipped before its key was known
            _column("stage", pa.string()),
            _column("stage_version", pa.int32()),
            _column("state", pa.string()),
            _column("reason", pa.string(), optional=True),  # why it was skipped
            _column("error_class", pa.string(), optional=True),
            _column("error_message", pa.string(), optional=True),
            _column("started_at", pa.timestamp("us", tz="UTC")),
            _column("wall_s", pa.float64()),
            _column("cpu_s", pa.float64(), optional=True),
            _column("peak_rss_mb", pa.float64(), optional=True),
            _column("knobs", pa.string(), optional=True),  # JSON
            _column("accuracy", pa.string(), optional=True),  # JSON
        ]
    ),
    choices={"state": STATES},
    json=("knobs", "accuracy"),
)

_FRAMES = TableSchema(
    name="frames",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("key", pa.string()),  # of the perceive artifact
            _column("frame", pa.int32()),  # among the ingested frames, from 0
            _column("index", pa.int64()),  # in the source
            _column("pts", pa.float64()),  # seconds from the start of the source
            _column("used", pa.bool_()),  # a person was found and fitted
            _column("confidence", pa.float32()),  # [0,1]
            _column("pose", pa.list_(pa.float32()), optional=True),  # [J*3] axis-angle, radians, row-major
            _column("transl", pa.list_(pa.float32(), 3), optional=True),  # metres, world
            _column("K", pa.list_(pa.float32(), 9), optional=True),  # [3*3] pixels, row-major
            _column("viewmat", pa.list_(pa.float32(), 16), optional=True),  # [4*4] world -> camera, row-major
            _column("box", pa.list_(pa.float32(), 4), optional=True),  # x0, y0, x1, y1 of the visible mask, pixels
        ]
    ),
)

_METRICS = TableSchema(
    name="metrics",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("key", pa.string()),  # of the avatar that was measured
            _column("capture", pa.string()),
            _column("config", pa.string()),  # name of the ablation or preset
            _column("protocol", pa.string()),
            _column("protocol_id", pa.string()),  # rows of different ids are never put in one table
            _column("region", pa.string()),
            _column("camera", pa.string()),
            _column("frame", pa.int32()),
            _column("psnr", pa.float64(), optional=True),  # dB
            _column("ssim", pa.float64(), optional=True),
            _column("perceptual", pa.float64(), optional=True),
            _column("perceptual_name", pa.string(), optional=True),
            _column("iou", pa.float64(), optional=True),
        ]
    ),
)

TABLES: Mapping[str, TableSchema] = {schema.name: schema for schema in (_STAGES, _FRAMES, _METRICS)}
