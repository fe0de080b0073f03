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
from ahoy_core.splat._reductions import sums_width
from ahoy_core.splat._threads import run_parts, run_spans, split
from ahoy_core.splat._vectors import LANES
from ahoy_core.splat.constants import ALPHA_MAX

Array = NDArray[Any]


class Projected(NamedTuple):
    """What C cameras see of N Gaussians; rows with radius 0 are not visible and hold zeros.

    The first four are differentiable. factors (a, b, c) give KAPPA d^T Sigma^-1 d = (a dx + b dy)^2 + (c dy)^2.
    """

    means2d: Tensor  # [C,N,2] pixels
    depths: Tensor  # [C,N] camera z, metres
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
        means2d, residuals, factors = (opacities.new_empty(count, total, k) for k in (2, 2, 3))
        depths, compensations = (
            opacities.new_empty(count, total),
            opacities.new_empty(count if antialiased else 0, total),
        )
        radii, invalid = torch.empty((count, total, 2), dtype=torch.int32), torch.zeros(total, dtype=torch.bool)
        keys = torch.empty((count, total), dtype=torch.float64)
        spans = split(total, threads)
        inputs = [_numpy(t) for t in (means, quats, scales, covars, opacities)]
        outputs = [_numpy(t) for t in (radii, means2d, residuals, depths, factors, compensations, keys)]
        seen, marks = _numpy(features), _numpy(invalid)
        for c in range(count):
            own = [
                seen if seen.ndim == 2 else seen[c],
                *(out[c] if len(out) else out.ravel() for out in outputs),
                marks,
            ]
            negative = run_spans(project_forward, spans, cameras[c], antialiased, *inputs, *own)
            if max(negative) >= 0:
                row = max(negative)
                raise ValueError(
                    f"scales: expected values >= 0, got {scales[row].tolist()} in row {row}; scales are standard "
                    "deviations, take exp() of log-scales first"
                )
        ctx.save_for_backward(means, quats, scales, covars, opacities, radii)
        ctx.cameras, ctx.spans, ctx.view_dtype = cameras, spans, viewmats.dtype
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, residuals, keys, invalid)
        return means2d, depths, factors, compensations, radii, residuals, keys, invalid

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
        means, quats, scales, covars, opacities, radii = ctx.saved_tensors
        v_inputs = [torch.zeros_like(t) for t in (means, quats, scales, covars)]
        inputs = [_numpy(t) for t in (means, quats, scales, covars, opacities)]
        outputs, seen = [_numpy(t) for t in v_inputs], _numpy(radii)
        pose = np.zeros((len(ctx.spans), len(ctx.cameras), 12))
        dtype = inputs[4].dtype
        nothing = [np.empty((0, *size), dtype) for size in ((2,), (), (3,), ())]
        given = [None if g is None or len(g) == 0 else _numpy(g.contiguous()) for g in grads[:4]]
        for c in range(len(ctx.cameras)):
            v = [none if g is None else g[c] for g, none in zip(given, nothing, strict=True)]
            fixed = [ctx.cameras[c], *inputs, seen[c], *v, *outputs]
            run_spans(project_backward, ctx.spans, *fixed, each=pose[:, c])
        v_viewmats, summed = np.zeros((len(ctx.cameras), 4, 4)), pose.sum(0)
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
    cameras = pack_cameras(_numpy(viewmats), _numpy(Ks), view)
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


def _background(backgrounds: Tensor | None, c: int, channels: int, dtype: Any) -> Array:
    """Background of one camera, padded with zeros to the channels that kernels are compiled for."""
    padded = np.zeros(padded_channels(channels), dtype)
    if backgrounds is not None:
        padded[:channels] = _numpy(backgrounds[c])
    return padded


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, factors: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor | None,
        residuals: Tensor, radii: Tensor, order_keys: Tensor, blending: Blending, plans: list[Plan],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        count, channels, tiling = len(means2d), features.shape[-1], blending.tiling
        image = features.new_empty(count, tiling.height, tiling.width, channels)
        alphas = features.new_empty(count, tiling.height, tiling.width, 1)
        inputs = [_numpy(t) for t in (radii, means2d, residuals, factors, opacities)]
        own, keys, colors, coverage = (_numpy(t) for t in (features, order_keys, image, alphas))
        log2_cutoff, keep, ctx.kept = float(np.log2(blending.alpha_cutoff)), any(ctx.needs_input_grad), []
        for c in range(count):
            mine = own if own.ndim == 2 else own[c]
            seen, limits = [x[c] for x in inputs], (log2_cutoff, blending.budget, blending.threads)
            plan = make_plan(tiling, seen, mine, keys[c], *limits)
            plans.append(plan)
            ctx.kept.append(_render(blending, plan, _background(backgrounds, c, channels, own.dtype), colors[c],
                                    coverage[c], keep))  # fmt: skip
        ctx.save_for_backward(factors, opacities, features, backgrounds)
        ctx.blending, ctx.plans = blending, list(plans)
        ctx.set_materialize_grads(False)
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None) -> tuple[Any, ...]:
        factors, opacities, features, backgrounds = ctx.saved_tensors
        count, rows, channels = len(ctx.plans), opacities.shape[1], features.shape[-1]
        v_image = _gradient_image(v_image, ctx, features)
        v_alphas = features.new_empty(count, 0, 0, 0) if v_alphas is None else v_alphas.contiguous()
        v_means2d, v_factors = (features.new_empty(count, rows, k) for k in (2, 3))
        v_opacities, v_features = features.new_empty(count, rows), torch.zeros_like(features)
        outputs, own = [_numpy(t) for t in (v_means2d, v_factors, v_opacities)], _numpy(v_features)
        inputs, pixels = (
            [_numpy(t) for t in (factors, opacities)],
            [_numpy(t) for t in (v_image, v_alphas)],
        )
        v_backgrounds, spans = np.zeros((count, channels)), split(rows, ctx.blending.threads)
        for c, plan in enumerate(ctx.plans):
            background = _background(backgrounds, c, channels, own.dtype)
            has_background = backgrounds is not None
            sums, v_backgrounds[c] = _moments(
                ctx.blending, plan, ctx.kept[c], background, pixels[0][c], pixels[1][c], has_background
            )
            arrays = [*(x[c] for x in inputs), sums, *(x[c] for x in outputs), own if own.ndim == 2 else own[c]]
            run_spans(_blend_backward.gather_gradients, spans, plan.slots, *arrays)
        v_back = None if backgrounds is None else torch.from_numpy(v_backgrounds).to(backgrounds.dtype)
        return v_means2d, v_factors, v_opacities, v_features, v_back, *(None,) * 5


def _gradient_image(v_image: Tensor | None, ctx: Any, features: Tensor) -> Tensor:
    """The image's gradient as the kernels read it; zeros if only the alphas were used."""
    if v_image is not None:
        return v_image.contiguous()
    tiling = ctx.blending.tiling
    return features.new_zeros(len(ctx.plans), tiling.height, tiling.width, features.shape[-1])


def _render(
    blending: Blending, plan: Plan, background: Array, image: Array, alphas: Array, keep: bool
) -> tuple[Array, Array]:
    """Blend one camera into image [H,W,D] and alphas [H,W,1]; returns what its backward pass needs, if kept."""
    tiling, dtype, tiles = blending.tiling, image.dtype, len(plan.starts) - 1
    grid, limits, like = tiling.grid(dtype), blending.limits(dtype), (0.0,) * len(background)
    rests = np.empty((tiles if keep else 0, tiling.tile_size**2), dtype)
    longest = int(np.diff(plan.starts).max())
    lasts = np.empty(rests.shape, np.int16 if longest < 1 << 15 else np.int32)
    parts, size = min(blending.threads, tiles), tiling.tile_size**2 * (2 + len(like))
    run_parts(
        lambda p: _blend.blend_forward(
            p, parts, plan.starts, plan.ids, plan.masks, plan.records, grid, tiling.tile_size, like, limits, background,
            image, alphas, rests, lasts, _scratch(size, dtype), _scratch(2 * LANES, dtype),
        ),
        parts,
    )  # fmt: skip
    return rests, lasts


def _moments(
    blending: Blending, plan: Plan, kept: tuple[Array, Array], background: Array, v_image: Array, v_alphas: Array,
    has_background: bool,
) -> tuple[Array, Array]:  # fmt: skip
    """Moments of one camera [M,6+D], threads added in their order, and the gradient of its background [D]."""
    tiling, dtype, tiles = blending.tiling, v_image.dtype, len(plan.starts) - 1
    grid, limits, like = tiling.grid(dtype), blending.limits(dtype), (0.0,) * len(background)
    parts, size = min(blending.threads, tiles), tiling.tile_size**2 * (2 + len(like))
    width = sums_width(_blend_backward.MOMENTS + len(like))
    sums = [np.zeros((len(plan.records), width), dtype) for _ in range(parts)]
    v_background = np.zeros((parts, v_image.shape[2] if has_background else 0))
    run_parts(
        lambda p: _blend_backward.blend_backward(
            p, parts, plan.starts, plan.ids, plan.masks, plan.records, grid, tiling.tile_size, like, limits, background,
            v_image, v_alphas, *kept, _scratch(size, dtype), _scratch(2 * LANES, dtype), sums[p], v_background[p],
        ),
        parts,
    )  # fmt: skip
    while len(sums) > 1:
        sums[0] += sums.pop(1)
    return sums[0], v_background.sum(0) if has_background else np.zeros(v_image.shape[2])


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
