"""ST-LPIPS, a perceptual distance that tolerates small shifts (Ghildyal and Liu, ECCV 2022), AlexNet variant.

It is not LPIPS: never put its numbers beside LPIPS. Written from the paper (LPIPS's normalised feature differences
with learned channel weights, on an AlexNet whose strides are blur-pools); the trained weights come from a file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, max_pool2d, pad, relu

NAME = "ST-LPIPS (AlexNet)"
# Sides of a picture below this leave nothing of the deepest features.
MIN_SIDE = 32
# Names in the weights' file: convolution, channels out, kernel, padding; then the channel weights.
_CONVS = (
    ("net.slice1.0", 3, 64, 11, 2),
    ("net.slice2.5", 64, 192, 5, 2),
    ("net.slice3.9", 192, 384, 3, 1),
    ("net.slice4.11", 384, 256, 3, 1),
    ("net.slice5.13", 256, 256, 3, 1),
)
_BLUR = (1.0, 2.0, 1.0)
# Mean and spread of natural pictures in [-1,1], as LPIPS centres its input.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class StLpips(nn.Module):
    """Distance of pictures. Its weights are fixed; gradients run to the pictures."""

    name = NAME

    def __init__(self) -> None:
        super().__init__()
        self.convs = nn.ModuleList(nn.Conv2d(i, o, k, padding=p) for _, i, o, k, p in _CONVS)
        self.heads = nn.ParameterList(torch.ones(1, o, 1, 1) / o for _, _, o, _, _ in _CONVS)
        self.requires_grad_(False)

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance of pictures a and b: [B], at least 0, 0 for equal ones.

        Args:
            a: [B,3,H,W] sRGB in [0,1], sides of at least 32 pixels.
            b: Likewise.

        Raises:
            ValueError: If the shapes differ or a side is too short.
        """
        check_pictures(a, b, MIN_SIDE)
        return weighted_difference(self.features(a), self.features(b), self.heads)

    def features(self, image: Tensor) -> list[Tensor]:
        """Activations of the five convolutions for [B,3,H,W] in [0,1]."""
        shift, scale = (image.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        x = relu(_blur_pool(self.convs[0]((2 * image - 1 - shift) / scale)))
        out = [x]
        for number, conv in enumerate(self.convs):
            if number == 0:
                continue
            if number <= 2:
                x = _blur_pool(max_pool2d(x, 3, stride=1))
            x = relu(conv(x))
            out.append(x)
        return out


def check_pictures(a: Tensor, b: Tensor, side: int) -> None:
    """Refuse what is no pair of pictures [B,3,H,W] of one size with sides of `side` pixels or more.

    Raises:
        ValueError: naming both shapes.
    """
    if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3 or min(a.shape[2:]) < side:
        raise ValueError(
            f"expected two pictures [B,3,H,W] of one size, sides of {side} or more, got {tuple(a.shape)} and "
            f"{tuple(b.shape)}; cut out larger patches"
        )


def normalised(features: Tensor) -> Tensor:
    """Features [B,C,h,w] of length 1 in every pixel (0 where there are none)."""
    # The square root has no gradient at 0, where all features of a flat patch may lie.
    return features / ((features.square().sum(1, keepdim=True) + 1e-12).sqrt() + 1e-10)


def weighted_difference(first: Sequence[Tensor], second: Sequence[Tensor], heads: Iterable[Tensor]) -> Tensor:
    """LPIPS's distance [B] of two pictures' features, layer by layer with learned channel weights (its equation 1).

    Args:
        first: [B,C,h,w] of each layer.
        second: Likewise.
        heads: [1,C,1,1] of each layer.
    """
    total = first[0].new_zeros(len(first[0]))
    for one, other, head in zip(first, second, heads, strict=True):
        difference = (normalised(one) - normalised(other)).square()
        total = total + (difference * head.to(one)).sum(1).mean((1, 2))
    return total


def _blur_pool(x: Tensor) -> Tensor:
    """Blur with [1 2 1] and keep every second pixel, borders reflected by two."""
    taps = x.new_tensor(_BLUR)
    kernel = torch.outer(taps, taps) / taps.sum() ** 2
    return conv2d(pad(x, (2, 2, 2, 2), mode="reflect"), kernel.expand(x.shape[1], 1, 3, 3), stride=2, groups=x.shape[1])


def load_stlpips(path: Path) -> StLpips:
    """Read the trained weights.

    Args:
        path: `alex_shift_tolerant.pth` as published.

    Raises:
        ValueError: If the file is not those weights.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        network = StLpips()
        for (name, *_), conv in zip(_CONVS, network.convs, strict=True):
            conv.load_state_dict({part: state[f"{name}.{part}"] for part in ("weight", "bias")})
        for number, head in enumerate(network.heads):
            head.copy_(state[f"lin{number}.model.1.weight"])
    except (KeyError, RuntimeError, EOFError, TypeError) as error:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        raise ValueError(
            f"expected the weights of {NAME} at {path}, got another file (sha256 {digest[:12]}, {error}); pull it again"
        ) from error
    return network.eval()
