"""Cameras for a shot: framing what happens, circling it, or those of a file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ahoy_core.conventions import Cameras, look_at, orbit_eyes
from ahoy_core.formats.cameras import read_cameras
from ahoy_core.scene.puppet import Puppet
from ahoy_core.scene.scene import Scene

FOV = math.radians(40)
_ELEVATION = math.radians(9)
# Share of the picture that the action fills.
_FILL = 0.72


def make_cameras(spec: str, scene: Scene, puppets: Sequence[Puppet], frames: int, height: int, width: int) -> Cameras:
    """Cameras by a short description.

    Args:
        spec: "auto" frames the whole action and stands still; "orbit" or "orbit:DEGREES" circles it; "x,y,z/x,y,z" is
            an eye and what it looks at, metres; FILE or FILE#IMAGE is a COLMAP folder or a `transforms.json`: the
            camera of the first image, or of the one of that name or number.
        scene: Whose file coordinates the file's cameras are in.
        puppets: What happens.
        frames: T.
        height: Pixels.
        width: Pixels; for a file's camera it follows from the height.

    Raises:
        ValueError: If the description is none of these.
    """
    focal = max(height, width) / (2 * math.tan(FOV / 2))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])[None]
    if spec == "auto" or spec.split(":")[0] == "orbit":
        return _framing(spec, puppets, frames, K, height, width)
    if "/" in spec and "," in spec:
        try:
            eye, target = (torch.tensor([float(x) for x in part.split(",")]) for part in spec.split("/"))
        except ValueError:
            raise ValueError(f"expected a camera as x,y,z/x,y,z (eye and target, metres), got {spec!r}") from None
        return Cameras(look_at(eye, target)[None], K, width, height)
    path, _, image = spec.partition("#")
    chosen = read_cameras(path).chosen(image or 0, height)
    return Cameras(scene.to_world.viewmats(chosen.viewmats), chosen.Ks, chosen.width, chosen.height)


def _framing(spec: str, puppets: Sequence[Puppet], frames: int, K: Tensor, height: int, width: int) -> Cameras:
    if not puppets:
        raise ValueError("expected an avatar to frame, got none; give the camera as x,y,z/x,y,z")
    some = list(range(0, frames, max(1, frames // 8)))
    points = torch.cat([places for puppet in puppets for places, _ in puppet.surface(some)])
    low, high = points.amin(0), points.amax(0)
    center = (low + high) / 2
    half = (points - center).norm(dim=1).max() if spec != "auto" else (high - low).norm() / 2
    distance = float(half) * float(K[0, 0, 0]) / (_FILL * min(height, width) / 2)
    if spec == "auto":
        azimuths = torch.tensor([math.radians(25)])
    else:
        _, _, degrees = spec.partition(":")
        turn = math.radians(float(degrees)) if degrees else 2 * math.pi
        azimuths = torch.arange(frames, dtype=torch.float32) / frames * turn
    eyes = orbit_eyes(center, distance, azimuths, _ELEVATION)
    return Cameras(look_at(eyes, center), K.expand(len(eyes), 3, 3).contiguous(), width, height)
