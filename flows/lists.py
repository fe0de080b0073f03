"""Lists of videos: what is in them, line by line, and what is wrong with single lines.

Three forms, told apart by the file's name: text as yt-dlp reads it (one source a line, `#` comments), CSV and Parquet
(one row a video, with options). A line that cannot be used is reported with its number; the others go in.
"""

from __future__ import annotations

import csv
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tasks.errors import BadInputError, ListError
from tasks.settings import Preset
from tasks.sources import SourcePolicy, Uri, parse_source, shown, youtube_id

STDIN = "-"
SOURCE_COLUMNS = ("source", "url", "video", "path")
MAX_LIST_BYTES = 256 * 2**20
MAX_ROWS = 1_000_000

_COMMENTS = ("#", ";", "]")  # yt-dlp's
_TRAILING_COMMENT = re.compile(r"\s#")
_OTHER_ENCODINGS = (b"\xff\xfe", b"\xfe\xff")


class VideoOptions(BaseModel):
    """What may be said of one video in a list.

    Attributes:
        subject: which person, counted from the most visible.
        start_s: first moment that is used, seconds from the first frame.
        end_s: moment at which using stops.
        preset: how much time to spend; the batch's own if None.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    subject: int | None = Field(None, ge=0)
    start_s: float | None = Field(None, ge=0, allow_inf_nan=False)
    end_s: float | None = Field(None, gt=0, allow_inf_nan=False)
    preset: Preset | None = None

    @model_validator(mode="after")
    def _ordered(self) -> VideoOptions:
        if self.end_s is not None and self.end_s <= (self.start_s or 0):
            raise ValueError(
                f"expected end_s after start_s, got {self.end_s} and {self.start_s or 0}: swap or drop one"
            )
        return self


class ListEntry(BaseModel):
    """One video to process.

    Attributes:
        line: number of the line (text, CSV) or row (Parquet), from 1.
        source: normalised: an absolute path, or an address; fit to be stored, and for `fetch_source`.
        name: short and harmless, for run names; not unique.
        options: what the list says of it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    line: int
    source: str
    name: str
    options: VideoOptions = VideoOptions()

    def request_fields(self) -> dict[str, Any]:
        """What goes into a `VideoRequest`; options that the list leaves open are left out."""
        return {"video": self.source, **self.options.model_dump(exclude_none=True)}


class ListProblem(BaseModel):
    """A line that does not go in.

    Attributes:
        line: its number, from 1.
        text: what it says, redacted and shortened.
        reason: why, and what to do.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    line: int
    text: str
    reason: str


class VideoList(BaseModel):
    """What a list holds: videos in its order, each once, and the lines that do not go in."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    entries: tuple[ListEntry, ...]
    problems: tuple[ListProblem, ...]


@dataclass(frozen=True)
class _Row:
    line: int
    text: str
    options: Mapping[str, Any]


def read_list(source: str | Path, policy: SourcePolicy, stdin: Iterable[bytes] | None = None) -> VideoList:
    """Read a list and check every line; makes no connection.

    Args:
        source: a `.csv` or `.parquet` file, any other text file, or `-` for text from standard input. Relative paths in
            it are relative to its folder (from standard input: to the working folder).
        policy: what the lines may name.
        stdin: lines to read for `-`; the process's own standard input unless given.

    Raises:
        ListError: the list as a whole cannot be read.
    """
    if str(source) == STDIN:
        data = b"".join(stdin if stdin is not None else sys.stdin.buffer)
        return _checked(_text_rows(data, "standard input"), policy, Path.cwd())
    path = Path(source).expanduser()
    if not path.is_file():
        raise ListError(f"expected a list of videos, got {shown(str(source))!r}, which is no file; check the path")
    if path.stat().st_size > MAX_LIST_BYTES:
        raise ListError(f"expected a list of at most {MAX_LIST_BYTES >> 20} MB, got {path.name!r}: split it")
    readers = {".csv": _csv_rows, ".parquet": _parquet_rows, ".pq": _parquet_rows}
    reader = readers.get(path.suffix.lower(), _text_rows)
    return _checked(reader(path.read_bytes(), path.name), policy, path.absolute().parent)


def _checked(rows: Iterable[_Row | ListProblem], policy: SourcePolicy, folder: Path) -> VideoList:
    archived = _archived_ids(policy.archive)
    entries: list[ListEntry] = []
    problems: list[ListProblem] = []
    first_line: dict[tuple[str, VideoOptions], int] = {}
    for number, row in enumerate(rows):
        if number >= MAX_ROWS:
            raise ListError(f"expected at most {MAX_ROWS} videos, got more: split the list")
        if isinstance(row, ListProblem):
            problems.append(row)
            continue
        try:
            uri, options = parse_source(row.text, policy, folder), _options(row.options)
            _check_is_there(uri)
            known = first_line.setdefault((uri.text, options), row.line)
            if known != row.line:
                raise BadInputError(f"the same video with the same options stands in line {known}: dropped")
            if uri.kind == "page" and youtube_id(uri.text) in archived:
                raise BadInputError(f"fetched before, says the download archive {policy.archive}: left out")
        except BadInputError as error:
            problems.append(ListProblem(line=row.line, text=shown(row.text), reason=str(error)))
            continue
        entries.append(ListEntry(line=row.line, source=uri.text, name=uri.name, options=options))
    return VideoList(entries=tuple(entries), problems=tuple(problems))


def _check_is_there(uri: Uri) -> None:
    """Local files are looked for now; addresses only by who fetches them, perhaps on another machine."""
    if uri.kind == "local" and not os.path.isfile(uri.text):  # noqa: PTH113 - Path's raises on over-long names
        what = "is a folder: list the files in it" if os.path.isdir(uri.text) else "is not there; check the path"  # noqa: PTH112
        raise BadInputError(f"expected a video file, got {shown(uri.text)!r}, which {what}")


def _options(values: Mapping[str, Any]) -> VideoOptions:
    try:
        return VideoOptions.model_validate(values)
    except ValidationError as error:
        found = "; ".join(
            f"{'.'.join(map(str, e['loc']))}: {e['msg']}, got {shown(str(e['input']))}" for e in error.errors()
        )
        raise BadInputError(f"the options do not fit: {found}; correct or empty the cell") from None


def _text_rows(data: bytes, name: str) -> Iterator[_Row | ListProblem]:
    _refuse_binary(data, name)
    # Only \n ends a line: splitlines() would also break at characters that a hostile line may hold.
    for number, raw in enumerate(data.removeprefix(b"\xef\xbb\xbf").split(b"\n"), start=1):
        try:
            line = raw.decode("utf-8").strip(" \t\r")
        except UnicodeDecodeError:
            text = shown(raw.decode("utf-8", "replace"))
            yield ListProblem(line=number, text=text, reason="expected UTF-8, got other bytes: save the list as UTF-8")
            continue
        if line and not line.startswith(_COMMENTS):
            yield _Row(number, _TRAILING_COMMENT.split(line, maxsplit=1)[0].rstrip(), {})


def _csv_rows(data: bytes, name: str) -> Iterator[_Row | ListProblem]:
    _refuse_binary(data, name)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ListError(f"expected UTF-8 in {name!r}, got other bytes at {error.start}: save it as UTF-8") from None
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header: list[str] | None = None
    while True:
        start = reader.line_num + 1
        try:
            cells = next(reader)
        except StopIteration:
            break
        except csv.Error as error:
            # The reader has lost its place in the quoting, so what follows cannot be trusted.
            yield ListProblem(line=start, text="", reason=f"expected CSV, got {error}: nothing after it was read")
            break
        if not cells or cells[0].lstrip().startswith("#"):
            continue
        if header is None:
            header = [cell.strip().lower() for cell in cells]
            column = _source_column(header, name)
            continue
        if len(cells) > len(header):
            reason = f"expected {len(header)} cells, got {len(cells)}: put a text with commas in quotes"
            yield ListProblem(line=start, text=shown(",".join(cells)), reason=reason)
            continue
        values = {key: cell.strip() for key, cell in zip(header, cells, strict=False) if cell.strip()}
        yield _Row(start, values.pop(column, ""), values)


def _parquet_rows(data: bytes, name: str) -> Iterator[_Row | ListProblem]:
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        if file.metadata.num_rows > MAX_ROWS:
            raise ListError(f"expected at most {MAX_ROWS} videos, got {file.metadata.num_rows} in {name!r}: split it")
        table = file.read()
    except (pa.ArrowException, OSError) as error:
        raise ListError(f"expected Parquet in {name!r}, got something else ({error}): write it again") from None
    names = [column.strip().lower() for column in table.column_names]
    column = _source_column(names, name)
    for number, row in enumerate(table.rename_columns(names).to_pylist(), start=1):
        values = {key: value for key, value in row.items() if value is not None and value != ""}
        yield _Row(number, str(values.pop(column, "")).strip(), values)


def _source_column(header: list[str], name: str) -> str:
    """The column with the sources; a misspelt one is an error, since its options would be lost without a word."""
    found = [column for column in header if column in SOURCE_COLUMNS]
    unknown = [column for column in header if column not in (*SOURCE_COLUMNS, *VideoOptions.model_fields)]
    if len(found) != 1 or unknown or len(set(header)) < len(header):
        raise ListError(
            f"expected in {name!r} one column of {', '.join(SOURCE_COLUMNS)} and any of "
            f"{', '.join(VideoOptions.model_fields)}, got {shown(', '.join(header))}: correct the header"
        )
    return found[0]


def _refuse_binary(data: bytes, name: str) -> None:
    if len(data) > MAX_LIST_BYTES:
        raise ListError(f"expected a list of at most {MAX_LIST_BYTES >> 20} MB, got {name!r}: split it")
    if data.startswith(_OTHER_ENCODINGS):
        raise ListError(f"expected UTF-8 in {name!r}, got UTF-16: save it as UTF-8")
    head = data[:4096]
    if head.count(0) > len(head) // 10:
        raise ListError(f"expected text in {name!r}, got binary data: for one video use `ahoy run`")


def _archived_ids(archive: Path | None) -> frozenset[str]:
    """Ids of YouTube's in a download archive (lines `youtube ID`)."""
    if archive is None or not archive.is_file():
        return frozenset()
    pairs = (line.split() for line in archive.read_text(encoding="utf-8").splitlines())
    return frozenset(pair[1] for pair in pairs if len(pair) == 2 and pair[0] == "youtube")
