"""3D Gaussians and their differentiable rasterizer: CPU kernels in Numba, gsplat on CUDA, and a float64 oracle."""

from ahoy_core.splat.gaussians import Gaussians
from ahoy_core.splat.rasterization import rasterization

__all__ = ["Gaussians", "rasterization"]
