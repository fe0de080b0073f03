"""Scenes and comparisons shared by the rasterizer's tests: kernels and oracle get the same keyword arguments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ahoy_core.splat import oracle, rasterization

Scene = dict[str, Any]

LEAVES = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "backgrounds")
KERNEL_ONLY = ("tile_size", "num_threads", "memory_budget", "channel_chunk")

IMAGE_ATOL = 1e-5
"""Largest error of a pixel, relative to max(1, value), on scenes where no threshold flips."""
GRAD_RTOL = 1e-4
"""Largest relative L2 error of a gradient on such scenes."""
GPU_SLACK = 10.0
"""On a GPU hard cases may be this much further off: gsplat sums gradients in float32, unordered, with fast maths."""
FLIP_MARGIN = 3e-5
"""Decisions nearer to their threshold than this may fall differently in float32 (a few ulp of a dozen operations)."""
FLIP_STEP = 1.1 / 255
"""A contribution that flips at the cutoff changes a pixel of a scene with colours in [0,1] by 1/255 at most."""


def look_at_rotation(azimuth: float, elevation: float) -> Tensor:
    """World -> camera rotation [3,3], float64, of a camera on a sphere round the origin."""
    ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
    turn = torch.tensor([[ca, 0, sa], [0, 1, 0], [-sa, 0, ca]], dtype=torch.float64)
    tilt = torch.tensor([[1, 0, 0], [0, ce, -se], [0, se, ce]], dtype=torch.float64)
    return tilt @ turn


def cameras(count: int, width: int, height: int, camera_model: str = "pinhole", distance: float = 3.0) -> Scene:
    """Cameras round the origin with off-centre principal points and fx != fy."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for i in range(count):
        viewmats[i, :3, :3] = look_at_rotation(0.3 + 1.1 * i, 0.2 - 0.15 * i)
        viewmats[i, :3, 3] = torch.tensor([0.03, -0.05, distance])
    focal = 1.15 * max(width, height) / (1.0 if camera_model == "pinhole" else distance)
    K = torch.tensor([[focal, 0, 0.48 * width], [0, 0.97 * focal, 0.53 * height], [0, 0, 1]], dtype=torch.float64)
    return {"viewmats": viewmats, "Ks": K.repeat(count, 1, 1), "width": width, "height": height,
            "camera_model": camera_model}  # fmt: skip


def random_scene(
    seed: int, n: int = 60, width: int = 40, height: int = 33, *, count: int = 1, channels: int = 3,
    sh_degree: int | None = None, covars: bool = False, camera_model: str = "pinhole", backgrounds: bool = True,
    dtype: torch.dtype = torch.float32, **options: Any,
) -> Scene:  # fmt: skip
    """A ball of n anisotropic Gaussians of mixed opacity before `count` cameras; options are passed through."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    scene: Scene = {
        "means": 0.5 * normal(n, 3),
        "quats": normal(n, 4),
        "scales": torch.exp(0.6 * normal(n, 3) - 2.6),
        "opacities": torch.sigmoid(1.5 * normal(n)),
        "colors": torch.sigmoid(normal(n, channels)),
        **cameras(count, width, height, camera_model),
    }
    if sh_degree is not None:
        scene |= {"colors": 0.3 * normal(n, 16, 3), "sh_degree": sh_degree}
        channels = 3
    if backgrounds:
        scene["backgrounds"] = torch.sigmoid(normal(count, channels))
    if covars:
        half = oracle.quat_to_matrix(scene["quats"]) * scene["scales"][:, None]
        scene |= {"covars": half @ half.transpose(1, 2), "quats": None, "scales": None}
    return convert({**scene, **options}, dtype)


def convert(scene: Scene, dtype: torch.dtype | None = None, device: str = "cpu") -> Scene:
    """The scene with floating tensors in another dtype, or on another device."""
    return {k: v.to(device=device, dtype=dtype or v.dtype) if torch.is_tensor(v) else v for k, v in scene.items()}


def on_gpu(**scene: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`rasterization` there and back over a GPU, so that a test compares as it does on the CPU."""
    colors, alphas, meta = rasterization(**convert(scene, device="cuda"))
    return colors.cpu(), alphas.cpu(), convert(meta, device="cpu")


def same_gradients(render: Callable[..., Any], value: Tensor, expected: Tensor) -> bool:
    """Bit for bit on the CPU; on a GPU but for the order of its sums."""
    if render is on_gpu:
        return relative_l2(value.double(), expected.double()) < 1e-5
    return torch.equal(value, expected)


def select(scene: Scene, rows: Tensor) -> Scene:
    """The scene with only these Gaussians (or in this order)."""
    per_gaussian = ("means", "quats", "scales", "covars", "opacities", "colors")
    return {k: v[rows].contiguous() if k in per_gaussian and v is not None else v for k, v in scene.items()}


def reference(**scene: Any) -> tuple[Tensor, Tensor]:
    """The oracle with gsplat's shortcuts, deaf to arguments that must not change the image."""
    return oracle.render(**{**oracle.GSPLAT, **{k: v for k, v in scene.items() if k not in KERNEL_ONLY}})


@dataclass
class Rendered:
    """Result of one call and its gradients under `loss`, everything detached."""

    colors: Tensor
    alphas: Tensor
    grads: dict[str, Tensor] = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)


def loss(colors: Tensor, alphas: Tensor, seed: int = 0) -> Tensor:
    """A fixed random linear functional of the image and the alphas."""
    generator = torch.Generator().manual_seed(seed)
    weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in (colors, alphas)]
    return (colors * weights[0]).sum() + (alphas * weights[1]).sum()


def run(render: Callable[..., Any], scene: Scene, wrt: Iterable[str] = LEAVES) -> Rendered:
    """Render, and differentiate with respect to the named inputs that the scene has."""
    leaves = {k: scene[k].detach().clone().requires_grad_() for k in wrt if scene.get(k) is not None}
    colors, alphas, *rest = render(**{**scene, **leaves})
    if leaves:
        # Expected depth divides by alpha, down to 1/255: its gradients are weighed as depth is used, by coverage.
        expected_depth = scene.get("render_mode", "RGB").endswith("ED")
        loss(colors * alphas.detach() if expected_depth else colors, alphas).backward()
    grads = {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in leaves.items()}
    return Rendered(colors.detach(), alphas.detach(), grads, rest[0] if rest else {})


def comparable(name: str, grad: Tensor) -> Tensor:
    """A gradient where it is defined: viewmats without the constant row, covars symmetrised; float64 on the CPU."""
    grad = grad.detach().double().cpu()
    if name == "viewmats":
        return grad[:, :3]
    return (grad + grad.transpose(-1, -2)) / 2 if name == "covars" else grad


def relative_l2(value: Tensor, expected: Tensor) -> float:
    """Norm of the difference over the norm expected; 0 for two zeros, inf for a value where zero is expected."""
    error, size = (value - expected).norm().item(), expected.norm().item()
    return error / size if size > 0 else (0.0 if error == 0 else math.inf)


def pixel_errors(image: Tensor, expected: Tensor) -> Tensor:
    """[..., D] -> [...]: the worst channel's error relative to max(1, |expected|); NaN counts as infinite."""
    expected = expected.double().cpu()
    error = (image.detach().double().cpu() - expected).abs() / expected.abs().clamp(min=1)
    return error.nan_to_num(nan=math.inf).amax(-1)


def count_outliers(image: Tensor, expected: Tensor, atol: float = IMAGE_ATOL) -> int:
    """Number of pixels that differ by more than atol."""
    return int((pixel_errors(image, expected) > atol).sum())


def flip_margin(scene: Scene, ties: bool = False) -> float:
    """Smallest relative distance of any yes/no decision of the renderer to its threshold (oracle's view).

    With `ties` equal depths are allowed: their order is then fixed by the input's order and not by rounding.
    """
    scene = convert(scene, torch.float64)
    covars = scene.get("covars")
    if covars is None:
        half = oracle.quat_to_matrix(scene["quats"]) * scene["scales"][:, None]
        covars = half @ half.transpose(1, 2)
    W, H, near = scene["width"], scene["height"], scene.get("near_plane", 0.01)
    ortho = scene.get("camera_model", "pinhole") == "ortho"
    margins = [math.inf]
    for viewmat, K in zip(scene["viewmats"], scene["Ks"], strict=True):
        planes = near, scene.get("far_plane", 1e10)
        splats = oracle.project(scene["means"], covars, viewmat, K, W, H, *planes, scene.get("eps2d", 0.3),
                                scene.get("camera_model", "pinhole"), True)  # fmt: skip
        opacity = scene["opacities"][splats.ids]
        if scene.get("rasterize_mode") == "antialiased":
            opacity = opacity * splats.compensation
        ys, xs = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
        alphas = oracle.pixel_alphas(splats, opacity, torch.stack([xs, ys], -1).reshape(-1, 2).double())
        cutoff, stop = scene.get("alpha_cutoff", 1 / 255), scene.get("transmittance_stop", 1e-4)
        cut = torch.where(alphas < cutoff, 0.0, alphas.clamp(max=0.999))
        after = torch.cumprod(1 - cut, 1)
        gaps = splats.depths.diff() / 3
        gaps = gaps[gaps > 0] if ties else gaps
        decisions = [(alphas / cutoff).log(), (alphas / 0.999).log(), (after / stop).log(), gaps]
        x, y, z = (scene["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
        decisions.append((z - near) / 3)
        if not ortho:
            u, v = (K[0, 0] * x / z / W)[z > near], (K[1, 1] * y / z / H)[z > near]
            cx, cy = K[0, 2] / W, K[1, 2] / H
            decisions += [u + cx + 0.15, u - 1.15 + cx, v + cy + 0.15, v - 1.15 + cy]
        if scene.get("sh_degree") is not None:
            directions = scene["means"] - torch.linalg.inv(viewmat)[:3, 3]
            color = oracle.sh_to_color(scene["colors"], directions, scene["sh_degree"])
            decisions.append(torch.where(color > 0, color, 1.0))
        margins += [d.abs().nan_to_num(nan=math.inf).min().item() for d in decisions if d.numel()]
    return min(margins)


def calm_scene(
    seed: int, *args: Any, edit: Callable[[Scene], Scene] = lambda scene: scene, ties: bool = False, **kwargs: Any
) -> Scene:
    """The first random scene, from this seed on, in which float32 cannot flip a decision, also after `edit`."""
    for attempt in range(200):
        scene = edit(random_scene(1000 * seed + attempt, *args, **kwargs))
        if flip_margin(scene, ties) > FLIP_MARGIN:
            return scene
    raise RuntimeError("expected a scene without threshold flips in 200 tries, got none: make it smaller")


def assert_matches_oracle(
    render: Callable[..., Any], scene: Scene, *, wrt: Iterable[str] = LEAVES, image_atol: float = IMAGE_ATOL,
    grad_rtol: float = GRAD_RTOL, outliers: int = 0, device: str = "cpu", rows: Tensor | None = None,
) -> Rendered:  # fmt: skip
    """Image, alphas and gradients of `render` against the oracle fed with the same rounded inputs.

    With `rows` only these Gaussians' gradients are compared (the others belong to the hard case itself); all gradients
    of compared rows and of the pose must be finite. `outliers` pixels may be wrong, each by a flipped step at most.
    """
    grad_rtol *= GPU_SLACK if render is on_gpu else 1.0
    got, expected = run(render, convert(scene, device=device), wrt), run(reference, scene, wrt)
    for name in ("colors", "alphas"):
        value, truth = getattr(got, name), getattr(expected, name)
        assert torch.isfinite(value).all(), f"{name}: not finite"
        wrong = count_outliers(value, truth, image_atol)
        worst = pixel_errors(value, truth).max().item() if value.numel() else 0.0
        assert wrong <= outliers, f"{name}: {wrong} pixels off by more than {image_atol:g} (worst {worst:.3g})"
        assert outliers == 0 or worst < FLIP_STEP, f"{name}: worst error {worst:.3g} is no flip"
    for name, truth in expected.grads.items():
        value, truth = comparable(name, got.grads[name]), comparable(name, truth)
        if rows is not None and name not in ("viewmats", "backgrounds"):
            value, truth = value[rows], truth[rows]
        assert torch.isfinite(value).all(), f"gradient of {name}: not finite"
        error = relative_l2(value, truth)
        assert error <= grad_rtol, f"gradient of {name}: relative L2 error {error:.3g} > {grad_rtol:g}"
    return got
