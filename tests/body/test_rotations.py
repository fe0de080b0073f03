"""Rotations: exact against scipy, finite in value and gradient at 0, at tiny angles and at pi."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ahoy_core.body import rotations as rot

ANGLES = [0.0, 1e-300, 1e-30, 1e-12, 1e-8, 1e-4, 0.0099, 0.0101, 0.5, 2.0, math.pi - 1e-3, math.pi - 1e-9, math.pi]
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-14}
DTYPES = [torch.float32, torch.float64]


def axes(dtype: torch.dtype) -> Tensor:
    rng = torch.Generator().manual_seed(0)
    random = torch.randn(5, 3, generator=rng, dtype=torch.float64)
    all_axes = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64), random])
    return (all_axes / all_axes.norm(dim=-1, keepdim=True)).to(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", [*ANGLES, 3 * math.pi, 7.0])
def test_matrices_agree_with_scipy(angle: float, dtype: torch.dtype) -> None:
    vectors = axes(dtype) * angle
    expected = Rotation.from_rotvec(vectors.double().numpy()).as_matrix()
    # Beyond one turn, float32 angles carry their own round-off.
    slack = TOLERANCE[dtype] * max(1.0, angle)
    np.testing.assert_allclose(rot.axis_angle_to_matrix(vectors).numpy(), expected, atol=slack)
    np.testing.assert_allclose(
        rot.quaternion_to_matrix(rot.axis_angle_to_quaternion(vectors)).numpy(), expected, atol=slack
    )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_undoes_log(angle: float, dtype: torch.dtype) -> None:
    matrices = rot.so3_exp(axes(dtype) * angle)
    omega = rot.so3_log(matrices)
    torch.testing.assert_close(rot.so3_exp(omega), matrices, atol=4 * TOLERANCE[dtype], rtol=0)
    assert (omega.norm(dim=-1) <= math.pi + 1e-6).all()
    torch.testing.assert_close(omega.norm(dim=-1), torch.full_like(omega[:, 0], angle), atol=4e-6, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_values_and_gradients_are_finite(angle: float, dtype: torch.dtype) -> None:
    vectors = (axes(dtype) * angle).requires_grad_()
    matrices = rot.axis_angle_to_matrix(vectors)
    identity = torch.eye(3, dtype=dtype)
    weights = torch.linspace(0.1, 1.0, 3, dtype=dtype)
    for value in (
        matrices,
        rot.axis_angle_to_quaternion(vectors),
        rot.matrix_to_quaternion(matrices),
        rot.matrix_to_axis_angle(matrices) * weights,
        rot.geodesic_distance(matrices, identity),
    ):
        (gradient,) = torch.autograd.grad(value.sum(), vectors, retain_graph=True)
        assert torch.isfinite(value).all()
        assert torch.isfinite(gradient).all()
        assert gradient.abs().max() < 10, "a rotation's derivative is bounded"


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.00999, 0.01001, 1.0, 3.0, math.pi - 1e-3])
def test_gradients_pass_gradcheck(angle: float) -> None:
    vectors = (axes(torch.float64)[-3:] * angle).requires_grad_()
    assert torch.autograd.gradcheck(rot.axis_angle_to_matrix, vectors, eps=1e-6)
    assert torch.autograd.gradcheck(rot.axis_angle_to_quaternion, vectors, eps=1e-6)
    assert torch.autograd.gradcheck(lambda v: rot.so3_log(rot.so3_exp(v)), vectors, eps=1e-6)


def test_identity_has_the_gradient_of_the_tangent_space() -> None:
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(lambda v: rot.so3_log(rot.so3_exp(v)), zero)
    torch.testing.assert_close(jacobian, torch.eye(3, dtype=torch.float64))


def test_zero_quaternion_is_the_identity_with_zero_gradient() -> None:
    quaternion = torch.zeros(1, 4, requires_grad=True)
    matrix = rot.quaternion_to_matrix(quaternion)
    torch.testing.assert_close(matrix, torch.eye(3)[None])
    matrix.sum().backward()
    assert quaternion.grad is not None
    assert torch.equal(quaternion.grad, torch.zeros(1, 4))


def test_quaternions_have_positive_real_part_and_unit_length() -> None:
    rng = torch.Generator().manual_seed(1)
    matrices = rot.axis_angle_to_matrix(4 * torch.randn(500, 3, generator=rng, dtype=torch.float64))
    quaternions = rot.matrix_to_quaternion(matrices)
    assert (quaternions[:, 0] >= 0).all()
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(500, dtype=torch.float64))
    torch.testing.assert_close(rot.quaternion_to_matrix(quaternions), matrices)


def test_small_perturbations_of_a_half_turn_stay_continuous() -> None:
    rng = torch.Generator().manual_seed(2)
    half_turn = rot.so3_exp(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))
    nudges = 1e-7 * torch.randn(500, 3, generator=rng, dtype=torch.float64)
    back = rot.so3_exp(rot.so3_log(half_turn @ rot.so3_exp(nudges)))
    torch.testing.assert_close(back, half_turn.expand_as(back), atol=1e-6, rtol=0)


def test_geodesic_distance_is_the_angle_between() -> None:
    a = rot.so3_exp(torch.tensor([[0.3, -0.2, 0.9]], dtype=torch.float64))
    for angle in (1e-7, 0.1, 3.0, math.pi):
        b = a @ rot.so3_exp(angle * axes(torch.float64)[-1:])
        assert float(rot.geodesic_distance(a, b)) == pytest.approx(angle, abs=1e-8)


def test_nearest_rotation_repairs_scale_and_mirroring() -> None:
    rotation = rot.so3_exp(torch.tensor([[0.4, 0.1, -2.0]], dtype=torch.float64))
    torch.testing.assert_close(rot.nearest_rotation(1.7 * rotation), rotation)
    assert torch.det(rot.nearest_rotation(-rotation)) > 0
