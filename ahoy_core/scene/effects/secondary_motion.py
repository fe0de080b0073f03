"""Secondary motion: hair and wide clothes lag behind the body and swing on after it stops.

What stands off the body's surface hangs on it by a damped spring: for the lag u of a place p that the skeleton carries,
u'' + 2 zeta omega u' + omega² u = -p'', solved exactly for a path that is straight and even within a frame. A lag is
scaled by how loose the place is and never takes it to the body. One frequency and one damping stand for all cloth and
hair, which is a guess. Reference: the oscillator's closed form, tests/scene/test_secondary_motion.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor

from ahoy_core.scene.cost import Rates
from ahoy_core.scene.effects.effect import Effect, Verdict
from ahoy_core.scene.puppet import Puppet, nearest_three
from ahoy_core.scene.shot import NEAR, Content

FREQUENCY = 2.2
"""Hertz, of a coat's hem or long hair left to swing."""
DAMPING = 0.35
"""Of critical: two or three swings."""
_TIGHT, _LOOSE = 0.02, 0.08
"""Metres off the body: up to the first a place moves with it; from the second on it hangs freely."""
_MOST = 0.5  # of the distance to the body
_CONTROLS = 150
_LEAST_AREA = 0.005  # share of the avatar's surface
_LEAST_PIXELS = 1.0


@dataclass(frozen=True)
class Swing:
    """How loose parts of an avatar move: L Gaussians follow K control points.

    Attributes:
        rows: [L] the loose Gaussians.
        nearest: [L,3] their control points.
        weights: [L,3] of these.
        lags: [T,K,3] world metres, of each control point in each frame.
    """

    rows: Tensor
    nearest: Tensor
    weights: Tensor
    lags: Tensor

    def moved(self, means: Tensor, frame: int, moment: float) -> Tensor:
        """Places [N,3] of an avatar with the lag of a share of a frame after a frame."""
        other = min(frame + 1, len(self.lags) - 1)
        lag = torch.lerp(self.lags[frame], self.lags[other], moment)
        swung = means.clone()
        swung[self.rows] += (self.weights[:, :, None] * lag[self.nearest]).sum(1)
        return swung


def looseness(puppet: Puppet) -> Tensor:
    """[N] how freely each Gaussian of an avatar hangs, 0 (on the body) to 1."""
    template = puppet.avatar.template
    off = ((puppet.avatar.means - template.means) * template.rotations[:, :, 2]).sum(1)
    return ((off - _TIGHT) / (_LOOSE - _TIGHT)).clamp(0, 1)


def lags_of(places: Tensor, fps: float, frequency: float = FREQUENCY, damping: float = DAMPING) -> Tensor:
    """Lags [T,K,3] of free places that are carried along paths [T,K,3] at `fps`, at rest and in step at the start."""
    path = places.double().numpy()
    step, omega = 1 / fps, 2 * math.pi * frequency
    velocity = np.diff(path, axis=0) * fps
    kicks = np.diff(velocity, axis=0, prepend=velocity[:1]) if len(velocity) else velocity
    # Over a frame the carrier moves evenly; at each frame its velocity jumps, and the lag's by as much the other way.
    transition = expm(step * np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]]))
    state = np.zeros((2, *path.shape[1:]))
    lags = np.zeros_like(path)
    for frame, kick in enumerate(kicks):
        state[1] -= kick
        state = np.einsum("ij,jkc->ikc", transition, state)
        lags[frame + 1] = state[0]
    return torch.from_numpy(lags).float()


def swing_of(puppet: Puppet) -> Swing | None:
    """The swing of an avatar's loose parts over its motion; None if nothing of it is loose."""
    loose = looseness(puppet)
    rows = torch.nonzero(loose > 0)[:, 0]
    if not len(rows):
        return None
    chosen = rows[torch.linspace(0, len(rows) - 1, min(_CONTROLS, len(rows))).round().long()]
    motion = puppet.motion
    points = puppet.points[chosen]
    relative = puppet.relative(motion.pose, motion.transl)
    places = torch.stack([points.posed(one)[0] for one in relative])
    lags = lags_of(places, motion.fps) * loose[chosen][:, None]
    means = puppet.avatar.means
    off = (means - puppet.avatar.template.means).norm(dim=1)[chosen]
    length = lags.norm(dim=2, keepdim=True)
    lags = lags * (_MOST * off[:, None] / length.clamp(min=1e-9)).clamp(max=1)
    return Swing(rows, *nearest_three(means[rows], means[chosen], 1e-3), lags)


def _judge(content: Content) -> Verdict:
    loose = [(p, looseness(p)) for p in content.puppets]
    share = max((float((p.points.areas * some).sum() / p.points.areas.sum()) for p, some in loose), default=0.0)
    evidence = {"loose_share": round(share, 4)}
    if share < _LEAST_AREA:
        return Verdict(False, "nothing of the avatar hangs loosely", evidence)
    if content.frames < 3:
        return Verdict(False, "too few frames for anything to swing", evidence)
    pixels = max(_lag_pixels(content, number) for number in range(len(loose)))
    evidence["pixels"] = round(pixels, 2)
    if pixels < _LEAST_PIXELS:
        return Verdict(False, f"loose parts lag by at most {pixels:.1f} pixels", evidence)
    return Verdict(True, f"{share:.0%} of the avatar hangs loosely and lags by up to {pixels:.1f} pixels", evidence)


def _lag_pixels(content: Content, puppet: int) -> float:
    swing = swing_of(content.puppets[puppet])
    if swing is None:
        return 0.0
    worst = 0.0
    for number, frame in enumerate(content.moments):
        cameras = content.shot.at(frame)
        place = content.surfaces[puppet][number][0].mean(0)
        depth = float(cameras.project(place[None]).depths[0, 0])
        if depth > NEAR:
            worst = max(worst, float(swing.lags[frame].norm(dim=1).max()) * float(cameras.Ks[0, 0, 0]) / depth)
    return worst


def _seconds(content: Content, verdict: Verdict, rates: Rates) -> float:
    once = len(content.puppets) * content.frames * (rates.joints + _CONTROLS * rates.carry)
    return once + content.frames * content.avatar_gaussians * rates.curve


SECONDARY_MOTION = Effect(
    "secondary_motion",
    "hair and wide clothes swing",
    _judge,
    _seconds,
    lambda content: any(bool((looseness(puppet) > 0).any()) for puppet in content.puppets),
)
