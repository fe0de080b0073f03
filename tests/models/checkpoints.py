"""Tiny checkpoints in the true on-disk formats of the roles' models: names and layouts are theirs, numbers ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn

ALEX_HEADS, VGG_HEADS = (64, 192, 384, 256, 256), (64, 128, 256, 512, 512)


def alexnet_features() -> nn.Sequential:
    """The layers of torchvision's AlexNet, by their numbers in its file."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


def vgg16_features() -> nn.Sequential:
    """The layers of torchvision's VGG16."""
    layers: list[nn.Module] = []
    before = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()] if width else [nn.MaxPool2d(2, 2)]
        before = width or before
    return nn.Sequential(*layers)


def lpips(folder: Path, backbone: str) -> Path:
    """A folder with both files of LPIPS on "alex" or "vgg"; as torchvision's, the backbone's has a classifier too."""
    torch.manual_seed(1)
    features, name, widths = {
        "alex": (alexnet_features, "alexnet-owt-7be5be79.pth", ALEX_HEADS),
        "vgg": (vgg16_features, "vgg16-397923af.pth", VGG_HEADS),
    }[backbone]
    state = {f"features.{key}": value for key, value in features().state_dict().items()}
    folder.mkdir(parents=True, exist_ok=True)
    torch.save({**state, "classifier.1.weight": torch.zeros(4, 9)}, folder / name)
    heads = {f"lin{n}.model.1.weight": torch.rand(1, w, 1, 1) for n, w in enumerate(widths)}
    torch.save(heads, folder / f"{backbone}.pth")
    return folder


BUILDERS: dict[tuple[str, str], Callable[[Path], Path]] = {
    ("perceptual", "lpips-alex"): lambda folder: lpips(folder, "alex"),
    ("perceptual", "lpips-vgg"): lambda folder: lpips(folder, "vgg"),
}
"""(role, adapter) -> builds its checkpoint in a folder and returns the path that `Fill.path` takes."""
