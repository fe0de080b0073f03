"""From the landmark network's answers to what the fit is held against."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.conventions import OBSERVED_VIEWMAT
from ahoy_core.perceive.config import PerceiveConfig
from ahoy_core.perceive.corrector import correct
from ahoy_core.perceive.ground import ground_from_camera
from ahoy_core.perceive.landmarks import LandmarkTrack
from ahoy_core.perceive.residuals import Observations

# Metres: spreads of a corrected landmark that count in full; wider ones count by the square of the ratio.
BEST_IMAGE, BEST_WORLD = 0.02, 0.03
# Of a corrected place in the picture: its spreads were learned on few people, and others are off by more than they say.
IMAGE_TRUST = 0.3


def observations(
    track: LandmarkTrack,
    pts: NDArray[np.floating],
    shots: NDArray[np.integer],
    K: NDArray[np.float64],
    viewmat: NDArray[np.floating] | None,
    config: PerceiveConfig,
) -> Observations:
    """Turn the found frames into tensors; camera axes become world axes."""
    found = track.found
    to_world = OBSERVED_VIEWMAT[:3, :3].double()  # rows times this matrix are the inverse rotation
    points: NDArray[np.floating] = track.landmarks[found, :, :2]
    world: NDArray[np.floating] = track.world[found]
    # Visible landmarks score above .9 and hidden ones .4 to .8: the fourth power tells them apart.
    visible = torch.from_numpy(track.visibility[found].astype(np.float64)) ** 4
    weights = world_weights = visible
    if config.corrector:
        up = None if viewmat is None else np.asarray(viewmat)[:3, 2]
        better = correct(points, world, track.visibility[found], K, up)
        # What is seen the network places better than the corrector does; what is hidden, worse.
        share = visible.numpy()[..., None]
        points, world = share * points + (1 - share) * better.points, better.world
        trust, world_weights = (
            torch.from_numpy(best / np.maximum(spread, best)) ** 2
            for best, spread in ((BEST_IMAGE, better.image_spread), (BEST_WORLD, better.world_spread))
        )
        weights = torch.maximum(visible, IMAGE_TRUST * trust)
    return Observations(
        points=torch.from_numpy(points.astype(np.float64)),
        weights=weights,
        world=torch.from_numpy(world.astype(np.float64)) @ to_world,
        world_weights=world_weights,
        visible=visible,
        ground=None if viewmat is None else ground_from_camera(viewmat),
        times=torch.from_numpy((pts[found] - pts[0]).astype(np.float64)),
        shot=torch.from_numpy(shots[found].astype(np.int64)),
        K=torch.from_numpy(K.astype(np.float32)),
    )
