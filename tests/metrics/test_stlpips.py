from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from ahoy_core.metrics.perceptual import patch_distance
from ahoy_core.metrics.stlpips import NAME, StLpips, load_stlpips
from tasks.model_files import ModelMissingError, model_path

GOLDEN = 0.6415813565254211
SHAPES = {
    "net.slice1.0": (64, 3, 11),
    "net.slice2.5": (192, 64, 5),
    "net.slice3.9": (384, 192, 3),
    "net.slice4.11": (256, 384, 3),
    "net.slice5.13": (256, 256, 3),
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file laid out as the published one, with small random weights."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for number, (name, (out, into, kernel)) in enumerate(SHAPES.items()):
        state[f"{name}.weight"] = torch.randn(out, into, kernel, kernel, generator=generator) / (into**0.5 * kernel)
        state[f"{name}.bias"] = torch.zeros(out)
        state[f"lin{number}.model.1.weight"] = torch.rand(1, out, 1, 1, generator=generator) / out
    path = tmp_path_factory.mktemp("weights") / "alex.pth"
    torch.save(state, path)
    return path


@pytest.fixture(scope="module")
def network(weights: Path) -> StLpips:
    return load_stlpips(weights)


def pictures() -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 48), indexing="ij")
    a = torch.stack([y, x, (y * 7).sin() * 0.5 + 0.5])
    b = torch.stack([y.square(), 1 - x, (x * 9).cos() * 0.5 + 0.5])
    return a[None], b[None]


def test_it_is_a_distance_and_never_calls_itself_lpips(network: StLpips) -> None:
    a, b = pictures()
    assert network.name == NAME and NAME.startswith("ST-LPIPS")
    assert float(network(a, a)) == 0
    assert float(network(a, b)) > 1e-4
    assert torch.allclose(network(a, b), network(b, a), rtol=1e-5)


def test_gradients_are_finite_also_on_flat_and_equal_pictures(network: StLpips) -> None:
    for image in (torch.zeros(1, 3, 32, 32), torch.full((1, 3, 32, 32), 0.5)):
        for target in (image, torch.ones(1, 3, 32, 32)):
            moved = image.clone().requires_grad_()
            network(moved, target).sum().backward()
            assert moved.grad is not None and torch.isfinite(moved.grad).all()
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_the_published_implementation_gives_the_same_number() -> None:
    """Computed once with stlpips-pytorch 0.0.2 (`LPIPS(net="alex", variant="shift_tolerant")`, normalize=True)."""
    try:
        network = load_stlpips(model_path("stlpips_alex"))
    except ModelMissingError:
        pytest.skip("needs the network stlpips_alex: run `ahoy models pull`")
    a, b = pictures()
    assert float(network(a, b)) == pytest.approx(GOLDEN, rel=1e-4)


def test_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.pth"
    torch.save({"something": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="pull it again"):
        load_stlpips(path)


def test_pictures_that_do_not_fit_are_refused(network: StLpips) -> None:
    a, _ = pictures()
    with pytest.raises(ValueError, match="sides of 32 or more"):
        network(a[..., :20], a[..., :20])
    with pytest.raises(ValueError, match="of one size"):
        network(a, a[..., :40])


def test_a_patch_without_weight_has_no_distance(network: StLpips) -> None:
    (a,), (b,) = pictures()
    generator = torch.Generator().manual_seed(0)
    nothing, everything = torch.zeros(1, 64, 48), torch.ones(1, 64, 48)
    assert float(patch_distance(network, a, b, nothing, 40, generator)) == 0
    assert float(patch_distance(network, a, b, everything, 40, generator)) > 0
    assert float(patch_distance(network, a[:, :20], b[:, :20], everything[:, :20], 40, generator)) == 0
