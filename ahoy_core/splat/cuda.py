"""The same call on a GPU, through gsplat."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from ahoy_core.splat.constants import ALPHA_CUTOFF, TRANSMITTANCE_STOP


def rasterize_cuda(
    tensors: dict[str, Tensor | None], options: dict[str, Any], alpha_cutoff: float, transmittance_stop: float
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Hand a validated call to `gsplat.rasterization`.

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
        if tensor is not None and str(tensor.dtype) != "torch.float32":
            raise NotImplementedError(
                f"{name}: expected float32 on a GPU, got {tensor.dtype}; convert it with .float()"
            )
    colors, alphas, meta = gsplat.rasterization(**tensors, **options, packed=False)
    meta["n_isects"] = int(meta["flatten_ids"].numel())
    return colors, alphas, meta
