"""Dense float64 Gaussian renderer: the definition that every other rasterizer of this project is tested against.

Every Gaussian meets every pixel. There are no tiles and no threshold is applied unless asked for, so the image is the
plain formula (Kerbl et al. 2023, eq. 2-5; Zwicker et al. 2001 for the projection) with gsplat's conventions, and
autograd differentiates it with respect to every input. Meant for small scenes: time and memory grow with N x H x W.
"""

from __future__ import annotations

from typing import Any, Final, Literal, NamedTuple

import torch
from torch import Tensor

GSPLAT: Final[dict[str, Any]] = {
    "alpha_cutoff": 1 / 255,
    "alpha_max": 0.999,
    "transmittance_stop": 1e-4,
    "frustum_clamp": True,
}
"""The shortcuts of gsplat (and of our kernels), to pass to `render` as keyword arguments."""

MAX_PAIRS: Final = 1 << 22
"""Pairs of Gaussian and pixel held at once (about 200 MB without autograd)."""


class Projected(NamedTuple):
    """The M Gaussians that one camera keeps, front to back."""

    ids: Tensor  # [M] into the input
    depths: Tensor  # [M] camera z, metres
    means2d: Tensor  # [M,2] pixels
    conics: Tensor  # [M,3] inverse 2D covariance xx, xy, yy, pixels^-2
    compensation: Tensor  # [M] in [0,1], the factor of antialiased opacities


def quat_to_matrix(quats: Tensor) -> Tensor:
    """[N,4] wxyz of any length -> [N,3,3]; a zero quaternion is the identity and gets no gradient."""
    length = torch.where((quats != 0).any(-1, keepdim=True), quats, 1.0).norm(dim=-1, keepdim=True)
    w, x, y, z = (quats / length).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def project(
    means: Tensor, covars: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int,
    near_plane: float, far_plane: float, eps2d: float, camera_model: Literal["pinhole", "ortho"], frustum_clamp: bool,
) -> Projected:  # fmt: skip
    """Gaussians that are finite, between the planes and invertible, by depth; ties keep the input's order."""
    finite = means.isfinite().all(-1) & covars.isfinite().flatten(1).all(-1)
    z = torch.where(finite, means.detach() @ viewmat[2, :3].detach() + viewmat[2, 3].detach(), torch.nan)
    index = torch.argsort(z, stable=True)
    index = index[(z[index] > near_plane) & (z[index] < far_plane)]
    R, (x, y, z) = viewmat[:3, :3], (means[index] @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    if camera_model == "ortho":
        means2d = torch.stack([fx * x + cx, fy * y + cy], -1)
        J = torch.stack([fx * one, zero, zero, zero, fy * one, zero], -1).reshape(-1, 2, 3)
    else:
        u, v = x / z, y / z
        means2d = torch.stack([fx * u + cx, fy * v + cy], -1)
        if frustum_clamp:  # the Jacobian is taken no further out than 15% of the image beyond its border
            u = u.clamp(-(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx)
            v = v.clamp(-(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy)
        J = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    sharp = J @ R @ covars[index] @ R.T @ J.transpose(1, 2)
    a, b, c = sharp[:, 0, 0] + eps2d, (sharp[:, 0, 1] + sharp[:, 1, 0]) / 2, sharp[:, 1, 1] + eps2d
    det = a * c - b * b
    ratio = (sharp[:, 0, 0] * sharp[:, 1, 1] - b * b) / det
    compensation = torch.where(ratio > 0, torch.where(ratio > 0, ratio, 1.0).sqrt(), 0.0)
    ok = det > 0
    conics = torch.stack([c, -b, a], -1)[ok] / det[ok, None]
    return Projected(index[ok], z[ok], means2d[ok], conics, compensation[ok])


def pixel_alphas(splats: Projected, opacities: Tensor, pixels: Tensor) -> Tensor:
    """Opacity of every Gaussian at every pixel, before any threshold: opacities [M], pixels [P,2] -> [P,M]."""
    dx, dy = (pixels[:, None] - splats.means2d).unbind(-1)
    a, b, c = splats.conics.unbind(-1)
    return opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)


def blend_weights(
    alphas: Tensor, alpha_cutoff: float | None, alpha_max: float | None, transmittance_stop: float | None
) -> Tensor:
    """Share of every Gaussian in every pixel, w_i = alpha_i prod_{j<i} (1 - alpha_j), front to back along [P,M]."""
    if alpha_max is not None:
        alphas = alphas.clamp(max=alpha_max)
    if alpha_cutoff is not None:
        alphas = torch.where(alphas < alpha_cutoff, 0.0, alphas)
    after = torch.cumprod(1 - alphas, 1)
    weights = alphas * torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    if transmittance_stop is not None:  # the Gaussian that would cross the stop is left out, and all behind it
        weights = torch.where(after.detach() > transmittance_stop, weights, 0.0)
    return weights


def sh_to_color(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics (Sloan 2013) at directions [M,3] of any length: [M,K,3] -> max(0, sum + 0.5) [M,3]."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        basis += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1)]
        basis += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        basis += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
        basis += [-0.4570457994644658 * y * (5 * z * z - 1), 0.3731763325901154 * z * (5 * z * z - 3)]
        basis += [-0.4570457994644658 * x * (5 * z * z - 1), 1.445305721320277 * z * (x * x - y * y)]
        basis += [-0.5900435899266435 * x * (x * x - 3 * y * y)]
    return ((torch.stack(basis, -1)[..., None] * coefficients[:, : len(basis)]).sum(1) + 0.5).clamp(min=0)


def camera_image(
    splats: Projected, opacity: Tensor, color: Tensor, width: int, height: int, **shortcuts: Any
) -> Tensor:
    """Blend the kept Gaussians (opacity [M], color [M,D]) into an image with the alpha as last channel, [H,W,D+1]."""
    grid = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([grid[1], grid[0]], -1).reshape(-1, 2).double()
    color = torch.cat([color, torch.ones_like(opacity)[:, None]], 1)
    rows = [
        blend_weights(pixel_alphas(splats, opacity, chunk), **shortcuts) @ color
        for chunk in pixels.split(max(1, MAX_PAIRS // max(1, len(opacity))))
    ]
    return torch.cat(rows).reshape(height, width, -1)


def render(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, near_plane: float = 0.01, far_plane: float = 1e10,
    eps2d: float = 0.3, sh_degree: int | None = None, backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    camera_model: Literal["pinhole", "ortho"] = "pinhole", covars: Tensor | None = None, *,
    alpha_cutoff: float | None = None, alpha_max: float | None = None, transmittance_stop: float | None = None,
    frustum_clamp: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Render as `rasterization` does, in float64 and without shortcuts.

    Args:
        means: [N,3] world, metres. A Gaussian with a NaN or an infinity in any input of its own is left out.
        quats: [N,4] wxyz of any length, zero = identity.
        scales: [N,3] metres.
        opacities: [N] in [0,1].
        colors: [N,D] or [C,N,D]; with sh_degree the coefficients [N,K,3] or [C,N,K,3].
        viewmats: [C,4,4] world -> camera (OpenCV).
        Ks: [C,3,3] pixels, pixel centres at +0.5; an orthographic camera reads them as pixels per metre.
        width: Pixels; height likewise.
        height: See width.
        near_plane: Kept are camera depths strictly between near_plane and far_plane, metres.
        far_plane: See near_plane.
        eps2d: Added to the diagonal of the 2D covariance, pixels^2.
        sh_degree: Degree (0-3) of the harmonics in colors, None if colors are colours.
        backgrounds: [C,D] behind everything; depth channels have background 0.
        render_mode: D is the sum of w z, ED that over the alpha.
        rasterize_mode: antialiased multiplies opacities by sqrt(det / det with eps2d).
        camera_model: pinhole or ortho.
        covars: [N,3,3] world covariances instead of quats and scales.
        alpha_cutoff: Contributions under it are left out (gsplat: 1/255).
        alpha_max: Contributions are clamped to it, without gradient above (gsplat: 0.999).
        transmittance_stop: A pixel ends before the Gaussian that would take it to this transmittance (gsplat: 1e-4).
        frustum_clamp: Clamp the pinhole Jacobian to 15% of the image beyond its border, as gsplat does.

    Returns:
        Colours [C,H,W,D'] and alphas [C,H,W,1], float64.
    """
    means, opacities, colors, viewmats, Ks = (t.double() for t in (means, opacities, colors, viewmats, Ks))
    if covars is None:
        assert quats is not None and scales is not None, "give quats and scales, or covars"
        half = quat_to_matrix(quats.double()) * scales.double()[:, None]
        covars = half @ half.transpose(1, 2)
    covars = covars.double()
    shortcuts = {"alpha_cutoff": alpha_cutoff, "alpha_max": alpha_max, "transmittance_stop": transmittance_stop}
    planes = near_plane, far_plane
    images = []
    for i, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        own = colors if colors.dim() == (2 if sh_degree is None else 3) else colors[i]
        finite = opacities.isfinite() & own.flatten(1).isfinite().all(-1)
        usable = torch.where(finite[:, None], means, torch.nan)
        splats = project(usable, covars, viewmat, K, width, height, *planes, eps2d, camera_model, frustum_clamp)
        opacity, color = opacities[splats.ids], own[splats.ids]
        if rasterize_mode == "antialiased":
            opacity = opacity * splats.compensation
        if sh_degree is not None:
            color = sh_to_color(color, means[splats.ids] - torch.linalg.inv(viewmat)[:3, 3], sh_degree)
        channels = {"RGB": [color], "D": [splats.depths[:, None]]}
        features = torch.cat([f for m in render_mode.replace("ED", "D").split("+") for f in channels[m]], 1)
        image = camera_image(splats, opacity, features, width, height, **shortcuts)
        if backgrounds is not None and "RGB" in render_mode:
            back = torch.nn.functional.pad(backgrounds[i].double(), (0, image.shape[-1] - backgrounds.shape[-1]))
            image = image + (1 - image[..., -1:]) * back
        if render_mode.endswith("ED"):
            expected = image[..., -2:-1] / image[..., -1:].clamp(min=1e-10)
            image = torch.cat([image[..., :-2], expected, image[..., -1:]], -1)
        images.append(image)
    stacked = torch.stack(images)
    return stacked[..., :-1], stacked[..., -1:]
