"""The same call on a GPU, through gsplat."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ahoy_core.splat.constants import ALPHA_CUTOFF, TRANSMITTANCE_STOP

IN_META = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")
"""What gsplat's meta holds a row of for each Gaussian, [C,N,...]."""


def rasterize_cuda(
    tensors: dict[str, Tensor | None], options: dict[str, Any], alpha_cutoff: float, transmittance_stop: float
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Hand a validated call to `gsplat.rasterization`, kept from what its kernels take amiss.

    They keep depths *at* the planes, spread the NaN of one row over the image, and divide by the number of Gaussians.

    Raises:
        ImportError: If gsplat is not installed.
        NotImplementedError: If thresholds differ from those built into gsplat's kernels, or a tensor is not float32.
    """
    try:
        import gsplat
    except ImportError as error:
        raise ImportError(
            "tensors on a GPU: expected gsplat, got no such package; install the extra: pip install ahoy-avatars[cuda]"
        ) from error
    for name, value, built_in in (
        ("alpha_cutoff", alpha_cutoff, ALPHA_CUTOFF),
        ("transmittance_stop", transmittance_stop, TRANSMITTANCE_STOP),
    ):
        if value != built_in:
            raise NotImplementedError(f"{name}: expected {built_in} on a GPU, got {value}: gsplat's is built in")
    for name, tensor in tensors.items():
        if tensor is not None and tensor.dtype != torch.float32:
            raise NotImplementedError(
                f"{name}: expected float32 on a GPU, got {tensor.dtype}; convert it with .float()"
            )
    options = options | {
        "near_plane": _next_float32(options["near_plane"], math.inf),
        "far_plane": _next_float32(options["far_plane"], -math.inf),
    }
    axes = {"means": 1, "quats": 1, "scales": 1, "covars": 2, "opacities": 0}
    axes["colors"] = 1 if options["sh_degree"] is None else 2
    gaussians = {name: tensor for name, tensor in tensors.items() if name in axes and tensor is not None}
    count = len(gaussians["means"])
    if not count:
        # One that is broken instead, so that it is not drawn; what depends on the inputs still does.
        gaussians = {
            name: pad(value, (0, 0) * axes[name] + (0, 1), value=math.nan) for name, value in gaussians.items()
        }
    finite = _finite_rows(gaussians, axes)
    n_invalid = count - int(finite.sum())
    mended = tensors | _mended(gaussians, axes, finite)
    colors, alphas, meta = gsplat.rasterization(**mended, **options, packed=False)
    if not count:
        meta |= {name: meta[name][:, :0] for name in IN_META}
    meta |= {"n_isects": int(meta["flatten_ids"].numel()), "n_invalid": n_invalid}
    return colors, alphas, meta


def _next_float32(value: float, towards: float) -> float:
    """The float32 beside it (Python's floats are rounded on their way into the kernels)."""
    return float(np.nextafter(np.float32(value), np.float32(towards)))


def _finite_rows(gaussians: dict[str, Tensor], axes: dict[str, int]) -> Tensor:
    """Gaussians without a NaN or an infinity in any of these, bool [N]; `axes` counts those behind N."""
    whole = []
    for name, tensor in gaussians.items():
        rows = torch.isfinite(tensor)
        rows = rows.flatten(tensor.ndim - axes[name]).all(-1) if axes[name] else rows
        whole.append(rows.flatten(0, -2).all(0) if rows.ndim > 1 else rows)  # colours may have cameras in front
    return torch.stack(whole).all(0)


def _mended(gaussians: dict[str, Tensor], axes: dict[str, int], finite: Tensor) -> dict[str, Tensor]:
    """Broken rows made invisible, and zero quaternions the identity; neither gets a gradient."""
    mended = {}
    for name, tensor in gaussians.items():
        kept, neutral = finite, tensor.new_zeros(())
        if name == "quats":
            kept, neutral = finite & (tensor != 0).any(-1), torch.eye(4, device=tensor.device)[0]
        elif name == "covars":
            neutral = torch.eye(3, device=tensor.device)
        mended[name] = torch.where(kept.reshape(-1, *(1,) * axes[name]), tensor, neutral)
    return mended
