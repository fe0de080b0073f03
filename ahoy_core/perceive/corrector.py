"""A small network that corrects the landmark network: where its guesses are biased, and how far they can be trusted.

The landmark network was trained on photographs, hardly sees that a camera looks down, and guesses at what is hidden
without saying how well. The corrector has seen rendered people behind furniture with the truth beside them
(`python -m benchmarks.train_corrector`): it moves the landmarks, in the picture and in metres, and gives each a spread.
Everything it reads and says is in metres at the person's depth, so it holds for any picture size and distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load
from torch import Tensor, nn

N = 33
# BlazePose's 33 landmarks with left and right exchanged.
MIRROR = (0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9, *(i + (1 if i % 2 else -1) for i in range(11, N)))
FEATURES = N * 6 + 7
OUTPUTS = N * 7
WIDTH = 256
SPREADS = (0.008, 0.6)  # metres: bounds of what the network may claim
FEATURE_LIMIT = 5.0  # standard deviations: what was never seen in training is read as its nearest
ASSET = "corrector.safetensors"


@dataclass(frozen=True)
class Corrected:
    """Landmarks after correction.

    Attributes:
        points: [T,33,2] pixels.
        world: [T,33,3] metres, camera axes, hips at the origin.
        image_spread: [T,33] metres at the person's depth, of one coordinate of a point.
        world_spread: [T,33] metres, of one coordinate.
    """

    points: NDArray[np.float64]
    world: NDArray[np.float64]
    image_spread: NDArray[np.float64]
    world_spread: NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """How a frame's landmarks become metres: rays = centre + scale * metres.

    Attributes:
        centre: [T,2] on the plane at depth 1.
        scale: [T] of a metre at the person's depth.
    """

    centre: Tensor
    scale: Tensor

    def to_metres(self, rays: Tensor) -> Tensor:
        """Rays [T,33,2] on the plane at depth 1 -> metres about the centre."""
        return (rays - self.centre[:, None]) / self.scale[:, None, None]

    def to_rays(self, metres: Tensor) -> Tensor:
        """Inverse of `to_metres`."""
        return metres * self.scale[:, None, None] + self.centre[:, None]


def weak_perspective(rays: Tensor, world: Tensor, visibility: Tensor) -> Frame:
    """Fit centre and scale of the landmark network's own 3D to the picture, weighted by visibility.

    Args:
        rays: [T,33,2] on the plane at depth 1.
        world: [T,33,3] metres, camera axes.
        visibility: [T,33].
    """
    share = visibility.square() + 1e-3
    share = (share / share.sum(1, keepdim=True))[..., None]
    centre, middle = (share * rays).sum(1), (share * world[..., :2]).sum(1)
    apart, metres = rays - centre[:, None], world[..., :2] - middle[:, None]
    scale = (share * apart * metres).sum((1, 2)) / (share * metres.square()).sum((1, 2)).clamp_min(1e-6)
    # A person seen end-on, or noise, may turn the sign: the ratio of sizes holds always.
    size = ((share * apart.square()).sum((1, 2)) / (share * metres.square()).sum((1, 2)).clamp_min(1e-6)).sqrt()
    return Frame(centre, torch.maximum(scale, 0.5 * size).clamp_min(1e-6))


def features(points: Tensor, world: Tensor, visibility: Tensor, frame: Frame, up: Tensor) -> Tensor:
    """What the network reads, [T,FEATURES].

    Args:
        points: [T,33,2] metres about the frame's centre.
        world: [T,33,3] metres.
        visibility: [T,33].
        frame: of the points.
        up: [T,3] unit, camera axes; zeros where unknown.
    """
    known = (up.abs().sum(1, keepdim=True) > 0).to(up)
    placed = [frame.centre, frame.scale.log()[:, None], up, known]
    return torch.cat([points.flatten(1), world.flatten(1), visibility, *placed], dim=1)


class Corrector(nn.Module):
    """Two hidden layers beside a straight one. `forward` takes features and gives offsets and logarithms of spreads."""

    mean: Tensor
    spread: Tensor
    calibration: Tensor

    def __init__(self, dropout: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("spread", torch.ones(FEATURES))
        self.register_buffer("calibration", torch.zeros(2))
        self.straight = nn.Linear(FEATURES, OUTPUTS)
        self.bent = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(FEATURES, WIDTH), nn.SiLU(), nn.Dropout(dropout), nn.Linear(WIDTH, WIDTH),
            nn.SiLU(), nn.Dropout(dropout), nn.Linear(WIDTH, OUTPUTS),
        )  # fmt: skip

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features [T,FEATURES] -> offsets in the picture [T,33,2] and in space [T,33,3], log spreads [T,33,2]."""
        x = ((x - self.mean) / self.spread).clamp(-FEATURE_LIMIT, FEATURE_LIMIT)
        y = self.straight(x) + self.bent(x)
        points, world, spreads = y.split((2 * N, 3 * N, 2 * N), dim=1)
        return points.unflatten(1, (N, 2)), world.unflatten(1, (N, 3)), spreads.unflatten(1, (N, 2)) - 3.0


def mirrored(points: Tensor, world: Tensor, visibility: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same landmarks seen in a mirror (the picture's x turned round)."""
    order = list(MIRROR)
    flip2, flip3 = points.new_tensor([-1.0, 1.0]), points.new_tensor([-1.0, 1.0, 1.0])
    return points[:, order] * flip2, world[:, order] * flip3, visibility[:, order]


def predict(
    network: Corrector, points: Tensor, world: Tensor, visibility: Tensor, frame: Frame, up: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean of the network's answers for the landmarks and for their mirror image, as `Corrector.forward` gives them."""
    straight = network(features(points, world, visibility, frame, up))
    flip2, flip3 = points.new_tensor([-1.0, 1.0]), points.new_tensor([-1.0, 1.0, 1.0])
    turned = Frame(frame.centre * flip2, frame.scale)
    answer = network(features(*mirrored(points, world, visibility), turned, up * flip3))
    order = list(MIRROR)
    back = (answer[0][:, order] * flip2, answer[1][:, order] * flip3, answer[2][:, order])
    points, world, spreads = (0.5 * (a + b) for a, b in zip(straight, back, strict=True))
    return points, world, spreads


def correct(
    points: NDArray[np.floating],
    world: NDArray[np.floating],
    visibility: NDArray[np.floating],
    K: NDArray[np.floating],
    up: NDArray[np.floating] | None = None,
) -> Corrected:
    """Correct the landmarks of T frames.

    Args:
        points: [T,33,2] pixels.
        world: [T,33,3] metres, camera axes, as the landmark network gives them.
        visibility: [T,33] in [0,1].
        K: [3,3] pixels.
        up: [3] unit vector in camera axes, None where unknown.
    """
    focal, middle = np.array([K[0, 0], K[1, 1]]), np.asarray(K)[:2, 2]
    rays = torch.from_numpy((points - middle) / focal).float()
    space, seen = torch.from_numpy(np.asarray(world)).float(), torch.from_numpy(np.asarray(visibility)).float()
    frame = weak_perspective(rays, space, seen)
    metres = frame.to_metres(rays)
    sky = torch.zeros(len(rays), 3) if up is None else torch.from_numpy(np.asarray(up)).float().expand(len(rays), 3)
    network = load_corrector()
    with torch.no_grad():
        moved, lifted, spreads = predict(network, metres, space, seen, frame, sky)
        spreads = (spreads + network.calibration).exp().clamp(*SPREADS)
    fixed = frame.to_rays(metres + moved).double().numpy() * focal + middle
    return Corrected(fixed, (space + lifted).double().numpy(), *spreads.double().numpy().transpose(2, 0, 1))


@cache
def load_corrector() -> Corrector:
    """The packaged network (`ahoy_core/assets/corrector.md` says what it was trained on)."""
    network = Corrector()
    arrays = load(resources.files("ahoy_core.assets").joinpath(ASSET).read_bytes())
    network.load_state_dict({name: value.float() for name, value in arrays.items()})
    return network.eval()
