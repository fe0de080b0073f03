"""Two thousand steps of the full avatar: a file of its own, since it takes as long as all the others together."""

from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.avatar import AvatarInfo, train_full
from ahoy_core.avatar.coarse import textured_template
from ahoy_core.avatar.full_config import FullWeights
from ahoy_core.avatar.full_inputs import FullInputs
from tests.avatar.full_scenes import TINY_FULL, sequence
from tests.avatar.scenes import body, coarse_inputs, with_frames


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_two_thousand_steps_with_extreme_weights_stay_finite():
    """Rates and weights a hundred times too high, no regularisers, on the smallest maps."""
    weights = FullWeights(
        body=100, pose_prior=0, camera_prior=0, tone_prior=0, strain=0, offset=0, growth=0, color_change=0
    )
    observed = with_frames(coarse_inputs(), used=torch.zeros(6, dtype=torch.bool))
    one = sequence(views=1, factor=2)
    inputs = FullInputs(observed, textured_template(observed, 16), sequences=(one,))
    wild = {"weights": weights, "learning_rate": 0.05, "base_rate": 0.5, "correction_rate": 0.5, "width": 4}
    config = TINY_FULL.model_copy(update={**wild, "steps": 2000, "check_every": 2000})
    result = train_full(inputs, config, AvatarInfo(body=body().name))
    avatar = result.avatar
    assert avatar.posing is not None
    for tensor in (avatar.means, avatar.quats, avatar.scales, avatar.opacities, avatar.colors, avatar.posing.base):
        assert bool(torch.isfinite(tensor).all())
    assert len(result.losses) == 2000
    assert all(math.isfinite(row.total) for row in result.losses)
    assert torch.allclose(result.avatar.skin_weights.sum(1), torch.ones(len(result.avatar)), atol=1e-5)
    assert float(result.avatar.skin_weights.min()) >= 0
