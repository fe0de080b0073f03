"""Other rasterizers, brought to the same call so that they are measured in the same run as ours.

A peer that is not installed is left out by name, with how to install it; nothing of a peer is copied here.
"""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import subprocess
import sys
import tempfile
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.scenes import Scene

Run = Callable[[bool], None]
"""Renders the scene; True adds the backward pass."""


class PeerUnavailableError(RuntimeError):
    """A peer cannot run here; the message says why and what would change it."""


@dataclass(frozen=True)
class Peer:
    """A name, how to prepare a scene, and whether it runs on a GPU, where only the wall clock tells its time."""

    name: str
    prepare: Callable[[Scene], Run]
    gpu: bool = False


def leaves(scene: Scene) -> list[Tensor]:
    """The scene's differentiable inputs, as fresh leaves."""
    inputs = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats)
    return [value.clone().requires_grad_() for value in inputs]


def ours(scene: Scene) -> Run:
    """`ahoy_core.splat.rasterization`, as a user calls it."""
    from ahoy_core.splat import rasterization

    size = scene.spec.size

    def run(backward: bool) -> None:
        means, quats, scales, opacities, colors, viewmats = leaves(scene) if backward else _values(scene)
        image, _, _ = rasterization(
            means, quats, scales, opacities, colors, viewmats, scene.Ks, size, size, backgrounds=scene.backgrounds
        )
        if backward:
            image.backward(scene.v_render)

    return run


def _values(scene: Scene) -> tuple[Tensor, ...]:
    return scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats


def gsplat_cuda(scene: Scene) -> Run:
    """The same call on a GPU, which is gsplat's kernels; each run waits until the GPU is done."""
    if not torch.cuda.is_available():
        raise PeerUnavailableError("no NVIDIA GPU here")
    if importlib.util.find_spec("gsplat") is None:
        raise PeerUnavailableError("gsplat is not installed: pip install -c constraints.txt '.[cuda]'")
    tensors = {name: value.cuda() for name, value in vars(scene).items() if isinstance(value, Tensor)}
    render = ours(replace(scene, **tensors))

    def run(backward: bool) -> None:
        render(backward)
        torch.cuda.synchronize()

    return run


def yardstick(scene: Scene) -> Run:
    """The C++ AVX2 rasterizer in `benchmarks/yardstick`, compiled for this machine."""
    library = _build_yardstick()
    library.ctx_new.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.ctx_new())
    arrays = [np.ascontiguousarray(v.numpy()) for v in (*_values(scene)[:5], scene.viewmats[0], scene.Ks[0])]
    background, gradient = scene.backgrounds.numpy(), np.ascontiguousarray(scene.v_render[0].numpy())
    n, size = scene.spec.n, scene.spec.size
    image, alpha = np.empty((size, size, 3), np.float32), np.empty((size, size), np.float32)
    grads = [np.empty_like(a) for a in arrays[:5]] + [np.zeros((4, 4), np.float32)]

    def pointers(*values: np.ndarray) -> list[ctypes.c_void_p]:
        return [ctypes.c_void_p(v.ctypes.data) for v in values]

    def run(backward: bool) -> None:
        library.setth(torch.get_num_threads())
        library.fwd(context, n, *pointers(*arrays), size, size, *pointers(background, image, alpha), 0)
        if backward:
            inputs = (*arrays[:3], *arrays[5:], background, gradient)
            library.bwd(context, *pointers(*inputs), None, *pointers(*grads))

    return run


def _build_yardstick() -> ctypes.CDLL:
    compiler = shutil.which("g++")
    if compiler is None:
        raise PeerUnavailableError("the C++ yardstick needs g++ on PATH")
    target = Path(tempfile.mkdtemp(prefix="ahoy-yardstick-")) / "splat.so"
    source = Path(__file__).parent / "yardstick" / "splat_avx2.cpp"
    flags = ("-O3", "-march=native", "-ffast-math", "-fno-finite-math-only", "-fopenmp", "-shared", "-fPIC")
    done = subprocess.run(
        [compiler, *flags, str(source), "-o", str(target)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise PeerUnavailableError(f"the C++ yardstick did not compile here: {done.stderr.strip()[-300:]}")
    return ctypes.CDLL(str(target))


def gsplat_torch(scene: Scene) -> Run:
    """Gsplat's pure-torch reference; the two index steps it only has in CUDA are done here, vectorised."""
    reference = _gsplat_reference()
    size, tile = scene.spec.size, 16
    tiles = (size + tile - 1) // tile

    def run(backward: bool) -> None:
        means, quats, scales, opacities, colors, viewmats = leaves(scene) if backward else _values(scene)
        covars, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
        radii, means2d, depths, conics, _ = reference._fully_fused_projection(
            means, covars, viewmats, scene.Ks, size, size
        )
        ids, offsets = _tile_lists(means2d.detach()[0], radii[0], depths.detach()[0], tile, tiles)
        wrapper = sys.modules[reference.__package__ + "._wrapper"]
        wrapper.rasterize_to_indices_in_range = _indices_in_range  # the reference looks it up at each call
        image, _ = reference._rasterize_to_pixels(
            means2d,
            conics,
            colors[None],
            opacities[None],
            size,
            size,
            tile,
            offsets[None],
            ids,
            scene.backgrounds,
            batch_per_iter=2**30,
        )
        if backward:
            image.backward(scene.v_render)

    return run


def _gsplat_reference() -> types.ModuleType:
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        raise PeerUnavailableError("gsplat is not installed: pip install -c constraints.txt '.[bench]'")
    package = Path(spec.origin).parent / "cuda"
    name = "ahoy_peer_gsplat"
    parent = types.ModuleType(name)
    parent.__path__ = [str(package)]
    sys.modules[name] = parent
    sys.modules[f"{name}._wrapper"] = types.ModuleType(f"{name}._wrapper")  # stands for the CUDA-only part
    sys.modules["nerfacc"] = _compositing()
    found = importlib.util.spec_from_file_location(f"{name}._torch_impl", package / "_torch_impl.py")
    if found is None or found.loader is None:
        raise PeerUnavailableError("this gsplat has no _torch_impl.py; the benchmark was written for 1.5.3")
    module = importlib.util.module_from_spec(found)
    sys.modules[found.name] = module
    found.loader.exec_module(module)
    return module


def _compositing() -> types.ModuleType:
    """The two functions of nerfacc that the reference calls, in plain torch (nerfacc has them in CUDA only)."""
    module = types.ModuleType("nerfacc")

    def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        log_keep = torch.log1p(-alphas)
        before = torch.cumsum(log_keep.double(), 0) - log_keep
        first = torch.ones_like(ray_indices, dtype=torch.bool)
        first[1:] = ray_indices[1:] != ray_indices[:-1]
        start = torch.cummax(torch.where(first, torch.arange(len(first)), 0), 0).values
        trans = torch.exp(before - before[start]).to(alphas.dtype)
        return alphas * trans, trans

    def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
        source = weights[:, None] if values is None else weights[:, None] * values
        return torch.zeros(n_rays, source.shape[1], dtype=source.dtype).index_add(0, ray_indices, source)

    module.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    module.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    return module


def _tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, tile: int, tiles: int) -> tuple[Tensor, Tensor]:
    low = torch.floor((means2d - radii) / tile).long().clamp(0, tiles)
    high = torch.ceil((means2d + radii) / tile).long().clamp(0, tiles)
    spans = (high - low) * (radii > 0).all(-1, keepdim=True)
    counts = spans.prod(-1)
    ids = torch.repeat_interleave(torch.arange(len(counts)), counts)
    local = torch.arange(len(ids)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    x, y = low[ids, 0] + local % spans[ids, 0], low[ids, 1] + local // spans[ids, 0]
    by_depth = torch.argsort(depths[ids], stable=True)
    tile_ids = (y * tiles + x)[by_depth]
    order = by_depth[torch.argsort(tile_ids, stable=True)]
    per_tile = torch.bincount(y * tiles + x, minlength=tiles * tiles)
    return ids[order].int(), (per_tile.cumsum(0) - per_tile).int().reshape(tiles, tiles)


def _indices_in_range(
    start: int,
    end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile: int,
    offsets: Tensor,
    ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """All (Gaussian, pixel) pairs that blend, pixel by pixel in depth order: what the CUDA kernel returns."""
    from benchmarks.pairs import blended_pairs

    gaussians, pixels = blended_pairs(
        means2d.detach()[0].numpy(),
        conics.detach()[0].numpy(),
        opacities.detach()[0].numpy(),
        width,
        height,
        tile,
        np.append(offsets.reshape(-1).numpy(), len(ids)).astype(np.int64),
        ids.numpy(),
    )
    return torch.from_numpy(gaussians), torch.from_numpy(pixels), torch.zeros(len(pixels), dtype=torch.int64)


PEERS = (
    Peer("ahoy", ours),
    Peer("C++ AVX2 yardstick", yardstick),
    Peer("gsplat torch reference", gsplat_torch),
    Peer("gsplat on a GPU", gsplat_cuda, gpu=True),
)
