"""The `.ply` container: named columns of one element, ascii or binary (Turk, "The PLY Polygon File Format", 1994)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ahoy_core.formats.errors import PlyError

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_SIZED = {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= _SIZED | {"double": "f8", "float32": "f4", "float64": "f8"}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_LINES = 1000
_MAX_LINE = 4096


@dataclass(frozen=True)
class Table:
    """Columns of the element `vertex` ([N] each, in the file's order) and the header's comments."""

    columns: Mapping[str, np.ndarray]
    comments: tuple[str, ...] = ()


@dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]
    has_list: bool = False


@dataclass(frozen=True)
class _Header:
    order: str
    elements: list[_Element]
    comments: tuple[str, ...]


def write_table(path: Path, table: Table) -> None:
    """Write columns as float32, binary little-endian.

    Raises:
        PlyError: a comment of several lines, too long, or not ASCII.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for comment in table.comments:
        if not comment.isascii() or not comment.isprintable() or len(comment) > _MAX_LINE - len("comment \n"):
            raise PlyError(f"expected comments of one printable ASCII line, got {comment[:80]!r}")
        lines.append(f"comment {comment}")
    count = len(next(iter(table.columns.values())))
    lines += [f"element vertex {count}", *(f"property float {name}" for name in table.columns), "end_header"]
    rows = np.empty(count, [(name, "<f4") for name in table.columns])
    for name, values in table.columns.items():
        rows[name] = values
    with path.open("wb") as handle:
        handle.write(("\n".join(lines) + "\n").encode("ascii"))
        handle.write(rows.tobytes())


def read_table(path: Path) -> Table:
    """Read the columns of the element `vertex`; other elements are skipped.

    Raises:
        PlyError: no `.ply`, a malformed header, too little data, or text that is no number.
    """
    with path.open("rb") as handle:
        header = _read_header(handle, path.name)
        for element in header.elements:
            if element.name == "vertex":
                break
            _skip(handle, element, header.order, path.name)
        else:
            raise PlyError(f"expected an element 'vertex', got none in {path.name!r}")
        if element.has_list or not element.fields:
            raise PlyError(f"expected number properties of 'vertex', got lists or nothing in {path.name!r}")
        read = _read_binary if header.order else _read_ascii
        return Table(read(handle, element, header.order, path), header.comments)


def _read_header(handle: BinaryIO, name: str) -> _Header:
    if handle.readline(_MAX_LINE).strip() != b"ply":
        raise PlyError(f"expected a .ply file, got {name!r}, which does not begin with 'ply'")
    order: str | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    for _ in range(_MAX_HEADER_LINES):
        raw = handle.readline(_MAX_LINE)
        words = raw.decode("ascii", "replace").split()
        match words:
            case [] if raw:
                continue
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as kind, "1.0"]:
                order = _FORMATS[kind]
            case ["comment" | "obj_info", *_]:
                comments += [raw.decode("ascii", "replace").strip().partition(" ")[2]]
            case ["element", element, count] if count.isdigit():
                elements.append(_Element(element, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_list = True
            case ["property", kind, field] if elements and kind in _TYPES:
                _add_field(elements[-1], field, _TYPES[kind], name)
            case ["end_header"] if order is not None:
                return _Header(order, elements, tuple(comments))
            case _:
                line = raw.decode("ascii", "replace").strip()[:80]
                raise PlyError(
                    f"expected a complete .ply header, got the line {line!r} in {name!r}: is the file cut off?"
                )
    raise PlyError(f"expected at most {_MAX_HEADER_LINES} header lines, got more in {name!r}")


def _add_field(element: _Element, field: str, kind: str, name: str) -> None:
    if any(field == known for known, _ in element.fields):
        raise PlyError(f"expected distinct properties, got {field!r} twice in {name!r}")
    element.fields.append((field, kind))


def _dtype(element: _Element, order: str) -> np.dtype:
    return np.dtype([(name, order + kind) for name, kind in element.fields])


def _skip(handle: BinaryIO, element: _Element, order: str, name: str) -> None:
    if not order:
        for _ in range(element.count):
            if not handle.readline():
                return
    elif element.has_list:
        raise PlyError(
            f"expected 'vertex' before elements with lists, got {element.name!r} first in {name!r}: reorder them"
        )
    else:
        handle.seek(element.count * _dtype(element, order).itemsize, 1)


def _read_binary(handle: BinaryIO, element: _Element, order: str, path: Path) -> dict[str, np.ndarray]:
    dtype = _dtype(element, order)
    available = path.stat().st_size - handle.tell()
    # Checked before reading: a forged count must not allocate.
    if available < element.count * dtype.itemsize:
        raise _too_short(path, element.count, max(0, available) // dtype.itemsize)
    rows = np.frombuffer(handle.read(element.count * dtype.itemsize), dtype)
    return {name: np.ascontiguousarray(rows[name], kind) for name, kind in element.fields}


def _read_ascii(handle: BinaryIO, element: _Element, _order: str, path: Path) -> dict[str, np.ndarray]:
    rows: list[list[float]] = []
    for number in range(element.count):
        line = handle.readline()
        if not line:
            raise _too_short(path, element.count, number)
        try:
            row = [float(word) for word in line.split()]
        except ValueError as error:
            raise PlyError(f"expected numbers, got {line[:80]!r} as vertex {number} of {path.name!r}") from error
        if len(row) != len(element.fields):
            raise PlyError(
                f"expected {len(element.fields)} numbers, got {len(row)} as vertex {number} of {path.name!r}"
            )
        rows.append(row)
    values = np.array(rows, np.float64).reshape(element.count, len(element.fields))
    return {name: values[:, i].astype(kind) for i, (name, kind) in enumerate(element.fields)}


def _too_short(path: Path, expected: int, got: int) -> PlyError:
    return PlyError(f"expected {expected} vertices, got {got} in {path.name!r}: the file is cut off; copy it again")
