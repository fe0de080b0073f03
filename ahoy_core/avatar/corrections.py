"""Per-frame corrections of pose, camera and tone: they absorb what hallucinated frames disagree on (section 3.3).

Pose: R exp(omega), never theta + delta. Turning the root and turning the camera about it look the same, so the two
share a gauge; each has a prior of its own, and the sum of two different quadratics has one minimum along the gauge.
Tone, a gain and a bias per colour channel, is part of the camera: a generator's exposure differs from frame to frame.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ahoy_core.avatar.full_config import CorrectionBounds, FullWeights
from ahoy_core.body.model import BodyModel
from ahoy_core.body.rotations import so3_exp

# Metres of body that a joint must be able to move to be corrected: fingers, toes, jaw and eyes are too small to see.
_LEVER = 0.13
_MOVED = 0.3  # skinning weight of a vertex that counts as moved


class Tone(NamedTuple):
    """gain [B,3] and bias [B,3] of sRGB colours."""

    gain: Tensor
    bias: Tensor


def corrected_joints(body: BodyModel) -> Tensor:
    """Joints [M] whose turning moves at least 13 cm of body, the root first."""
    still = body.default_betas.new_zeros(1, body.n_joints, 3)
    rest = body(still, body.default_betas[None], still[:, 0])
    weights = body.lbs_weights.clone()
    for joint in reversed(range(1, body.n_joints)):
        weights[:, body.parents[joint]] += weights[:, joint]
    away = (rest.rest_vertices[0][:, None] - rest.rest_joints[0][None]).norm(dim=2)
    lever = (away * (weights > _MOVED)).amax(0)
    return torch.nonzero(lever > _LEVER)[:, 0]


class Corrections(nn.Module):
    """Corrections of F frames; zero at the start.

    Args:
        registered: [F] bool of the frames: their pictures are registered, so that little is expected.
        joints: [M] joints that are corrected.
        bounds: Largest corrections.
    """

    def __init__(self, registered: Tensor, joints: Tensor, bounds: CorrectionBounds) -> None:
        super().__init__()
        self.bounds, self.joints, frames = bounds, joints, len(registered)
        self.expected = torch.where(registered.bool(), bounds.registered, bounds.expected)[:, None]
        self.pose = nn.Parameter(torch.zeros(frames, len(joints), 3))
        self.camera = nn.Parameter(torch.zeros(frames, 6))
        self.tone = nn.Parameter(torch.zeros(frames, 6))

    def rotations(self, rows: Tensor, rotations: Tensor) -> Tensor:
        """Corrected local rotations: R exp(omega).

        Args:
            rows: [B] int64 frames.
            rotations: [B,J,3,3].
        """
        turned = rotations[:, self.joints] @ so3_exp(self.bounds.pose * torch.tanh(self.pose[rows])).to(rotations)
        return rotations.index_copy(1, self.joints, turned)

    def viewmats(self, rows: Tensor, viewmats: Tensor) -> Tensor:
        """Cameras [B,4,4] turned about their own centre and shifted along their own axes."""
        turn, shift = torch.tanh(self.camera[rows]).split(3, dim=1)
        top = torch.cat([so3_exp(self.bounds.turn * turn), self.bounds.shift * shift[:, :, None]], 2)
        bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(rows), 1, 4)
        return torch.cat([top, bottom], 1).to(viewmats) @ viewmats

    def tones(self, rows: Tensor) -> Tone:
        """Gains and biases of frames [B]."""
        gain, bias = torch.tanh(self.tone[rows]).split(3, dim=1)
        return Tone(torch.exp(self.bounds.gain * gain), self.bounds.bias * bias)

    def prior(self, rows: Tensor, weights: FullWeights) -> Tensor:
        """Weighted mean squares of the corrections of frames [B], in units of their expected sizes."""
        named = ((self.pose, weights.pose_prior), (self.camera, weights.camera_prior), (self.tone, weights.tone_prior))
        expected = self.expected[rows]
        squares = [w * (torch.tanh(raw[rows]).flatten(1) / expected).square().mean() for raw, w in named]
        return torch.stack(squares).sum()

    @torch.no_grad()
    def largest(self) -> dict[str, float]:
        """The largest correction of each kind, as a share of its bound."""
        parts = {"pose": self.pose, "camera": self.camera, "tone": self.tone}
        return {name: float(torch.tanh(raw).abs().max()) if raw.numel() else 0.0 for name, raw in parts.items()}
