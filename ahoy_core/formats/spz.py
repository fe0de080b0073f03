"""Gaussians as `.spz` (Niantic's compressed splats): versions 1 to 3 in gzip, version 4 in separate zstd streams.

Values are quantised: positions to 2^-fraction_bits, log scales to 1/16, opacities and colours to 8 bits, rotations
to three components (8 bits each up to version 2, 10 after). Axes are right, up, back: y up, facing +z. The layout
follows the format's public description (github.com/nianticlabs/spz).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import zstandard
from torch import Tensor

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.errors import SpzError
from ahoy_core.formats.ply import SH_C0
from ahoy_core.splat.gaussians import Gaussians

MAGIC = 0x5053474E
FRACTION_BITS = 12
_COLOR_SCALE = 0.15
_HEADER, _HEADER_4 = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
_SH_TERMS = (0, 3, 8, 15)
_MAX_POINTS = 50_000_000
_LARGEST = 2**23 - 1


class SpzCloud(NamedTuple):
    """Gaussians in the file's axes, higher spherical harmonics [N,K,3] or None, and the file's version."""

    gaussians: Gaussians
    sh_rest: Tensor | None
    version: int


class _Layout(NamedTuple):
    version: int
    number: int
    degree: int
    fraction_bits: int

    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, rotations and harmonics."""
        position, rotation = (6 if self.version == 1 else 9), (3 if self.version < 3 else 4)
        return tuple(self.number * size for size in (position, 1, 3, 3, rotation, 3 * _SH_TERMS[self.degree]))


def read_spz(path: str | Path) -> SpzCloud:
    """Read Gaussians from `.spz` of version 1 to 4.

    Raises:
        FileNotFoundError: No such file.
        SpzError: Another format or version, or cut off.
    """
    source = Path(path)
    data = source.read_bytes()
    try:
        layout, streams = _streams_4(data) if data[:4] == b"NGSP" else _streams_gzip(data)
    except (EOFError, gzip.BadGzipFile, zlib.error, zstandard.ZstdError, struct.error) as error:
        raise SpzError(f"expected a complete .spz, got {source.name!r} ({error}): is it cut off?") from error
    except SpzError as error:
        raise SpzError(f"{error} in {source.name!r}") from error
    return _decode(layout, streams)


def _streams_gzip(data: bytes) -> tuple[_Layout, list[bytes]]:
    if data[:2] != b"\x1f\x8b":
        raise SpzError("expected an .spz (gzip or NGSP), got neither")
    body = gzip.decompress(data)
    magic, version, count, degree, bits, _, _ = _HEADER.unpack_from(body)
    layout = _checked(_Layout(version, count, degree, bits), magic, range(1, 4))
    streams, start = [], _HEADER.size
    for size in layout.sizes():
        streams.append(body[start : start + size])
        start += size
    return _complete(layout, streams)


def _streams_4(data: bytes) -> tuple[_Layout, list[bytes]]:
    magic, version, count, degree, bits, _, number, toc = _HEADER_4.unpack_from(data)
    layout = _checked(_Layout(version, count, degree, bits), magic, range(4, 5))
    wanted = [size for size in layout.sizes() if size]
    if number != len(wanted) or toc < _HEADER_4.size or toc + 16 * number > len(data):
        raise SpzError(f"expected {len(wanted)} streams listed within the file, got {number} at byte {toc}")
    start, streams = toc + 16 * number, []
    for i, size in enumerate(layout.sizes()):
        if not size:
            streams.append(b"")
            continue
        packed, unpacked = struct.unpack_from("<QQ", data, toc + 16 * min(i, number - 1))
        if unpacked != size:
            raise SpzError(f"expected a stream of {size} bytes, got one of {unpacked}")
        streams.append(zstandard.ZstdDecompressor().decompress(data[start : start + packed], max_output_size=size))
        start += packed
    return _complete(layout, streams)


def _checked(layout: _Layout, magic: int, versions: range) -> _Layout:
    if magic != MAGIC or layout.version not in versions:
        raise SpzError(f"expected .spz of version 1 to 4, got magic {magic:#x} and version {layout.version}")
    if layout.degree > 3 or layout.number > _MAX_POINTS or layout.fraction_bits > 23:
        raise SpzError(f"expected at most {_MAX_POINTS} Gaussians of degree 3 or less, got {layout}")
    return layout


def _complete(layout: _Layout, streams: list[bytes]) -> tuple[_Layout, list[bytes]]:
    found = tuple(len(stream) for stream in streams)
    if found != layout.sizes():
        raise SpzError(f"expected streams of {layout.sizes()} bytes, got {found}: is it cut off?")
    return layout, streams


def _decode(layout: _Layout, streams: list[bytes]) -> SpzCloud:
    count = layout.number
    position, opacity, color, scale, rotation, rest = (np.frombuffer(stream, np.uint8) for stream in streams)
    if layout.version == 1:
        means = position.view("<f2").astype(np.float64).reshape(count, 3)
    else:
        low = position.reshape(count, 3, 3).astype(np.int32)
        whole = low[..., 0] | low[..., 1] << 8 | low[..., 2] << 16
        means = np.where(whole >= 2**23, whole - 2**24, whole) / 2.0**layout.fraction_bits
    dc = (color.reshape(count, 3) / 255 - 0.5) / _COLOR_SCALE
    quats = _first_three(rotation) if layout.version < 3 else _smallest_three(rotation)
    gaussians = Gaussians(
        means=_tensor(means),
        quats=_tensor(quats.reshape(count, 4)),
        scales=_tensor(np.exp(scale.reshape(count, 3) / 16.0 - 10)),
        opacities=_tensor(opacity / 255),
        colors=_tensor(0.5 + SH_C0 * dc),
    )
    terms = _SH_TERMS[layout.degree]
    sh_rest = _tensor((rest.reshape(count, terms, 3) - 128.0) / 128) if terms else None
    return SpzCloud(gaussians, sh_rest, layout.version)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _first_three(stored: np.ndarray) -> np.ndarray:
    """Quaternions wxyz from x, y, z of 8 bits each, w >= 0."""
    xyz = stored.reshape(-1, 3) / 127.5 - 1
    w = np.sqrt(np.clip(1 - (xyz**2).sum(1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], 1)


def _smallest_three(stored: np.ndarray) -> np.ndarray:
    """Quaternions wxyz from 2 bits that name the largest of x, y, z, w and 10 bits (sign, magnitude) for the others."""
    packed = stored.view("<u4").astype(np.int64)
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4))
    for component in (3, 2, 1, 0):
        own = component != largest
        value = (packed & 511) / 511 * np.sqrt(0.5) * np.where(packed & 512, -1, 1)
        xyzw[:, component] = np.where(own, value, 0)
        packed = np.where(own, packed >> 10, packed)
    missing = np.sqrt(np.clip(1 - (xyzw**2).sum(1), 0, None))
    xyzw[np.arange(len(xyzw)), largest] = missing
    return xyzw[:, [3, 0, 1, 2]]


def write_spz(
    path: str | Path, gaussians: Gaussians, sh_rest: Tensor | None = None, *, version: int = 4, fraction_bits: int = 12
) -> None:
    """Write Gaussians as `.spz` of version 2, 3 or 4; the axes should be right, up, back.

    Args:
        path: Target; replaced only when the new file is complete.
        gaussians: N Gaussians.
        sh_rest: [N,K,3] higher spherical harmonics, K = 3, 8 or 15.
        version: 2 and 3 are gzip, which older readers know; 4 is zstd.
        fraction_bits: Positions are kept to 2^-bits units (12: a quarter of a millimetre).

    Raises:
        SpzError: Values that are not finite, positions too far out for the bits, or another version.
    """
    if version not in (2, 3, 4) or not 0 <= fraction_bits <= 23:
        raise SpzError(f"expected version 2, 3 or 4 and 0 to 23 bits, got {version} and {fraction_bits}")
    streams = _encode(gaussians, sh_rest, version, fraction_bits)
    degree = _SH_TERMS.index(0 if sh_rest is None else sh_rest.shape[1])
    if version < 4:
        head = _HEADER.pack(MAGIC, version, len(gaussians), degree, fraction_bits, 0, 0)
        # No time in the header: equal Gaussians give equal bytes.
        data = gzip.compress(head + b"".join(streams), mtime=0)
    else:
        used = [stream for stream in streams if stream]
        packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in used]
        head = _HEADER_4.pack(MAGIC, version, len(gaussians), degree, fraction_bits, 0, len(used), _HEADER_4.size)
        toc = b"".join(struct.pack("<QQ", len(p), len(u)) for p, u in zip(packed, used, strict=True))
        data = head + toc + b"".join(packed)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _encode(gaussians: Gaussians, sh_rest: Tensor | None, version: int, fraction_bits: int) -> list[bytes]:
    means, quats, scales, opacities, colors = (
        getattr(gaussians, name).detach().cpu().double().numpy()
        for name in ("means", "quats", "scales", "opacities", "colors")
    )
    if not all(np.isfinite(values).all() for values in (means, quats, scales, opacities, colors)):
        raise SpzError("expected finite Gaussians, got NaN or infinity: remove those rows first")
    fixed = np.rint(means * 2.0**fraction_bits).astype(np.int64)
    if len(fixed) and np.abs(fixed).max() > _LARGEST:
        limit = _LARGEST / 2**fraction_bits
        raise SpzError(f"expected positions within {limit:.0f} units, got {np.abs(means).max():.0f}: use fewer bits")
    unsigned = (fixed & 0xFFFFFF)[..., None] >> np.array([0, 8, 16]) & 0xFF
    dc = (colors - 0.5) / SH_C0
    with np.errstate(divide="ignore"):
        logs = np.log(scales)
    rest = b""
    if sh_rest is not None:
        rest = _byte(sh_rest.detach().cpu().double().numpy() * 128 + 128).tobytes()
    return [
        unsigned.astype(np.uint8).tobytes(),
        _byte(opacities * 255).tobytes(),
        _byte((dc * _COLOR_SCALE + 0.5) * 255).tobytes(),
        _byte((logs + 10) * 16).tobytes(),
        _packed_first_three(quats) if version < 3 else _packed_smallest_three(quats),
        rest,
    ]


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(np.nan_to_num(values, neginf=0.0)), 0, 255).astype(np.uint8)


def _normalised(quats: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(length > 0, quats / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])


def _packed_first_three(quats: np.ndarray) -> bytes:
    unit = _normalised(quats)
    xyz = np.where(unit[:, :1] < 0, -unit[:, 1:], unit[:, 1:])
    return _byte((xyz + 1) * 127.5).tobytes()


def _packed_smallest_three(quats: np.ndarray) -> bytes:
    xyzw = _normalised(quats)[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    packed = largest.astype(np.int64)
    for component in range(4):
        magnitude = np.rint(np.abs(xyzw[:, component]) / np.sqrt(0.5) * 511).clip(0, 511).astype(np.int64)
        value = magnitude | np.where(xyzw[:, component] < 0, 512, 0)
        packed = np.where(component == largest, packed, packed << 10 | value)
    return packed.astype("<u4").tobytes()
