"""Canonical maps: the Gaussian template, and the StyleUNet that predicts offsets from it (paper section 3.1)."""

from ahoy_core.maps.style_unet import StyleUNet, StyleUNetConfig
from ahoy_core.maps.template import Template, build_template

__all__ = ["StyleUNet", "StyleUNetConfig", "Template", "build_template"]
