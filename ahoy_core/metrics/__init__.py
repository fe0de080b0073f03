"""Image metrics under named protocols."""

from ahoy_core.metrics.images import iou, psnr, ssim
from ahoy_core.metrics.protocol import INPUT_VIEW, Protocol, input_view_pair

__all__ = ["INPUT_VIEW", "Protocol", "input_view_pair", "iou", "psnr", "ssim"]
