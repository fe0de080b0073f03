"""`rasterization`: differentiable rendering of 3D Gaussians with gsplat's signature, on the CPU or through gsplat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ahoy_core.splat import constants, validate
from ahoy_core.splat._autograd import Blending, Projected, blend, project
from ahoy_core.splat._camera import View
from ahoy_core.splat._plan import Plan, Tiling, default_budget
from ahoy_core.splat._threads import resolve_threads
from ahoy_core.splat.cuda import rasterize_cuda
from ahoy_core.splat.sh import sh_to_colors

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
Window = tuple[int, int, int, int]
"""Left, top, width and height of a part of an image, pixels."""


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = constants.NEAR_PLANE,
    far_plane: float = constants.FAR_PLANE,
    radius_clip: float = 0.0,
    eps2d: float = constants.EPS2D,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    camera_model: Literal["pinhole", "ortho"] = "pinhole",
    covars: Tensor | None = None,
    *,
    tile_size: int = 16,
    channel_chunk: int = 32,
    alpha_cutoff: float = constants.ALPHA_CUTOFF,
    transmittance_stop: float = constants.TRANSMITTANCE_STOP,
    memory_budget: int | None = None,
    num_threads: int | None = None,
    window: Window | None = None,
    **gsplat_only: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians through C cameras (Kerbl et al. 2023; signature, conventions and meta of gsplat 1.5).

    Differentiable in means, quats, scales, covars, opacities, colors, viewmats and backgrounds; float32, or float64
    throughout; means, viewmats and Ks may be float64 beside float32, for worlds far from the origin. Gaussians are
    ordered by camera depth in float64, ties by their place in the input. A row with a NaN or an infinity is left out
    and counted. A zero quaternion is the identity and gets no gradient.

    Args:
        means: [N,3] world, metres.
        quats: [N,4] wxyz, any length; ignored (may be None) if covars is given.
        scales: [N,3] standard deviations, metres, >= 0; ignored (may be None) if covars is given.
        opacities: [N] in [0,1].
        colors: [N,D] or [C,N,D] of any D >= 1; with sh_degree coefficients [N,K,3] or [C,N,K,3].
        viewmats: [C,4,4] world -> camera (OpenCV axes).
        Ks: [C,3,3] pixels without skew, pixel centres at +0.5; orthographic: pixels per metre.
        width: Pixels.
        height: Pixels.
        near_plane: Gaussians at camera depth <= near_plane are left out, metres.
        far_plane: Gaussians at camera depth >= far_plane are left out, metres.
        radius_clip: Gaussians whose radius on the image is not above this are left out, pixels.
        eps2d: Added to the diagonal of the 2D covariance, pixels^2.
        sh_degree: Degree 0-3 of spherical harmonics in colors, or None for plain colours.
        backgrounds: [C,D] behind everything (3 with sh_degree), or None for black. Depth channels have none.
        render_mode: RGB; D is the accumulated depth, ED that over alpha; depth is the last channel.
        rasterize_mode: antialiased scales opacities by sqrt(det / blurred det) (Mip-Splatting).
        camera_model: pinhole or ortho.
        covars: [N,3,3] world covariances, metres^2, instead of quats and scales; the symmetric part counts.
        tile_size: 8, 16 or 32 pixels; does not change the image.
        channel_chunk: Channels rendered at a time, at most 32.
        alpha_cutoff: Contributions under it are left out.
        transmittance_stop: A pixel ends before the Gaussian that would take it to this transmittance.
        memory_budget: Bytes that intersections may take (None: half of the machine's memory).
        num_threads: Threads (None: PyTorch's). The image does not depend on it; gradients repeat at a fixed number.
        window: Draw only these pixels of the image: left, top, width and height; the rest takes no time. The result is
            that part of the whole image, [C,h,w,D']; meta's means2d and tiles are the window's. CPU only.
        **gsplat_only: Further arguments of gsplat, which are refused unless they ask for nothing.

    Returns:
        Colours [C,H,W,D'], alphas [C,H,W,1] and meta: radii [C,N,2] (0 where not visible), means2d [C,N,2] (supports
        retain_grad), depths [C,N], conics [C,N,3], opacities [C,N], tiles_per_gauss [C,N], isect_offsets [C,th,tw],
        flatten_ids [I], n_isects, n_invalid (rows left out because they are not finite), width, height, tile_size,
        tile_width, tile_height, n_cameras.

    Raises:
        ValueError: Shapes, values or options are wrong.
        TypeError: A tensor has the wrong type or dtype.
        NotImplementedError: An argument of gsplat is not supported.
        MemoryError: The intersections would not fit into memory_budget.
        ImportError: Tensors are on a GPU and gsplat is not installed.
    """
    validate.refuse_gsplat_only(gsplat_only)
    validate.check_options(
        width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, render_mode, rasterize_mode, camera_model,
        tile_size, alpha_cutoff, transmittance_stop, channel_chunk, memory_budget,
    )  # fmt: skip
    if window is not None:
        validate.check_window(window, width, height, means.is_cuda)
    threads = resolve_threads(num_threads)
    if covars is not None:
        quats, scales = None, None
    tensors = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors,
        "viewmats": viewmats, "Ks": Ks, "backgrounds": backgrounds, "covars": covars,
    }  # fmt: skip
    validate.check_tensors(tensors)
    validate.check_shapes(means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds, sh_degree)
    validate.check_cameras(viewmats, Ks)
    if means.is_cuda:
        options = {
            "width": width, "height": height, "near_plane": near_plane, "far_plane": far_plane,
            "radius_clip": radius_clip, "eps2d": eps2d, "sh_degree": sh_degree, "render_mode": render_mode,
            "rasterize_mode": rasterize_mode, "camera_model": camera_model, "tile_size": tile_size,
            "channel_chunk": channel_chunk,
        }  # fmt: skip
        return rasterize_cuda(tensors, options, alpha_cutoff, transmittance_stop)
    view = View(
        width, height, near_plane, far_plane, eps2d, radius_clip, alpha_cutoff, camera_model == "ortho",
        rasterize_mode == "antialiased",
    )  # fmt: skip
    flat = colors.flatten(-2) if sh_degree is not None else colors
    projected = project(means, quats, scales, covars, viewmats, Ks, opacities, flat.detach(), view, threads)
    if window is not None:
        # Projected as in the whole image, so that what crosses the window's border has the whole image's shape.
        width, height = window[2:]
        projected = projected._replace(means2d=projected.means2d - projected.means2d.new_tensor(window[:2]))
    opacities = opacities.expand(len(viewmats), -1)
    if view.antialiased:
        opacities = opacities * projected.compensations
    if sh_degree is not None:
        colors = sh_to_colors(means, viewmats, colors, projected.radii, sh_degree, threads)
    features, backgrounds = _channels(render_mode, colors, projected.depths, backgrounds)
    budget = default_budget() if memory_budget is None else memory_budget
    blending = Blending(Tiling(width, height, tile_size), alpha_cutoff, transmittance_stop, budget, threads)
    image, alphas, plans = _in_chunks(projected, opacities, features, backgrounds, blending, min(channel_chunk, 32))
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], -1)
    return image, alphas, _meta(projected, opacities, plans, blending.tiling)


def _channels(mode: str, colors: Tensor, depths: Tensor, backgrounds: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Features to blend and their background: colours, depth, or both with depth last (background 0)."""
    if mode == "RGB":
        return colors, backgrounds
    depth = depths[..., None]
    if mode in ("D", "ED"):
        return depth, None
    features = torch.cat([colors.expand(len(depths), -1, -1), depth], -1)
    return features, None if backgrounds is None else torch.nn.functional.pad(backgrounds, (0, 1))


def _in_chunks(
    projected: Projected, opacities: Tensor, features: Tensor, backgrounds: Tensor | None, blending: Blending,
    chunk: int,
) -> tuple[Tensor, Tensor, list[Plan]]:  # fmt: skip
    """Blend at most `chunk` channels at a time; the alphas are those of the first chunk."""
    if features.shape[-1] <= chunk:
        return blend(projected, opacities, features.contiguous(), backgrounds, blending)
    backs = [None] * features.shape[-1] if backgrounds is None else backgrounds.split(chunk, -1)
    results = [
        blend(projected, opacities, part.contiguous(), None if back is None else back.contiguous(), blending)
        for part, back in zip(features.split(chunk, -1), backs, strict=False)
    ]
    return torch.cat([r[0] for r in results], -1), results[0][1], results[0][2]


class _Meta(dict[str, Any]):
    """gsplat's meta; what is large and seldom read is made when first read."""

    def __init__(self, values: dict[str, Any], later: dict[str, Callable[[], Tensor]]) -> None:
        super().__init__(values)
        self._later = later

    def __missing__(self, key: str) -> Any:
        self[key] = self._later[key]()
        return self[key]

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or key in self._later

    def get(self, key: str, default: Any = None) -> Any:
        """Value of a key, made if need be."""
        return self[key] if key in self else default  # noqa: SIM401


def _conics(factors: Tensor) -> Tensor:
    """Inverse 2D covariances [C,N,3] xx, xy, yy of the factors (a, b, c)."""
    a, b, c = factors.unbind(-1)
    return torch.stack([a * a, a * b, b * b + c * c], -1) / constants.KAPPA


def _flatten_ids(plans: list[Plan]) -> Tensor:
    """Row of [C,N] of every intersection, by camera, tile and depth."""
    ids = [plan.owners()[plan.ids] + c * len(plan.slots) for c, plan in enumerate(plans)]
    return torch.from_numpy(np.concatenate(ids))


def _meta(projected: Projected, opacities: Tensor, plans: list[Plan], tiling: Tiling) -> dict[str, Any]:
    """Intermediate results under gsplat's names (as with packed=False)."""
    totals = np.cumsum([0] + [len(plan.ids) for plan in plans])
    offsets = np.stack([plan.starts[:-1] + before for plan, before in zip(plans, totals, strict=False)])
    values = {
        "radii": projected.radii,
        "means2d": projected.means2d,
        "depths": projected.depths,
        "opacities": opacities,
        "isect_offsets": torch.from_numpy(offsets.reshape(-1, tiling.tiles_y, tiling.tiles_x)),
        "n_isects": int(totals[-1]),
        "n_invalid": int(projected.invalid.sum()),
        "tile_width": tiling.tiles_x,
        "tile_height": tiling.tiles_y,
        "width": tiling.width,
        "height": tiling.height,
        "tile_size": tiling.tile_size,
        "n_cameras": len(plans),
    }
    factors = projected.factors
    later = {
        "conics": lambda: _conics(factors),
        "flatten_ids": lambda: _flatten_ids(plans),
        "tiles_per_gauss": lambda: torch.from_numpy(np.stack([plan.tiles_per_gauss() for plan in plans])),
    }
    return _Meta(values, later)
