"""The columns of the Parquet tables, their versions, and how old files become new ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import pyarrow as pa

from storage_schema.errors import StoreVersionError

Upgrade = Callable[[pa.Table], pa.Table]

STATES = ("done", "cached", "skipped", "failed")
ATTEMPT_STATES = ("scheduled", "running", "done", "failed", "crashed", "cancelled")


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
        redacted: columns of free text or addresses, from which secrets are taken out when they are written.
    """

    name: str
    version: int
    columns: pa.Schema
    upgrades: Mapping[int, Upgrade] = field(default_factory=dict)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    json: tuple[str, ...] = ()
    redacted: tuple[str, ...] = ()

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


def _with_order(table: pa.Table) -> pa.Table:
    """Stages 1 -> 2: rows of before count as a first attempt's, in the order in which they are read."""
    ones, zeros = (pa.array([value] * table.num_rows, pa.int32()) for value in (1, 0))
    return table.append_column("attempt_number", ones).append_column("seq", zeros)


_VIDEOS = TableSchema(
    name="videos",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("source", pa.string()),  # path or URL, without credentials
            _column("content_hash", pa.string(), optional=True),  # null until the file was read
            _column("title", pa.string(), optional=True),
            _column("duration_s", pa.float64(), optional=True),
            _column("fps", pa.float64(), optional=True),
            _column("width", pa.int32(), optional=True),  # pixels, display orientation
            _column("height", pa.int32(), optional=True),
            _column("frames", pa.int64(), optional=True),
            _column("options", pa.string(), optional=True),  # JSON
        ]
    ),
    json=("options",),
    redacted=("source", "title"),
)

_ATTEMPTS = TableSchema(
    name="attempts",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("run_id", pa.string()),  # the process that tried; also in `stages`
            _column("attempt_number", pa.int32()),  # of the video, from 1; a rerun has the next
            _column("seq", pa.int32()),  # orders the rows of one attempt, whatever the clocks say
            _column("state", pa.string()),
            _column("stage", pa.string(), optional=True),  # where it is, or where it ended
            _column("flow_run_id", pa.string(), optional=True),  # the orchestrator's
            _column("worker", pa.string(), optional=True),  # machine and process
            _column("error_class", pa.string(), optional=True),
            _column("error_message", pa.string(), optional=True),
            _column("at", pa.timestamp("us", tz="UTC")),  # by the writer's clock: for people, not for ordering
            _column("wall_s", pa.float64(), optional=True),  # of the attempt so far
            _column("cpu_s", pa.float64(), optional=True),
        ]
    ),
    choices={"state": ATTEMPT_STATES},
    redacted=("error_message",),
)

_STAGES = TableSchema(
    name="stages",
    version=2,
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
            _column("attempt_number", pa.int32()),  # of the video, as in `attempts`
            _column("seq", pa.int32()),  # orders the rows of one run, whatever the clocks say
        ]
    ),
    upgrades={1: _with_order},
    choices={"state": STATES},
    json=("knobs", "accuracy"),
    redacted=("reason", "error_message"),
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


def _with_input_setting_and_roles(table: pa.Table) -> pa.Table:
    """Metrics 1 -> 2: rows of before were all made from the video; who filled the roles was not recorded."""
    told = table.append_column("input_setting", pa.array(["video"] * table.num_rows, pa.string()))
    return told.append_column("roles", pa.nulls(table.num_rows, pa.string()))


_METRICS = TableSchema(
    name="metrics",
    version=2,
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
            _column("input_setting", pa.string(), optional=True),  # what was handed to the method that is scored
            _column("roles", pa.string(), optional=True),  # JSON: role -> who filled it, up to what was measured
        ]
    ),
    upgrades={1: _with_input_setting_and_roles},
    json=("roles",),
)

_EFFECTS = TableSchema(
    name="effects",
    version=1,
    columns=pa.schema(
        [
            _column("video_id", pa.string()),
            _column("key", pa.string()),  # of the artifact that was planned
            _column("scene", pa.string()),
            _column("effect", pa.string()),
            _column("enabled", pa.bool_()),
            _column("reason", pa.string()),  # what in the scene, the motion or the camera decided it
            _column("predicted_s", pa.float64(), optional=True),  # CPU seconds a frame
            _column("measured_s", pa.float64(), optional=True),
        ]
    ),
    redacted=("reason",),
)

TABLES: Mapping[str, TableSchema] = {
    schema.name: schema for schema in (_VIDEOS, _ATTEMPTS, _STAGES, _FRAMES, _METRICS, _EFFECTS)
}
