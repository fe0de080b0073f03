"""The SMPL family against an independent implementation of its papers, and what is its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ahoy_core.body.keypoints import LANDMARK_NAMES
from ahoy_core.body.lbs import normalize_weights
from ahoy_core.body.smpl import SmplBody
from ahoy_core.body.smpl_load import _shape_basis, load_smpl

from . import licensed
from .test_bodies import random_input

TO_OURS = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up from y up


def by_the_papers(
    file: Mapping[str, np.ndarray], pose: np.ndarray, components: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Equations 2 to 10 of SMPL (Loper et al. 2015) as they are printed, in the file's axes: one pose, 4x4 matrices."""
    tree = file["kintree_table"][0].astype(np.int64)
    shaped = file["v_template"] + np.einsum("vas,s->va", file["shapedirs"], components)
    joints = file["J_regressor"] @ shaped
    rotation = [Rotation.from_rotvec(angles).as_matrix() for angles in pose]
    features = np.concatenate([(matrix - np.eye(3)).ravel() for matrix in rotation[1:]])
    posed = shaped + np.einsum("vap,p->va", file["posedirs"], features)
    world: list[np.ndarray] = []
    for joint, matrix in enumerate(rotation):
        local = np.eye(4)
        local[:3, :3] = matrix
        local[:3, 3] = joints[joint] - (joints[tree[joint]] if joint else 0)
        world.append(world[tree[joint]] @ local if joint else local)
    removed = [transform @ _move(-joint) for transform, joint in zip(world, joints, strict=True)]
    blended = np.einsum("vj,jab->vab", file["weights"], np.stack(removed))
    skinned = np.einsum("vab,vb->va", blended, np.pad(posed, ((0, 0), (0, 1)), constant_values=1))[:, :3]
    return skinned + transl, np.stack([transform[:3, 3] for transform in world]) + transl


def _move(by: np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = by
    return transform


def components_of(body: SmplBody, betas: np.ndarray, expression: np.ndarray) -> np.ndarray:
    """Coefficients of all of the file's shape components."""
    columns = np.zeros(licensed.SHAPES[body.kind])
    columns[: len(betas)] = betas
    if len(expression):
        columns[300 : 300 + len(expression)] = expression
    return columns


def test_vertices_and_joints_are_those_of_the_papers_equations(
    smpl_body: SmplBody, licensed_files: dict[str, Path]
) -> None:
    given = random_input(smpl_body, 2)
    output = smpl_body(*given)
    pose, betas, transl, expression = (values.numpy() for values in given)
    with np.load(licensed_files[smpl_body.kind]) as archive:
        file = {key: archive[key] for key in archive.files if not key.endswith("2num")}
    for b in range(2):
        vertices, joints = by_the_papers(
            file, pose[b] @ TO_OURS, components_of(smpl_body, betas[b], expression[b]), transl[b] @ TO_OURS
        )
        # Two float64 summation orders over 55 joints and 486 blend shapes.
        np.testing.assert_allclose(output.vertices[b].numpy(), vertices @ TO_OURS.T, atol=1e-12)
        np.testing.assert_allclose(output.joints[b].numpy(), joints @ TO_OURS.T, atol=1e-12)


def test_sizes_are_those_of_the_models(smpl_body: SmplBody) -> None:
    vertices, triangles, _, _ = licensed.SIZES[smpl_body.kind]
    assert (smpl_body.n_vertices, len(smpl_body.faces)) == (vertices, triangles)
    assert smpl_body.n_joints == {"smpl": 24, "smplh": 52, "smplx": 55}[smpl_body.kind]
    assert (smpl_body.n_betas, smpl_body.n_expressions) == (10, 10 if smpl_body.kind == "smplx" else 0)


@pytest.mark.parametrize(
    ("kind", "held", "asked", "betas", "expressions"),
    [
        ("smplx", 400, (10, 10), 10, 10),
        ("smplx", 400, (400, 400), 300, 100),
        ("smplx", 20, (16, 16), 10, 10),
        ("smplh", 16, (20, 5), 16, 0),
        ("smpl", 300, (10, 10), 10, 0),
    ],
)
def test_as_many_components_are_used_as_asked_for_and_held(
    kind: str, held: int, asked: tuple[int, int], betas: int, expressions: int
) -> None:
    """SMPL-X keeps 300 shape components before the expressions, its older files 10."""
    shapedirs = torch.arange(float(held)).expand(2, 3, -1)
    basis, found = _shape_basis(kind, shapedirs, *asked)
    assert (len(basis), found) == (betas + expressions, expressions)
    first = {400: 300, 20: 10}.get(held, 0)
    numbers = [*range(betas), *range(first, first + expressions)]
    np.testing.assert_array_equal(basis[:, 0, 0].numpy(), numbers)


def test_float32_stays_within_a_hundredth_of_a_millimetre(smpl_body: SmplBody) -> None:
    given = random_input(smpl_body, 2)
    exact = smpl_body(*given).vertices
    rounded = smpl_body.to(dtype=torch.float32)(*(values.float() for values in given)).vertices
    assert (rounded.double() - exact).abs().max() < 1e-5


def test_joints_follow_the_regressor(smpl_body: SmplBody) -> None:
    _, betas, _, expression = random_input(smpl_body, 2)
    vertices, joints = smpl_body.shape(betas, expression)
    torch.testing.assert_close(smpl_body.joint_regressor @ vertices, joints, atol=1e-12, rtol=0)


def test_expressions_of_smplx_move_the_body_and_jaw_turns_the_jaw_alone(bodies64: dict[str, SmplBody]) -> None:
    body = bodies64["smplx"]
    still = torch.zeros(1, body.n_joints, 3, dtype=torch.float64)
    neutral = body(still, body.default_betas[None], still[:, 0]).vertices
    smiling = body(still, body.default_betas[None], still[:, 0], torch.eye(10, dtype=torch.float64)[:1]).vertices
    assert (smiling - neutral).abs().max() > 1e-3
    opened = still.clone()
    opened[0, body.joint_names.index("jaw"), 0] = 0.3
    moved = (
        body(opened, body.default_betas[None], still[:, 0]).joints
        - body(still, body.default_betas[None], still[:, 0]).joints
    )
    assert moved.abs().max() < 1e-12, "the jaw has no joint below it"


@pytest.mark.parametrize("side", ["left", "right"])
def test_hands_are_mean_plus_components_in_our_axes(bodies64: dict[str, SmplBody], side: str) -> None:
    body, file = bodies64["smplx"], licensed.arrays("smplx")
    coefficients = torch.tensor([[0.5, -1.0, 0.25]], dtype=torch.float64)
    expected = file[f"hands_mean{side[0]}"] + coefficients.numpy()[0] @ file[f"hands_components{side[0]}"][:3]
    got = body.hand_pose(coefficients, side)
    np.testing.assert_allclose(got[0].numpy(), expected.reshape(15, 3) @ TO_OURS.T, atol=1e-14)
    assert body.joint_names.index(f"{side}_index1") + 15 in (40, 55), "fingers of a hand are 15 joints in a row"
    with pytest.raises(ValueError, match="at most 45"):
        body.hand_pose(torch.zeros(1, 46, dtype=torch.float64), side)
    with pytest.raises(ValueError, match="holds no PCA"):
        bodies64["smpl"].hand_pose(coefficients, side)


def test_texture_coordinates_of_an_obj_are_those_of_the_same_corners(bodies64: dict[str, SmplBody]) -> None:
    body = bodies64["smpl"]
    # The synthetic layout gives each vertex one coordinate, with the vertex's own number.
    torch.testing.assert_close(body.uv_faces, body.faces)


def test_without_texture_coordinates_the_error_says_where_to_get_them(licensed_files: dict[str, Path]) -> None:
    body = load_smpl(licensed_files["smpl"])
    with pytest.raises(ValueError, match="UV template"):
        _ = body.uvs


def test_the_head_may_come_from_the_makers_correspondence(licensed_files: dict[str, Path], tmp_path: Path) -> None:
    ids = np.array([5, 9, 10474])
    np.save(tmp_path / "SMPL-X__FLAME_vertex_ids.npy", ids)
    body = load_smpl(licensed_files["smplx"], head_ids=tmp_path / "SMPL-X__FLAME_vertex_ids.npy")
    np.testing.assert_array_equal(torch.nonzero(body.regions["head"])[:, 0].numpy(), ids)


def test_smplx_takes_its_face_landmarks_from_the_file(bodies64: dict[str, SmplBody]) -> None:
    body, file = bodies64["smplx"], licensed.arrays("smplx")
    corners = set(file["f"][file["lmk_faces_idx"][13]].tolist())
    row = LANDMARK_NAMES.index("nose")
    assert set(body.landmark_indices[row][body.landmark_weights[row] > 0].tolist()) == corners


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_skin_weights_of_a_file_that_do_not_sum_to_one_are_scaled(tmp_path: Path, scale: float) -> None:
    weights = licensed.arrays("smpl")["weights"]
    scaled = scale * weights
    scaled[17] = 0
    body = load_smpl(licensed.write(tmp_path, "smpl", weights=scaled), dtype=torch.float64)
    expected = weights.copy()
    expected[17] = np.eye(24)[0]
    np.testing.assert_allclose(body.lbs_weights.numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalised_weights_are_finite_in_value_and_gradient(dtype: torch.dtype) -> None:
    tiny = torch.finfo(dtype).tiny
    weights = torch.tensor([[0, 0, 0], [tiny, 0, 0], [1e-12, 1e-12, 0], [0.2, 0.3, 0.1], [1e6, 1e6, 2e6]], dtype=dtype)
    weights.requires_grad_()
    normalised = normalize_weights(weights)
    torch.testing.assert_close(normalised.sum(1), torch.ones(5, dtype=dtype))
    torch.testing.assert_close(normalised[0], torch.tensor([1.0, 0, 0], dtype=dtype))
    (gradient,) = torch.autograd.grad(normalised.square().sum(), weights)
    assert torch.isfinite(gradient).all()
    assert not gradient[:2].any()
