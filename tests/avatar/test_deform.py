from __future__ import annotations

import math

import pytest
import torch

from ahoy_core.avatar.deform import (
    OffsetBounds,
    adjust_weights,
    apply_offsets,
    deform,
    dense_weights,
    offset_channels,
)
from ahoy_core.avatar.kinematics import relative_transforms
from ahoy_core.body.canonical import canonical_pose
from ahoy_core.body.rotations import axis_angle_to_matrix
from ahoy_core.splat import oracle
from tests.avatar.scenes import body, canonical_covars, hand_made, template

BOUNDS = OffsetBounds()


def _relative(pose: torch.Tensor, transl: torch.Tensor | None = None) -> torch.Tensor:
    place = torch.zeros(1, 3) if transl is None else transl[None]
    return relative_transforms(body(), pose[None], body().default_betas, place)[0]


def _weights() -> torch.Tensor:
    return dense_weights(template().skin_indices, template().skin_weights, body().n_joints)


def test_zero_offsets_give_the_template():
    start = template()
    canonical = apply_offsets(start, torch.zeros(len(start), offset_channels(start)), BOUNDS)
    for name in ("means", "scales", "colors", "rotations"):
        assert torch.equal(getattr(canonical, name), getattr(start, name)), name
    # Through logit and sigmoid, and through a normalisation: round-off.
    assert torch.allclose(canonical.opacities, start.opacities, atol=1e-6)
    assert torch.allclose(canonical.skin_weights, start.skin_weights, atol=1e-6)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4, math.inf])
def test_offsets_never_leave_their_bounds(size: float):
    start = template()
    sign = torch.where(
        torch.rand(len(start), offset_channels(start), generator=torch.Generator().manual_seed(0)) < 0.5, -1, 1
    )
    canonical = apply_offsets(start, sign * size, BOUNDS)
    assert float((canonical.means - start.means).abs().max()) <= BOUNDS.position * (1 + 1e-4)
    assert float((canonical.scales / start.scales).log().abs().max()) <= BOUNDS.log_scale * (1 + 1e-4)
    for name in ("means", "rotations", "scales", "opacities", "colors", "skin_weights"):
        assert torch.isfinite(getattr(canonical, name)).all(), name


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3, 1e8])
def test_skin_weights_stay_a_partition_of_unity_for_any_logits(size: float):
    logits = size * torch.randn(len(template()), 8, generator=torch.Generator().manual_seed(1))
    weights = adjust_weights(template().skin_weights, logits)
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-5)
    assert float(weights.min()) >= 0
    assert bool((weights[template().skin_weights == 0] == 0).all())


def test_a_joint_without_weight_cannot_take_over():
    weights = adjust_weights(torch.tensor([[1.0, 0.0]]), torch.tensor([[-1e9, 1e9]]))
    assert torch.equal(weights, torch.tensor([[1.0, 0.0]]))


def test_the_canonical_pose_leaves_the_gaussians_where_they_are():
    covars = canonical_covars(template())
    means, posed = deform(template().means, covars, _weights(), _relative(canonical_pose(body())))
    assert torch.allclose(means, template().means, atol=1e-5)
    assert torch.allclose(posed, covars, atol=1e-5 * float(covars.abs().max()))


def test_gaussians_follow_the_body_surface():
    """Gaussians are points of the mesh: skinned, they stay where the body's own skinning puts those points."""
    pose = canonical_pose(body()).clone()
    pose[1:20] += 0.3 * torch.randn(19, 3, generator=torch.Generator().manual_seed(2))
    transl = torch.tensor([0.1, 2.0, -0.3])
    means, _ = deform(template().means, canonical_covars(template()), _weights(), _relative(pose, transl))
    vertices = body()(pose[None], body().default_betas[None], transl[None]).vertices[0]
    surface = (vertices[body().faces[template().faces]] * template().barycentric[:, :, None]).sum(1)
    # Blending weights of a face's corners and then skinning is not skinning the corners: bent faces differ a little.
    gaps = (means - surface).norm(dim=1)
    assert float(gaps.median()) < 1e-3
    assert float(gaps.quantile(0.99)) < 1e-2


@pytest.mark.parametrize("angle", [0.7, math.pi, 2 * math.pi])
def test_turning_the_root_is_a_rigid_motion(angle: float):
    pose = canonical_pose(body()).clone()
    still, covars = deform(template().means, canonical_covars(template()), _weights(), _relative(pose))
    pose[0] += torch.tensor([0.0, 0.0, angle])
    relative = _relative(pose)
    means, turned = deform(template().means, canonical_covars(template()), _weights(), relative)
    root = relative[0]
    assert torch.allclose((means - root[:3, 3]) @ root[:3, :3], still, atol=1e-5)
    assert torch.allclose(root[:3, :3].T @ turned @ root[:3, :3], covars, atol=1e-5 * float(covars.abs().max()))


def test_skinned_covariances_are_positive_semidefinite_at_a_full_twist():
    pose = canonical_pose(body()).clone()
    pose[1:] += 3.0 * torch.randn(body().n_joints - 1, 3, generator=torch.Generator().manual_seed(3))
    _, covars = deform(template().means, canonical_covars(template()), _weights(), _relative(pose))
    values = torch.linalg.eigvalsh(covars.double())
    assert float((values[:, 0] / values[:, 2].clamp(min=1e-30)).min()) > -1e-6


def test_gradients_from_map_offsets_to_the_image():
    start = hand_made()
    g = torch.Generator().manual_seed(4)
    raw = (0.3 * torch.randn(len(start), offset_channels(start), generator=g, dtype=torch.float64)).requires_grad_()
    relative = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    relative[:, :3, :3] = axis_angle_to_matrix(0.4 * torch.randn(3, 3, generator=g, dtype=torch.float64))
    relative[:, :3, 3] = 0.1 * torch.randn(3, 3, generator=g, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 3.0
    K = torch.tensor([[8.0, 0, 3.5], [0, 8.0, 3.0], [0, 0, 1]], dtype=torch.float64)

    def image(raw: torch.Tensor) -> torch.Tensor:
        canonical = apply_offsets(start, raw, BOUNDS)
        weights = dense_weights(start.skin_indices, canonical.skin_weights, 3)
        means, covars = deform(canonical.means, canonical.covars(), weights, relative)
        rgb, alpha = oracle.render(
            means, None, None, canonical.opacities, canonical.colors, viewmat[None], K[None], 7, 6, covars=covars
        )
        return torch.cat([rgb, alpha], -1)

    assert torch.autograd.gradcheck(image, (raw,), eps=1e-6, atol=1e-6)


def test_wrong_offsets_are_refused():
    with pytest.raises(ValueError, match="expected raw offsets"):
        apply_offsets(template(), torch.zeros(len(template()), 3), BOUNDS)
