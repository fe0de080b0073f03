"""Motions in time: sampling by the clock, and frames that the recording lost."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ahoy_core.body.rotations import matrix_to_quaternion, nearest_rotation, quaternion_to_matrix

# Cosine beyond which a slerp's sines are too small to divide by; a straight line is exact to 1e-7 there.
_NEARLY_EQUAL = 1 - 1e-7


def slerp(a: Tensor, b: Tensor, share: Tensor) -> Tensor:
    """Rotations on the shortest way from a to b.

    Args:
        a: [...,3,3].
        b: [...,3,3].
        share: [...] of the way, 0 gives a and 1 gives b.

    Returns:
        [...,3,3]; at a half turn, where two ways are equally short, one of them.
    """
    q, r = matrix_to_quaternion(a), matrix_to_quaternion(b)
    cosine = (q * r).sum(-1, keepdim=True)
    r = torch.where(cosine < 0, -r, r)
    cosine = cosine.abs().clamp(max=1)
    t = share.to(q)[..., None].expand_as(cosine)
    angle = torch.acos(cosine.clamp(max=_NEARLY_EQUAL))
    sine = torch.sin(angle)
    near = cosine > _NEARLY_EQUAL
    first = torch.where(near, 1 - t, torch.sin((1 - t) * angle) / sine)
    second = torch.where(near, t, torch.sin(t * angle) / sine)
    return quaternion_to_matrix(first * q + second * r)


def resampled(rotations: Tensor, root: Tensor, fps: float, wanted: float) -> tuple[Tensor, Tensor]:
    """A recording at another rate, at the same speed.

    Args:
        rotations: [T,J,3,3].
        root: [T,3].
        fps: Frames per second of the recording.
        wanted: Frames per second wanted.

    Returns:
        Rotations and root at the times 0, 1/wanted, ... up to the last frame; one frame stays one.

    Raises:
        ValueError: If a rate is not positive and finite.
    """
    if not (np.isfinite([fps, wanted]).all() and fps > 0 and wanted > 0):
        raise ValueError(f"expected positive rates, got {fps} and {wanted} frames per second; say the rate with fps")
    last = len(rotations) - 1
    # A rounding error must not lose the last frame of a rate that divides the other.
    count = int(np.floor(last / fps * wanted + 1e-6)) + 1
    moments = (torch.arange(count, dtype=torch.float64) * (fps / wanted)).clamp(max=last)
    low = moments.floor().long().clamp(max=max(0, last - 1))
    high = (low + 1).clamp(max=last)
    share = moments - low
    turned = slerp(rotations[low], rotations[high], share[:, None].expand(-1, rotations.shape[1]))
    return turned, torch.lerp(root[low], root[high], share[:, None].to(root))


def held_where_missing(rotations: Tensor, root: Tensor) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """A recording without gaps: joints and root positions that are not finite are interpolated, or held at the ends.

    Args:
        rotations: [T,J,3,3].
        root: [T,3].

    Returns:
        The same, finite, and notes on what was filled.

    Raises:
        ValueError: If there is no frame, or something is not finite in every one.
    """
    if len(rotations) == 0:
        raise ValueError("expected at least one frame of motion, got none; is the file complete?")
    # A recording that lost nothing is left bit for bit as it is.
    good = torch.isfinite(rotations).all(-1).all(-1)
    there = torch.isfinite(root).all(-1)
    if bool(good.all()) and bool(there.all()):
        return rotations, root, ()
    if not bool(good.any(0).all()) or not bool(there.any()):
        broken = int((~good.any(0)).sum())
        raise ValueError(f"expected every joint to be finite in some frame, got {broken} joints that never are")
    filled = rotations.clone()
    for joint in torch.nonzero(~good.all(0))[:, 0].tolist():
        low, high, share = _neighbours(good[:, joint])
        own = rotations[:, joint]
        filled[:, joint] = slerp(nearest_rotation(own[low]), nearest_rotation(own[high]), share)
    low, high, share = _neighbours(there)
    place = torch.where(there[:, None], root, torch.lerp(root[low], root[high], share[:, None].to(root)))
    frames = int((~(good.all(1) & there)).sum())
    return (
        filled,
        place,
        (f"{frames} of {len(root)} frames were not finite in part: interpolated from their neighbours",),
    )


def _neighbours(good: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For each frame: the good frames before and after it, and how far it is between them."""
    frames = torch.arange(len(good))
    known = frames[good]
    after = torch.searchsorted(known, frames).clamp(max=len(known) - 1)
    before = (torch.searchsorted(known, frames, right=True) - 1).clamp(min=0)
    low, high = known[before], known[after]
    share = (frames - low).double() / (high - low).clamp(min=1)
    return low, high, share.clamp(0, 1)
