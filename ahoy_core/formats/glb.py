"""Gaussians as binary glTF with the extension KHR_gaussian_splatting (Khronos).

One mesh of points whose attributes hold the splats: scales and opacities as rendered, rotations as unit xyzw, spherical
harmonics by coefficient, and a plain colour for viewers that know points only. Axes are glTF's: y up, facing +z.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ahoy_core.formats.atomic import atomic_path
from ahoy_core.formats.errors import GlbError
from ahoy_core.formats.ply import SH_C0
from ahoy_core.splat.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT = 5126
_POINTS = 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_COUNTS = {name: count for count, name in _TYPES.items()}
_BANDS = ((1, 3), (2, 5), (3, 7))


class GlbCloud(NamedTuple):
    """Gaussians in the file's axes, harmonics [N,K,3] or None, our own attributes [N] by name, and `asset.extras`."""

    gaussians: Gaussians
    sh_rest: Tensor | None
    extra: dict[str, np.ndarray]
    extras: dict[str, Any]


def write_glb(
    path: str | Path,
    gaussians: Gaussians,
    sh_rest: Tensor | None = None,
    extra: Mapping[str, Tensor] | None = None,
    extras: Mapping[str, Any] | None = None,
) -> None:
    """Write Gaussians as `.glb`.

    Args:
        path: Target; replaced only when the new file is complete.
        gaussians: N Gaussians in glTF's axes.
        sh_rest: [N,K,3] higher spherical harmonics, K = 3, 8 or 15.
        extra: Values [N] by name, stored as attributes `_NAME` of our own, which other readers skip.
        extras: What `asset.extras` shall say (licence, label, shares).

    Raises:
        GlbError: No Gaussians (glTF has no empty accessors), or values that are not finite.
    """
    if len(gaussians) == 0:
        raise GlbError("expected at least one Gaussian, got none; glTF cannot hold an empty mesh")
    columns = _attributes(gaussians, sh_rest) | {
        f"_{name.upper()}": _array(values)[:, None] for name, values in (extra or {}).items()
    }
    if not all(np.isfinite(values).all() for values in columns.values()):
        raise GlbError("expected finite Gaussians, got NaN or infinity: remove those rows first")
    views, accessors, start = [], [], 0
    for name, values in columns.items():
        views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes})
        accessor: dict[str, Any] = {"bufferView": len(views) - 1, "componentType": _FLOAT, "count": len(values)}
        accessor["type"] = _TYPES[values.shape[1]]
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor)
        start += values.nbytes
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    splats |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: number for number, name in enumerate(columns)},
        "extensions": {EXTENSION: splats},
    }
    document = {
        "asset": {"version": "2.0", "generator": "ahoy", "extras": dict(extras or {})},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "avatar"}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    _write(path, document, b"".join(values.tobytes() for values in columns.values()))


def _attributes(gaussians: Gaussians, sh_rest: Tensor | None) -> dict[str, np.ndarray]:
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1)
    quats[(gaussians.quats == 0).all(1)] = quats.new_tensor([1.0, 0, 0, 0])
    colors = _array(gaussians.colors).clip(0, 1)
    columns = {
        "POSITION": _array(gaussians.means),
        "COLOR_0": np.concatenate([colors, _array(gaussians.opacities)[:, None].clip(0, 1)], 1),
        f"{EXTENSION}:ROTATION": _array(quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": _array(gaussians.scales),
        f"{EXTENSION}:OPACITY": _array(gaussians.opacities)[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (_array(gaussians.colors) - np.float32(0.5)) / np.float32(SH_C0),
    }
    start = 0
    for degree, terms in _BANDS:
        if sh_rest is not None and start + terms <= sh_rest.shape[1]:
            for n in range(terms):
                columns[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = _array(sh_rest[:, start + n])
        start += terms
    return columns


def _array(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().cpu().numpy(), "<f4")


def _write(path: str | Path, document: Mapping[str, Any], body: bytes) -> None:
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        handle.write(struct.pack("<III", _MAGIC, 2, total))
        handle.write(struct.pack("<II", len(text), _JSON) + text)
        handle.write(struct.pack("<II", len(body), _BIN) + body)


def read_glb(path: str | Path) -> GlbCloud:
    """Read the first Gaussian splats of a `.glb`, float attributes only; transforms of nodes are not applied.

    Raises:
        FileNotFoundError: No such file.
        GlbError: Another format, cut off, or without the extension's attributes.
    """
    source = Path(path)
    data = source.read_bytes()
    try:
        document, body = _parts(data)
        primitive = next(p for m in document["meshes"] for p in m["primitives"] if EXTENSION in p.get("extensions", {}))
        wanted = {
            name: number
            for name, number in primitive["attributes"].items()
            if name == "POSITION" or name.startswith((EXTENSION, "_"))
        }
        columns = {name: _column(document, body, number) for name, number in wanted.items()}
        return _cloud(columns, document["asset"].get("extras", {}))
    except StopIteration:
        raise GlbError(f"expected a mesh with {EXTENSION} in {source.name!r}, got none") from None
    except (KeyError, IndexError, ValueError, struct.error, UnicodeDecodeError) as error:
        raise GlbError(f"expected a complete .glb of splats, got {source.name!r} ({error}): is it cut off?") from error


def _parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = struct.unpack_from("<III", data)
    if magic != _MAGIC or version != 2 or total > len(data):
        raise ValueError(f"magic {magic:#x}, version {version}, {total} bytes announced, {len(data)} there")
    size, kind = struct.unpack_from("<II", data, 12)
    if kind != _JSON:
        raise ValueError("no JSON first")
    start = 20 + size
    length, kind = struct.unpack_from("<II", data, start)
    if kind != _BIN:
        raise ValueError("no binary part")
    return json.loads(data[20 : 20 + size]), data[start + 8 : start + 8 + length]


def _column(document: Mapping[str, Any], body: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    if accessor["componentType"] != _FLOAT or view.get("byteStride"):
        raise ValueError("an attribute that is not packed float32")
    width = _COUNTS[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(body, "<f4", accessor["count"] * width, start).reshape(-1, width).copy()


def _cloud(columns: Mapping[str, np.ndarray], extras: dict[str, Any]) -> GlbCloud:
    rest = [
        columns[name]
        for degree, terms in _BANDS
        for n in range(terms)
        if (name := f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}") in columns
    ]
    gaussians = Gaussians(
        means=torch.from_numpy(columns["POSITION"]),
        quats=torch.from_numpy(columns[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]]),
        scales=torch.from_numpy(columns[f"{EXTENSION}:SCALE"]),
        opacities=torch.from_numpy(columns[f"{EXTENSION}:OPACITY"][:, 0]),
        colors=torch.from_numpy(np.float32(0.5) + np.float32(SH_C0) * columns[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]),
    )
    own = {name[1:].lower(): values[:, 0] for name, values in columns.items() if name.startswith("_")}
    return GlbCloud(gaussians, torch.from_numpy(np.stack(rest, 1)) if rest else None, own, extras)
