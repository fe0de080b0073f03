"""3D Gaussians and their differentiable rasterizer: CPU kernels in Numba, gsplat on CUDA, and a float64 oracle."""

from ahoy_core.splat.gaussians import Gaussians
from ahoy_core.splat.projection import boxes, footprints, hull, meeting
from ahoy_core.splat.rasterization import Window, rasterization

__all__ = ["Gaussians", "Window", "boxes", "footprints", "hull", "meeting", "rasterization"]
