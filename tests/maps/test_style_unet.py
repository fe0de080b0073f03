from __future__ import annotations

import pytest
import torch
from pydantic import ValidationError

from ahoy_core.maps.style_unet import StyleUNet, StyleUNetConfig
from ahoy_core.maps.wavelet import haar, inverse_haar

SMALL = StyleUNetConfig(map_size=32, width=4, max_channels=16, bottleneck=4, in_channels=6, out_channels=5)


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _net(config: StyleUNetConfig = SMALL, seed: int = 0) -> StyleUNet:
    return StyleUNet(config, _generator(seed))


def _woken(config: StyleUNetConfig = SMALL) -> StyleUNet:
    """A network whose heads have left zero."""
    net, g = _net(config), _generator(7)
    with torch.no_grad():
        for decoder in net.decoders:
            for head in decoder.heads:
                head.weight.copy_(torch.randn(head.weight.shape, generator=g))
    return net


def test_an_untrained_network_predicts_exactly_nothing():
    out = _net()(torch.randn(2, 6, 32, 32, generator=_generator()))
    assert out.shape == (2, 2, 5, 32, 32)
    assert bool((out == 0).all())


def test_heads_at_zero_still_get_a_gradient():
    net = _net()
    out = net(torch.randn(1, 6, 32, 32, generator=_generator()))
    (out - 1).square().sum().backward()
    for decoder in net.decoders:
        assert all(float(head.weight.grad.abs().max()) > 0 for head in decoder.heads)


def test_every_parameter_matters_once_the_heads_have_left_zero():
    net = _woken()
    net(torch.randn(1, 6, 32, 32, generator=_generator())).square().sum().backward()
    silent = [name for name, p in net.named_parameters() if p.grad is None or float(p.grad.abs().max()) == 0]
    assert silent == []


def test_features_keep_unit_scale_through_the_depth():
    """Equalised learning rate and demodulation: outputs neither vanish nor explode with width or depth."""
    for size, width in ((32, 4), (64, 16)):
        net = _woken(StyleUNetConfig(map_size=size, width=width, in_channels=6, out_channels=5, bottleneck=4))
        spread = net(torch.randn(1, 6, size, size, generator=_generator())).detach().std()
        assert 0.2 < float(spread) < 20


def test_front_and_back_have_decoders_of_their_own():
    out = _woken()(torch.randn(1, 6, 32, 32, generator=_generator())).detach()
    assert float((out[:, 0] - out[:, 1]).abs().max()) > 1e-3


def test_a_batch_gives_what_its_members_give():
    net, maps = _woken(), torch.randn(3, 6, 32, 32, generator=_generator())
    assert torch.allclose(net(maps), torch.cat([net(m[None]) for m in maps]), atol=1e-4)


def test_equal_seeds_give_equal_networks():
    first, second, third = _net(seed=1).state_dict(), _net(seed=1).state_dict(), _net(seed=2).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(not torch.equal(first[name], third[name]) for name in first)


def test_width_sets_the_size():
    counts = [sum(p.numel() for p in _net(StyleUNetConfig(width=w)).parameters()) for w in (8, 16, 32)]
    assert counts == sorted(counts)
    assert 0.5e6 < counts[1] < 2e6  # about a million at the default


@pytest.mark.parametrize("change", [{"map_size": 48}, {"bottleneck": 6}, {"bottleneck": 16}])
def test_sizes_that_cannot_be_halved_are_refused(change: dict[str, int]):
    with pytest.raises(ValidationError, match="expected"):
        StyleUNetConfig(**{**SMALL.model_dump(), **change})


def test_maps_of_another_size_are_refused():
    with pytest.raises(ValueError, match="expected maps of shape"):
        _net()(torch.zeros(1, 6, 16, 16))


def test_haar_is_orthonormal_and_inverted_exactly():
    image = torch.randn(2, 3, 8, 6, generator=_generator(), dtype=torch.float64)
    bands = haar(image)
    assert bands.shape == (2, 12, 4, 3)
    assert torch.allclose(bands.square().sum(), image.square().sum())
    assert torch.allclose(inverse_haar(bands), image)


def test_the_first_band_of_each_channel_is_its_mean():
    image = torch.rand(1, 2, 4, 4, generator=_generator())
    assert torch.allclose(haar(image)[:, ::4], 2 * torch.nn.functional.avg_pool2d(image, 2))


def test_haar_refuses_odd_sizes():
    with pytest.raises(ValueError, match="even"):
        haar(torch.zeros(1, 1, 3, 4))
    with pytest.raises(ValueError, match="multiple of 4"):
        inverse_haar(torch.zeros(1, 3, 4, 4))
