"""Units, frames and cameras, fixed once (docs/conventions.md).

World: metres, right-handed, z up; a person in canonical orientation faces -y and has the left hand towards +x.
Cameras are OpenCV (x right, y down, z forward), pixel centres at +0.5. An orthographic camera uses the same K:
`u = fx * x_cam + cx`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

CameraModel = Literal["pinhole", "ortho"]

# The observed camera stands at the world's origin and looks along +y: x_cam = x, y_cam = -z, z_cam = y.
OBSERVED_VIEWMAT: Tensor = torch.tensor(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
WORLD_UP: tuple[float, float, float] = (0.0, 0.0, 1.0)
CANONICAL_AZIMUTHS: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)  # degrees: front, left, back, right
CANONICAL_VIEWS: tuple[str, ...] = ("front", "left", "back", "right")
CANONICAL_MARGIN = 1.1  # the framed box is the body's box and 10%
PERSON_HEIGHT_SHARE = 0.9  # of a person image's height is body
GREY = 0.5  # background of person images


class Projection(NamedTuple):
    """Where points land: `pixels` [..., N, 2] (u right, v down) and `depths` [..., N], metres along the axis."""

    pixels: Tensor
    depths: Tensor


def project(points: Tensor, viewmat: Tensor, K: Tensor, camera_model: CameraModel = "pinhole") -> Projection:
    """Projects world points to pixels.

    Args:
        points: [..., N, 3] metres, world.
        viewmat: [..., 4, 4] world -> camera; leading dimensions broadcast with those of `points`.
        K: [..., 3, 3] pixels (pinhole) or pixels per metre (ortho).
        camera_model: "pinhole" or "ortho".

    Returns:
        Pixels and depths. Nothing is clipped: for a pinhole camera, points with depth <= 0 have meaningless pixels
        (infinite at depth 0), so look at the depths.

    Raises:
        ValueError: for an unknown camera model.
    """
    camera = points @ viewmat[..., :3, :3].transpose(-1, -2) + viewmat[..., None, :3, 3]
    depths = camera[..., 2]
    if camera_model == "pinhole":
        plane = torch.cat([camera[..., :2] / depths[..., None], torch.ones_like(depths)[..., None]], dim=-1)
    elif camera_model == "ortho":
        plane = torch.cat([camera[..., :2], torch.ones_like(depths)[..., None]], dim=-1)
    else:
        raise ValueError(f"expected camera_model 'pinhole' or 'ortho', got {camera_model!r}")
    return Projection(plane @ K[..., :2, :].transpose(-1, -2), depths)


@dataclass(frozen=True)
class Cameras:
    """C cameras that share an image size.

    Attributes:
        viewmats: [C,4,4] world -> camera, rigid.
        Ks: [C,3,3] intrinsics, pixels (pinhole) or pixels per metre (ortho).
        width: pixels.
        height: pixels.
        camera_model: "pinhole" or "ortho".
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    camera_model: CameraModel = "pinhole"

    def __post_init__(self) -> None:
        if self.viewmats.ndim != 3 or self.viewmats.shape[1:] != (4, 4):
            raise ValueError(
                f"expected viewmats [C,4,4], got {tuple(self.viewmats.shape)}; add a leading camera dimension"
            )
        if self.Ks.shape != (len(self.viewmats), 3, 3):
            raise ValueError(f"expected Ks [{len(self.viewmats)},3,3] to match viewmats, got {tuple(self.Ks.shape)}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"expected a positive image size, got {self.width}x{self.height} (width x height)")
        if self.camera_model not in ("pinhole", "ortho"):
            raise ValueError(f"expected camera_model 'pinhole' or 'ortho', got {self.camera_model!r}")
        rotations = self.viewmats[:, :3, :3].detach()
        eye = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        if not torch.allclose(rotations @ rotations.transpose(1, 2), eye.expand_as(rotations), atol=1e-3):
            raise ValueError(
                "expected rigid viewmats (upper left 3x3 a rotation), got scale or shear; put scale into Ks"
            )
        if not bool((self.Ks[:, 0, 0] > 0).all() and (self.Ks[:, 1, 1] > 0).all()):
            raise ValueError("expected positive focal lengths in Ks, got 0 or less; OpenCV cameras need no sign flips")

    def __len__(self) -> int:
        return len(self.viewmats)

    def __getitem__(self, index: int | slice | Sequence[int]) -> Cameras:
        """The chosen cameras; one index gives one camera, still with the leading dimension."""
        rows = [index] if isinstance(index, int) else index
        return replace(self, viewmats=self.viewmats[rows], Ks=self.Ks[rows])

    @property
    def centers(self) -> Tensor:
        """[C,3] camera positions in the world."""
        rotations, shifts = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotations.transpose(1, 2) @ shifts[..., None])[..., 0]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        """The same cameras on another device or in another precision."""
        return replace(
            self, viewmats=self.viewmats.to(device=device, dtype=dtype), Ks=self.Ks.to(device=device, dtype=dtype)
        )

    def project(self, points: Tensor) -> Projection:
        """Projects points [N,3] (seen by all cameras) or [C,N,3] (one set a camera): pixels [C,N,2], depths [C,N]."""
        return project(points, self.viewmats, self.Ks, self.camera_model)


def perspective_K(fov: float, width: int, height: int) -> Tensor:  # noqa: N802
    """Pinhole intrinsics [3,3] with the principal point in the middle.

    Args:
        fov: radians in (0, pi), across the **longer** side, so that turning a phone on its side changes nothing.
        width: pixels.
        height: pixels.

    Raises:
        ValueError: when the field of view is outside (0, pi).
    """
    if not 0 < fov < math.pi:
        raise ValueError(f"expected a field of view in (0, pi) radians, got {fov}; convert degrees with math.radians")
    focal = 0.5 * max(width, height) / math.tan(0.5 * fov)
    return torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def look_at(eye: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """World -> camera [...,4,4] of an OpenCV camera at `eye` [...,3] that looks at `target` [...,3].

    Args:
        eye: [...,3] metres, world.
        target: [...,3] metres, world; at another place than `eye`.
        up: [...,3] direction that is upwards in the image; world z by default.

    Raises:
        ValueError: when a camera looks at its own position or along `up`, where the image's roll is undefined.
    """
    eye, target = torch.broadcast_tensors(eye, target)
    up = torch.tensor(WORLD_UP, dtype=eye.dtype, device=eye.device) if up is None else up
    forward = target - eye
    right = torch.linalg.cross(forward, up.expand_as(forward))
    if bool((right.norm(dim=-1) <= 1e-6 * forward.norm(dim=-1)).any()):
        raise ValueError("expected a target away from the eye and not straight along `up`; pass another `up`")
    forward, right = torch.nn.functional.normalize(forward, dim=-1), torch.nn.functional.normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=-2)
    viewmat = torch.zeros(*eye.shape[:-1], 4, 4, dtype=eye.dtype, device=eye.device)
    viewmat[..., :3, :3] = rotation
    viewmat[..., :3, 3] = -(rotation @ eye[..., None])[..., 0]
    viewmat[..., 3, 3] = 1.0
    return viewmat


def orbit_eyes(center: Tensor, radius: float, azimuths: Tensor, elevation: float = 0.0) -> Tensor:
    """Positions [n,3] about `center` [3]; azimuth 0 is in front (-y), pi/2 on the person's left (+x); radians."""
    ring = torch.stack(
        [
            torch.sin(azimuths) * math.cos(elevation),
            -torch.cos(azimuths) * math.cos(elevation),
            torch.full_like(azimuths, math.sin(elevation)),
        ],
        dim=-1,
    )
    return center + radius * ring


def canonical_cameras(vertices: Tensor, height: int, width: int) -> Cameras:
    """The four orthographic cameras of a canonical body: front, left, back, right (paper, section 3.1).

    Args:
        vertices: [V,3] or [1,V,3] metres, world, of the body in canonical pose.
        height: pixels.
        width: pixels.

    Returns:
        Cameras at azimuths 0, 90, 180, 270 degrees with one scale for all (pixels per metre), framing the vertices' box
        and 10%.

    Raises:
        ValueError: when `vertices` has another shape or no extent.
    """
    points = vertices.detach().reshape(-1, 3) if vertices.shape[-1:] == (3,) else vertices
    if points.shape[-1:] != (3,) or (vertices.ndim == 3 and len(vertices) != 1) or len(points) == 0:
        raise ValueError(f"expected the vertices of one body [V,3], got {tuple(vertices.shape)}")
    low, high = points.amin(0), points.amax(0)
    extent = high - low
    if not bool(torch.isfinite(extent).all()) or float(extent.max()) <= 0:
        raise ValueError(f"expected a body with a finite, positive extent, got {extent.tolist()}")
    across = max(float(extent[0]), float(extent[1]), 1e-6)
    scale = min(height / (CANONICAL_MARGIN * max(float(extent[2]), 1e-6)), width / (CANONICAL_MARGIN * across))
    center = 0.5 * (low + high)
    azimuths = torch.deg2rad(torch.tensor(CANONICAL_AZIMUTHS, dtype=points.dtype, device=points.device))
    # Any distance gives the same orthographic picture; two diagonals keep all of the body in front of the camera.
    viewmats = look_at(orbit_eyes(center, 2.0 * float(extent.norm()), azimuths), center)
    return Cameras(viewmats, _centered_Ks(scale, width, height, viewmats), width, height, "ortho")


def turntable_cameras(
    center: Tensor, radius: float, n: int, elevation: float, height: int, width: int, focal: float
) -> Cameras:
    """`n` pinhole cameras evenly round `center` [3], from the front towards the person's left (azimuth upwards).

    Args:
        center: [3] metres, world; the point that all cameras look at.
        radius: metres.
        n: number of cameras.
        elevation: radians above the horizontal plane, in (-pi/2, pi/2).
        height: pixels.
        width: pixels.
        focal: pixels.

    Raises:
        ValueError: when `n`, `radius` or `focal` is not positive.
    """
    if n < 1 or radius <= 0 or focal <= 0:
        raise ValueError(f"expected n, radius and focal above 0, got n={n}, radius={radius}, focal={focal}")
    azimuths = torch.arange(n, dtype=center.dtype, device=center.device) * (2 * math.pi / n)
    viewmats = look_at(orbit_eyes(center, radius, azimuths, elevation), center)
    return Cameras(viewmats, _centered_Ks(focal, width, height, viewmats), width, height, "pinhole")


def _centered_Ks(focal: float, width: int, height: int, like: Tensor) -> Tensor:  # noqa: N802
    """[C,3,3] equal intrinsics for the C viewmats in `like`."""
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=like.dtype, device=like.device)
    return K.expand(len(like), 3, 3).clone()


@dataclass(frozen=True)
class PersonImage:
    """A person cut out of a frame in the framing that every stage shares: over grey, the body at 90% of the height.

    Attributes:
        image: [3,H,W] sRGB in [0,1], the subject composited over grey 0.5.
        mask: [1,H,W] alpha in [0,1].
        K: [3,3] intrinsics of the crop; the viewmat is the frame's.
        crop: [3,3] homogeneous map from the frame's pixels to the crop's.
    """

    image: Tensor
    mask: Tensor
    K: Tensor
    crop: Tensor

    def from_frame(self, pixels: Tensor) -> Tensor:
        """Pixels [...,2] of the frame -> pixels of the crop."""
        return pixels @ self.crop[:2, :2].T + self.crop[:2, 2]

    def to_frame(self, pixels: Tensor) -> Tensor:
        """Pixels [...,2] of the crop -> pixels of the frame."""
        return (pixels - self.crop[:2, 2]) @ torch.linalg.inv(self.crop[:2, :2]).T


def person_crop(mask: Tensor, height: int, width: int) -> Tensor:
    """The map [3,3] from a frame's pixels to a person image's pixels: uniform scale and shift.

    The box of `mask` > 0.5 comes to the middle, its height to 90% of `height`; when that would make it wider than 90%
    of `width`, the width decides, so that nothing is cut.

    Args:
        mask: [H,W] or [1,H,W] alpha in [0,1] (of the visible person, or of the fitted body where the crop must hold
            hidden parts).
        height: pixels of the person image.
        width: pixels of the person image.

    Raises:
        ValueError: when no pixel of `mask` is above 0.5.
    """
    inside = mask.reshape(mask.shape[-2:]) > 0.5
    if not bool(inside.any()):
        raise ValueError("expected a mask with a person (values above 0.5), got none; skip frames without a subject")
    rows, columns = torch.nonzero(inside.any(1))[:, 0], torch.nonzero(inside.any(0))[:, 0]
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    scale = PERSON_HEIGHT_SHARE * min(height / (bottom - top), width / (right - left))
    shift_x, shift_y = width / 2 - scale * (left + right) / 2, height / 2 - scale * (top + bottom) / 2
    return torch.tensor([[scale, 0.0, shift_x], [0.0, scale, shift_y], [0.0, 0.0, 1.0]])


def person_image(
    image: Tensor, mask: Tensor, K: Tensor, height: int, width: int, crop: Tensor | None = None
) -> PersonImage:
    """Cuts a person out of a frame, with intrinsics to match.

    Args:
        image: [3,H,W] sRGB in [0,1].
        mask: [H,W] or [1,H,W] alpha in [0,1] of what is kept.
        K: [3,3] intrinsics of the frame.
        height: pixels of the person image.
        width: pixels of the person image.
        crop: [3,3] from `person_crop`; by default the crop of `mask`. Pass one to give several frames the same framing.

    Raises:
        ValueError: when image and mask differ in size, or the mask is empty.
    """
    if image.ndim != 3 or image.shape[0] != 3 or mask.shape[-2:] != image.shape[-2:]:
        raise ValueError(
            f"expected image [3,H,W] and mask [H,W] of one size, got {tuple(image.shape)} and {tuple(mask.shape)}"
        )
    alpha = mask.reshape(1, *image.shape[-2:]).to(image.dtype)
    crop = (person_crop(mask, height, width) if crop is None else crop).to(device=image.device, dtype=image.dtype)
    rows = _resampling(height, image.shape[1], float(crop[1, 1]), float(crop[1, 2])).to(image)
    columns = _resampling(width, image.shape[2], float(crop[0, 0]), float(crop[0, 2])).to(image)
    premultiplied = rows @ torch.cat([image * alpha, alpha]) @ columns.T
    alpha_out = premultiplied[3:]
    return PersonImage(premultiplied[:3] + GREY * (1 - alpha_out), alpha_out, crop.to(K) @ K, crop)


def _resampling(n_out: int, n_in: int, scale: float, shift: float) -> Tensor:
    """Weights [n_out,n_in] of a tent filter that resamples by u -> scale * u + shift; wider when shrinking."""
    centers = (torch.arange(n_out, dtype=torch.float64) + 0.5 - shift) / scale
    support = max(1.0, 1.0 / scale)

    def tent(offsets: Tensor) -> Tensor:
        return (1 - offsets.abs() / support).clamp(min=0)

    # The mass is taken over an endless row: beyond the frame there is nothing, and alpha has to fade there.
    reach = torch.arange(-math.ceil(support) - 1, math.ceil(support) + 2, dtype=torch.float64)
    mass = tent(centers.floor()[:, None] + reach + 0.5 - centers[:, None]).sum(1, keepdim=True)
    return tent(torch.arange(n_in, dtype=torch.float64) + 0.5 - centers[:, None]) / mass
