"""What `rasterization` accepts: every refusal names the argument, what was expected, what came and what to do."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ahoy_core.splat.constants import MAX_SH_DEGREE, MIN_ALPHA_CUTOFF, TILE_SIZES

RENDER_MODES: Final = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES: Final = ("classic", "antialiased")
CAMERA_MODELS: Final = ("pinhole", "ortho")
FLOATS: Final = (torch.float32, torch.float64)

GSPLAT_ONLY: Final[dict[str, Any]] = {
    "packed": False,
    "sparse_grad": False,
    "absgrad": False,
    "distributed": False,
    "segmented": False,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}
"""Arguments of gsplat that exist here only with this value."""


def refuse_gsplat_only(given: dict[str, Any]) -> None:
    """Refuse by name what gsplat supports and this does not.

    Raises:
        TypeError: For a name that gsplat does not know either.
        NotImplementedError: For an argument of gsplat with a value other than the one supported.
    """
    for name, value in given.items():
        if name not in GSPLAT_ONLY:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        supported = GSPLAT_ONLY[name]
        if value is not supported:
            shown = type(value).__name__ if isinstance(value, Tensor) else repr(value)
            raise NotImplementedError(f"{name}: expected {supported!r}, got {shown}: not supported, leave it out")


def _shape(name: str, tensor: Tensor, *allowed: tuple[int | str, ...]) -> None:
    """Check a shape against alternatives; a string stands for any size."""
    for shape in allowed:
        if len(shape) == tensor.dim() and all(
            isinstance(a, str) or a == b for a, b in zip(shape, tensor.shape, strict=True)
        ):
            return
    wanted = " or ".join("[" + ",".join(map(str, shape)) + "]" for shape in allowed)
    raise ValueError(f"{name}: expected shape {wanted}, got {tuple(tensor.shape)}; see the docstring for the layout")


def check_shapes(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
    colors: Tensor, viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None, sh_degree: int | None,
) -> None:  # fmt: skip
    """Raise ValueError unless all shapes agree on N Gaussians, C cameras and D channels."""
    _shape("means", means, ("N", 3))
    n = len(means)
    if covars is not None:
        _shape("covars", covars, (n, 3, 3))
    elif quats is None or scales is None:
        raise ValueError("covars: expected covariances, or quats and scales, got none of them; pass one description")
    else:
        _shape("quats", quats, (n, 4))
        _shape("scales", scales, (n, 3))
    _shape("opacities", opacities, (n,))
    _shape("viewmats", viewmats, ("C", 4, 4))
    cameras = len(viewmats)
    if cameras == 0:
        raise ValueError(f"viewmats: expected at least one camera, got shape {tuple(viewmats.shape)}; pass [C,4,4]")
    _shape("Ks", Ks, (cameras, 3, 3))
    if sh_degree is None:
        _shape("colors", colors, (n, "D"), (cameras, n, "D"))
        channels = colors.shape[-1]
        if channels == 0:
            raise ValueError(f"colors: expected at least one channel, got shape {tuple(colors.shape)}; pass [N,D]")
    else:
        _shape("colors", colors, (n, "K", 3), (cameras, n, "K", 3))
        channels, terms = 3, (sh_degree + 1) ** 2
        if colors.shape[-2] < terms:
            raise ValueError(
                f"colors: expected at least {terms} coefficients for sh_degree={sh_degree}, "
                f"got {tuple(colors.shape)}; lower sh_degree or pad with zeros"
            )
    if backgrounds is not None:
        _shape("backgrounds", backgrounds, (cameras, channels))


def check_tensors(tensors: dict[str, Tensor | None], means_name: str = "means") -> None:
    """Raise unless all are dense float tensors on one device; all but means and cameras of one dtype."""
    first = tensors[means_name]
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, got {type(tensor).__name__}; use torch.as_tensor")
        if tensor.dtype not in FLOATS:
            raise TypeError(f"{name}: expected float32 or float64, got {tensor.dtype}; convert it with .float()")
        assert first is not None
        if tensor.device != first.device:
            raise ValueError(f"{name}: expected device {first.device} as means, got {tensor.device}; move it with .to")
        if not tensor.is_contiguous():
            raise ValueError(f"{name}: expected a contiguous tensor, got strides {tensor.stride()}; call .contiguous()")
    colors = tensors["colors"]
    assert colors is not None
    for name, tensor in tensors.items():
        if tensor is not None and name not in (means_name, "viewmats", "Ks") and tensor.dtype != colors.dtype:
            raise TypeError(
                f"{name}: expected {colors.dtype} as colors, got {tensor.dtype}; only means, viewmats and Ks may differ"
            )


def check_cameras(viewmats: Tensor, Ks: Tensor) -> None:
    """Raise ValueError unless poses are finite affine maps and intrinsics invertible without skew."""
    views, K = (t.detach().cpu().numpy() for t in (viewmats, Ks))
    if not np.isfinite(views).all():
        raise ValueError("viewmats: expected finite world-to-camera matrices, got NaN or infinity; check the pose")
    if (np.abs(views[:, 3] - (0, 0, 0, 1)) > 1e-5).any():
        raise ValueError(f"viewmats: expected the last row 0 0 0 1, got {views[:, 3].tolist()}; is it transposed?")
    if not np.isfinite(K).all() or not (K[:, (0, 1), (0, 1)] > 0).all():
        raise ValueError(f"Ks: expected finite values with fx, fy > 0, got {K.tolist()}; K must be invertible")
    if (K[:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] != (0, 0, 0, 0, 1)).any():
        raise ValueError(f"Ks: expected [[fx,0,cx],[0,fy,cy],[0,0,1]], got {K.tolist()}; skew is not supported")


def _choice(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name}: expected one of {allowed}, got {value!r}; choose one of them")


def _number(name: str, value: object, low: float, high: float, open_low: bool = False) -> None:
    """Check low <= value <= high (low < value if open_low); NaN fails."""
    ok = isinstance(value, int | float) and (low < value if open_low else low <= value) and value <= high
    if not ok:
        bound = f"{'>' if open_low else '>='} {low:g}" + (f" and <= {high:g}" if math.isfinite(high) else "")
        raise ValueError(f"{name}: expected a number {bound}, got {value!r}; choose a value in range")


def check_options(
    width: int, height: int, near_plane: float, far_plane: float, radius_clip: float, eps2d: float,
    sh_degree: int | None, render_mode: str, rasterize_mode: str, camera_model: str, tile_size: int,
    alpha_cutoff: float, transmittance_stop: float, channel_chunk: int, memory_budget: int | None,
) -> None:  # fmt: skip
    """Raise ValueError for any option out of range."""
    for name, value in (("width", width), ("height", height), ("channel_chunk", channel_chunk)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}: expected an integer >= 1, got {value!r}; pass a positive number")
    _choice("render_mode", render_mode, RENDER_MODES)
    _choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    _choice("camera_model", camera_model, CAMERA_MODELS)
    _choice("tile_size", tile_size, TILE_SIZES)
    _choice("sh_degree", sh_degree, (None, *range(MAX_SH_DEGREE + 1)))
    infinity = math.inf
    if camera_model == "pinhole":
        _number("near_plane", near_plane, 0.0, infinity, open_low=True)
    else:
        _number("near_plane", near_plane, -infinity, infinity)
    _number("far_plane", far_plane, near_plane, infinity, open_low=True)
    _number("radius_clip", radius_clip, 0.0, infinity)
    _number("eps2d", eps2d, 0.0, infinity)
    _number("alpha_cutoff", alpha_cutoff, MIN_ALPHA_CUTOFF, 0.99)
    _number("transmittance_stop", transmittance_stop, 0.0, 0.99)
    if memory_budget is not None:
        _number("memory_budget", memory_budget, 1, infinity)


def check_window(window: tuple[int, int, int, int], width: int, height: int, on_gpu: bool) -> None:
    """Raise unless a window (left, top, width, height) is a part of the image, on the CPU."""
    left, top, wide, high = window
    if not (left >= 0 and top >= 0 and wide >= 1 and high >= 1 and left + wide <= width and top + high <= height):
        raise ValueError(f"window: expected (left, top, width, height) inside {width}x{height}, got {window}; clip it")
    if on_gpu:
        raise NotImplementedError("window: expected tensors on the CPU, got a GPU; render the whole image and crop it")
