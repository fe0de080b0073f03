"""LPIPS against a second way of writing it down, on torchvision's own layer numbering, and its file errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from ahoy_core.metrics.lpips import Lpips
from ahoy_core.models.adapter import Fill
from ahoy_core.models.catalogue import adapter
from ahoy_core.models.errors import CheckpointError
from tests.models.checkpoints import alexnet_features, lpips, vgg16_features

# Layers after which LPIPS reads activations, by their numbers in torchvision's networks (Zhang et al., appendix).
READ = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
FILE = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


def load(folder: Path, backbone: str) -> Lpips:
    name = f"lpips-{backbone}"
    network: Lpips = adapter("perceptual", name).open(Fill(fill=name, path=folder, device="cpu", own_weights=True))
    return network


def by_definition(folder: Path, backbone: str, a: Tensor, b: Tensor) -> Tensor:
    features: nn.Sequential = {"alex": alexnet_features, "vgg": vgg16_features}[backbone]()
    state = torch.load(folder / FILE[backbone], weights_only=True)
    features.load_state_dict({k.removeprefix("features."): v for k, v in state.items() if k.startswith("features.")})
    heads = torch.load(folder / f"{backbone}.pth", weights_only=True)
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    total = torch.zeros(len(a))
    pair = [((2 * x - 1) - shift[:, None, None]) / scale[:, None, None] for x in (a, b)]
    for number, layer in enumerate(features):
        if number > READ[backbone][-1]:
            break
        pair = [layer(x) for x in pair]
        if number in READ[backbone]:
            head = heads[f"lin{READ[backbone].index(number)}.model.1.weight"]
            first, second = (x / x.norm(dim=1, keepdim=True) for x in pair)
            total += nn.functional.conv2d((first - second) ** 2, head).mean((1, 2, 3))
    return total


@torch.no_grad()
@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_it_is_the_published_formula(backbone: str, tmp_path: Path) -> None:
    folder = lpips(tmp_path, backbone)
    a, b = torch.rand(2, 2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    # Float32 sums over up to 512 channels; the small constant under the norm's root adds less than that.
    torch.testing.assert_close(
        load(folder, backbone)(a, b), by_definition(folder, backbone, a, b), rtol=2e-4, atol=1e-6
    )


def test_gradients_reach_the_picture_and_are_finite_where_it_is_flat(tmp_path: Path) -> None:
    network = load(lpips(tmp_path, "alex"), "alex")
    flat = torch.full((1, 3, 40, 40), 0.5, requires_grad=True)
    network(flat, torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(2))).sum().backward()
    assert flat.grad is not None and bool(torch.isfinite(flat.grad).all()) and float(flat.grad.abs().sum()) > 0
    assert not any(p.requires_grad for p in network.parameters())


def test_a_file_of_the_other_backbone_is_refused_with_the_missing_keys(tmp_path: Path) -> None:
    folder = lpips(tmp_path, "alex")
    heads = torch.load(folder / "alex.pth", weights_only=True)
    torch.save({k: v for k, v in heads.items() if not k.startswith("lin3")}, folder / "alex.pth")
    with pytest.raises(CheckpointError, match=r"alex\.pth lacks lin3\.model\.1\.weight.*get it from"):
        load(folder, "alex")
    (lpips(tmp_path / "v", "vgg") / FILE["vgg"]).replace(folder / FILE["alex"])
    with pytest.raises(CheckpointError, match=r"lacks features\.3\.weight"):
        load(folder, "alex")


def test_a_truncated_file_is_refused_with_its_size_and_where_to_get_it(tmp_path: Path) -> None:
    folder = lpips(tmp_path, "alex")
    whole = (folder / FILE["alex"]).read_bytes()
    (folder / FILE["alex"]).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=r"truncated.*get it from.*alexnet-owt-7be5be79\.pth"):
        load(folder, "alex")
