"""The two differentiable steps, as in gsplat: projection of Gaussians, blending of what was projected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ahoy_core.splat import _blend, _blend_backward
from ahoy_core.splat._camera import View, pack_cameras
from ahoy_core.splat._plan import Plan, Tiling, make_plan, padded_channels
from ahoy_core.splat._project import project_forward
from ahoy_core.splat._project_backward import project_backward
from ahoy_core.splat._simd import LANES, sums_width
from ahoy_core.splat._threads import run_parts, split
from ahoy_core.splat.constants import ALPHA_MAX

Array = NDArray[Any]


class Projected(NamedTuple):
    """What C cameras see of N Gaussians; rows with radius 0 are not visible and hold zeros.

    The first five are differentiable. factors (a, b, c) give KAPPA d^T Sigma^-1 d = (a dx + b dy)^2 + (c dy)^2.
    """

    means2d: Tensor  # [C,N,2] pixels
    depths: Tensor  # [C,N] camera z, metres
    conics: Tensor  # [C,N,3] inverse 2D covariance xx, xy, yy
    factors: Tensor  # [C,N,3]
    compensations: Tensor  # [C,N], [0,N] unless antialiased
    radii: Tensor  # [C,N,2] int32 pixels
    residuals: Tensor  # [C,N,2] what rounding took from means2d
    order_keys: Tensor  # [C,N] float64 depth of visible rows
    invalid: Tensor  # [N] bool: something of this row is not finite


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().numpy()


def _rows(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Placeholder without rows for an input that was not given."""
    return torch.empty((0, *shape), dtype=like.dtype)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, covars: Tensor, viewmats: Tensor, opacities: Tensor,
        features: Tensor, cameras: Array, antialiased: bool, threads: int,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        count, total = len(cameras), len(means)
        empty = {"dtype": opacities.dtype}
        out = [torch.empty((count, total, k), **empty) for k in (2, 2, 3, 3)]
        means2d, residuals, conics, factors = out
        depths = torch.empty((count, total), **empty)
        compensations = torch.empty((count if antialiased else 0, total), **empty)
        radii = torch.empty((count, total, 2), dtype=torch.int32)
        keys, invalid = torch.empty((count, total), dtype=torch.float64), torch.zeros(total, dtype=torch.bool)
        spans = split(total, threads)
        inputs = [_numpy(t) for t in (means, quats, scales, covars, opacities)]
        for c in range(count):
            own = _numpy(features if features.dim() == 2 else features[c])
            rows = [_numpy(t[c] if len(t) else t) for t in (radii, means2d, residuals, depths, conics, factors)]
            rows += [_numpy(compensations[c] if antialiased else depths[c]), _numpy(keys[c]), _numpy(invalid)]
            negative = run_parts(
                lambda p, c=c, own=own, rows=rows: project_forward(
                    *spans[p], cameras[c], antialiased, *inputs, own, *rows
                ),
                len(spans),
            )
            if max(negative) >= 0:
                row = max(negative)
                raise ValueError(
                    f"scales: expected values >= 0, got {scales[row].tolist()} in row {row}; scales are standard "
                    "deviations, take exp() of log-scales first"
                )
        ctx.save_for_backward(means, quats, scales, covars, radii)
        ctx.cameras, ctx.spans, ctx.view_dtype = cameras, spans, viewmats.dtype
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, residuals, keys, invalid)
        return means2d, depths, conics, factors, compensations, radii, residuals, keys, invalid

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
        means, quats, scales, covars, radii = ctx.saved_tensors
        v_inputs = [torch.zeros_like(t) for t in (means, quats, scales, covars)]
        inputs, outputs = [_numpy(t) for t in (means, quats, scales, covars)], [_numpy(t) for t in v_inputs]
        pose = np.zeros((len(ctx.spans), len(ctx.cameras), 12))
        sizes = ((2,), (), (3,), (3,), ())
        for c in range(len(ctx.cameras)):
            v = [
                _numpy(_rows(size, quats) if g is None or len(g) == 0 else g[c].contiguous())
                for g, size in zip(grads[:5], sizes, strict=True)
            ]
            own = _numpy(radii[c])
            run_parts(
                lambda p, c=c, v=v, own=own: project_backward(
                    *ctx.spans[p], ctx.cameras[c], *inputs, own, *v, *outputs, pose[p, c]
                ),
                len(ctx.spans),
            )
        v_viewmats = np.zeros((len(ctx.cameras), 4, 4))
        summed = pose.sum(0)
        v_viewmats[:, :3, :3], v_viewmats[:, :3, 3] = summed[:, :9].reshape(-1, 3, 3), summed[:, 9:]
        return *v_inputs, torch.from_numpy(v_viewmats).to(ctx.view_dtype), *(None,) * 5


def project(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, viewmats: Tensor, Ks: Tensor,
    opacities: Tensor, features: Tensor, view: View, threads: int = 1,
) -> Projected:  # fmt: skip
    """Project Gaussians to every camera; differentiable in means, quats, scales, covars and viewmats.

    Args:
        means: [N,3] world, metres.
        quats: [N,4] wxyz, ignored if covars are given.
        scales: [N,3] metres, ignored if covars are given.
        covars: [N,3,3] metres^2, of which the symmetric part counts, or None.
        viewmats: [C,4,4] world -> camera.
        Ks: [C,3,3] pixels.
        opacities: [N]; decides, without gradient, how far a Gaussian reaches.
        features: [N,K] or [C,N,K]; looked at only to leave out rows that are not finite.
        view: Image size, planes and options.
        threads: Threads to use.

    Raises:
        ValueError: If a scale is negative.
    """
    cameras = pack_cameras(_numpy(viewmats.double()), _numpy(Ks.double()), view)
    quats, scales = (_rows((4,), opacities), _rows((3,), opacities)) if covars is not None else (quats, scales)
    covars = _rows((3, 3), opacities) if covars is None else covars
    return Projected(
        *_Project.apply(means, quats, scales, covars, viewmats, opacities, features, cameras, view.antialiased, threads)
    )


@dataclass(frozen=True)
class Blending:
    """Constants of one blending: how the image is tiled, thresholds, and resources."""

    tiling: Tiling
    alpha_cutoff: float
    transmittance_stop: float
    budget: int
    threads: int

    def limits(self, dtype: Any) -> Array:
        """log2 cutoff, alpha clamp, transmittance stop and 1, as the kernels read them."""
        return np.array([np.log2(self.alpha_cutoff), ALPHA_MAX, self.transmittance_stop, 1.0]).astype(dtype)


def _scratch(size: int, dtype: Any) -> Array:
    """An array that starts on a cache line, so that no vector straddles two."""
    room = np.zeros(size + 64 // np.dtype(dtype).itemsize, dtype)
    start = -room.ctypes.data % 64 // room.itemsize
    return room[start : start + size]


def _padded_background(backgrounds: Tensor | None, c: int, channels: int, dtype: Any) -> Array:
    if backgrounds is None:
        return np.zeros(channels, dtype)
    return _numpy(backgrounds[c])


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, factors: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor | None,
        residuals: Tensor, radii: Tensor, order_keys: Tensor, blending: Blending, plans: list[Plan],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        count, channels, tiling = len(means2d), features.shape[-1], blending.tiling
        image = torch.empty((count, tiling.height, tiling.width, channels), dtype=features.dtype)
        alphas = torch.empty((count, tiling.height, tiling.width, 1), dtype=features.dtype)
        dtype = _numpy(image).dtype
        grid, limits, like = tiling.grid(dtype), blending.limits(dtype), (0.0,) * padded_channels(channels)
        tiles = tiling.tiles_x * tiling.tiles_y
        kept = tiles if any(ctx.needs_input_grad) else 0
        ctx.rests, ctx.lasts = [], []
        for c in range(count):
            own = _numpy(features if features.dim() == 2 else features[c])
            plan = make_plan(
                tiling, *(_numpy(t[c]) for t in (radii, means2d, residuals, factors, opacities)), own,
                _numpy(order_keys[c]), float(limits[0]), blending.budget, blending.threads,
            )  # fmt: skip
            plans.append(plan)
            rests = np.empty((kept, tiling.tile_size**2), dtype)
            lasts = np.empty((kept, tiling.tile_size**2), np.int32)
            background = _padded_background(backgrounds, c, channels, dtype)
            parts = min(blending.threads, tiles)
            run_parts(
                lambda p, c=c, plan=plan, rests=rests, lasts=lasts, background=background, parts=parts: (
                    _blend.blend_forward(
                        p, parts, plan.starts, plan.ids, plan.masks, plan.records, grid, tiling.tile_size, like, limits,
                        background, _numpy(image[c]), _numpy(alphas[c]), rests, lasts,
                        _scratch((len(grid) - 32) // 2 * (2 + len(like)) * LANES, dtype), _scratch(2 * LANES, dtype),
                    )
                ),
                parts,
            )  # fmt: skip
            ctx.rests.append(rests)
            ctx.lasts.append(lasts)
        ctx.save_for_backward(opacities, features, backgrounds)
        ctx.blending, ctx.plans = blending, list(plans)
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alphas: Tensor) -> tuple[Any, ...]:
        opacities, features, backgrounds = ctx.saved_tensors
        count, rows = len(ctx.plans), opacities.shape[1]
        v_means2d, v_factors = (torch.zeros((count, rows, k), dtype=features.dtype) for k in (2, 3))
        v_opacities, v_features = torch.zeros_like(opacities), torch.zeros_like(features)
        v_image, v_alphas = v_image.contiguous(), v_alphas.contiguous()
        v_backgrounds = np.zeros((count, features.shape[-1]))
        for c in range(count):
            plan = ctx.plans[c]
            sums, v_backgrounds[c] = _moments(ctx, c, _numpy(v_image[c]), _numpy(v_alphas[c]), backgrounds)
            spans = split(rows, ctx.blending.threads)
            own = _numpy(v_features if features.dim() == 2 else v_features[c])
            out = [_numpy(t[c]) for t in (v_means2d, v_factors, v_opacities)]
            run_parts(
                lambda p, c=c, plan=plan, sums=sums, own=own, out=out, spans=spans: _blend_backward.gather_gradients(
                    *spans[p], plan.slots, plan.records, _numpy(opacities[c]), sums, *out, own
                ),
                len(spans),
            )
        v_back = None if backgrounds is None else torch.from_numpy(v_backgrounds).to(backgrounds.dtype)
        return v_means2d, v_factors, v_opacities, v_features, v_back, *(None,) * 5


def _moments(ctx: Any, c: int, v_image: Array, v_alphas: Array, backgrounds: Tensor | None) -> tuple[Array, Array]:
    """Moments of one camera [P,M,6+D] and the gradient of its background [D]."""
    blending, plan = ctx.blending, ctx.plans[c]
    channels, dtype = v_image.shape[2], v_image.dtype
    grid, limits = blending.tiling.grid(dtype), blending.limits(dtype)
    like = (0.0,) * padded_channels(channels)
    parts = min(blending.threads, len(plan.starts) - 1)
    width = sums_width(_blend_backward.MOMENTS + len(like))
    sums = np.zeros((parts, len(plan.records), width), dtype)
    background = _padded_background(backgrounds, c, channels, dtype)
    v_background = np.zeros((parts, channels if backgrounds is not None else 0))
    run_parts(
        lambda p: _blend_backward.blend_backward(
            p, parts, plan.starts, plan.ids, plan.masks, plan.records, grid, blending.tiling.tile_size, like, limits,
            background, v_image, v_alphas, ctx.rests[c], ctx.lasts[c],
            _scratch((len(grid) - 32) // 2 * (2 + len(like)) * LANES, dtype), _scratch(2 * LANES, dtype), sums[p],
            v_background[p],
        ),
        parts,
    )  # fmt: skip
    return sums, v_background.sum(0) if backgrounds is not None else np.zeros(channels)


def blend(
    projected: Projected, opacities: Tensor, features: Tensor, backgrounds: Tensor | None, blending: Blending
) -> tuple[Tensor, Tensor, list[Plan]]:
    """Blend projected Gaussians; differentiable in means2d, factors, opacities, features and backgrounds.

    Args:
        projected: Of `project`.
        opacities: [C,N], compensated if antialiased.
        features: [N,D] or [C,N,D], D <= 32.
        backgrounds: [C,D] or None for black.
        blending: Tiles, thresholds and resources.

    Returns:
        Image [C,H,W,D], alphas [C,H,W,1] and the work list of each camera.
    """
    plans: list[Plan] = []
    image, alphas = _Blend.apply(
        projected.means2d, projected.factors, opacities, features, backgrounds, projected.residuals, projected.radii,
        projected.order_keys, blending, plans,
    )  # fmt: skip
    return image, alphas, plans
